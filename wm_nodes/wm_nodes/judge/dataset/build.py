"""Build a set of clips with known labels from the simulator: record, draw, edit, draw again, describe (RA-21).

A folder holds manifest.jsonl and one compressed .npz per clip (frames, masks, fps), named by its hash. The manifest is
written last: a folder without one is unfinished. Equal arguments give equal bytes.
As a command: wm build-judge-dataset.
"""

import itertools
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from wm_nodes.config.load import default_task
from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.seed_ranges import MODEL_EPISODES
from wm_nodes.config.tasks import clip_rules, get_task
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.table_top import CUBE_HALF_SIZE_M
from wm_nodes.judge.dataset.domain_randomization import RandomizedScene, draw_scene
from wm_nodes.judge.dataset.edits.clips import LabelledClip, Origin, SceneStates, SourceClip
from wm_nodes.judge.dataset.edits.generator import children, stacks
from wm_nodes.judge.dataset.edits.manifest import Division, Manifest, Part, manifest_of, to_bytes
from wm_nodes.judge.dataset.edits.recipes import RECIPES, StateEdit, label_rendered
from wm_nodes.judge.dataset.edits.truth import recorded
from wm_nodes.judge.dataset.policy_camera import IMAGINED, PolicyCamera
from wm_nodes.judge.dataset.rendering import (
    CAMERAS,
    ClipStage,
    Drawing,
    EpisodeStates,
    SceneAppearance,
    View,
    record_states,
)
from wm_nodes.judge.dataset.set_files import MANIFEST, clip_path, to_file

SIDE_PX = 96
OBJECT_COLOURS = {
    "blue": (0.05, 0.16, 0.63), "green": (0.05, 0.5, 0.12), "orange": (0.85, 0.4, 0.05), "purple": (0.45, 0.1, 0.6),
}
TABLES = {"sand": (0.78, 0.74, 0.66), "slate": (0.42, 0.46, 0.5), "moss": (0.5, 0.58, 0.42)}
HELD_OUT = Division(cameras=("near_high",), objects=("cube/purple",), scenes=("moss",))
HELD_OUT_SHARE = 0.12
"""Of the episodes, for each held-out camera, object and scene; two thirds of a trained task's are none of them."""
SHAPES = {"cube": 1.0, "post": 1.7, "slab": 0.7}
"""Height of a box over that of the cube. The footprint is the cube's, so the recorded contacts are the shape's own,
as long as the tool stays below its top or beside it: STEADY behaviours only.
"""
STEADY = ("expert", "short", "near_miss")


@dataclass(frozen=True)
class SetPlan:
    """Settings of a set.

    tasks: built one after the other. num_episodes: recorded per task, each by one camera. edits_per_clip: (recipe,
    severity) pairs tried on each, None for all. seed: episode i is reset with seed + i and draws everything from it.
    shapes: besides the cube; rare, and in test clips only; not of tasks whose end state depends on the height.
    development: only episodes that are in no test part. diverse: scenes of domain_randomization.py. recipes: of the
    edits. policy: clips of policy_camera.py. stacks_per_clip: besides the edits, see generator.stacks.
    """

    tasks: tuple[str, ...] = field(default_factory=lambda: (default_task(),))
    num_episodes: int = 8
    edits_per_clip: int | None = None
    seed: int = 0
    division: Division = HELD_OUT
    shapes: tuple[str, ...] = ()
    development: bool = False
    diverse: bool = False
    recipes: tuple[str, ...] = tuple(RECIPES)
    policy: bool = False
    stacks_per_clip: int = 0

    def __post_init__(self) -> None:
        if self.policy and (self.diverse or self.shapes):
            raise ValueError("the loops' own scene has one look and the cube alone; leave out diverse and shapes")
        if self.diverse and (self.shapes or not self.development):
            raise ValueError("a diverse set is of the development parts, and of the cube alone; leave out shapes")
        if self.development and (excluded := sorted({*self.tasks} & {*self.division.tasks})):
            raise ValueError(f"{', '.join(excluded)} is held out, a development set has none of it; take another task")
        if self.num_episodes < 1 or min(self.edits_per_clip or 0, self.stacks_per_clip) < 0:
            raise ValueError(
                f"need at least 1 episode, 0 edits and 0 stacks, got {self.num_episodes}, {self.edits_per_clip} and "
                f"{self.stacks_per_clip}"
            )
        if foreign := sorted(set(self.shapes) - set(SHAPES)):
            raise ValueError(f"unknown shapes {foreign}; choose among {', '.join(SHAPES)}")

    @property
    def held_out(self) -> Division:
        """The division with every object of another shape held out."""
        objects = (f"{shape}/{colour}" for shape in self.shapes if shape != "cube" for colour in OBJECT_COLOURS)
        return replace(self.division, objects=(*self.division.objects, *objects))

    def seeds(self, task: str) -> list[int]:
        """Of the recorded episodes. Raises ValueError for seeds of another purpose."""
        numbers = itertools.count(self.seed)
        wanted = (seed for seed in numbers if not self.development or self.part(task, seed) != "test")
        found = list(itertools.islice(wanted, self.num_episodes))
        MODEL_EPISODES.check(self.seed, found[-1] + 1 - self.seed)
        return found

    def part(self, task: str, seed: int) -> Part:
        return _part_of_seed(task, seed) if self.diverse else self.held_out.part(draw_origin(task, seed, self.shapes))


BENCHMARK = SetPlan(
    ("push_cube", "reach", "pull_cube"), 20, 26, 9000, replace(HELD_OUT, tasks=("pull_cube",)), ("post", "slab")
)
"""The set that judges are compared on. Train on other seeds; all its clips of pull_cube are test clips, for judges that
were trained without that task."""


class LabelledClipSource:
    """Records clips of one task and renders edits of them. shapes, diverse: see SetPlan. It starts the simulator.

    Raises NoRendererError where Vulkan finds no device.
    """

    def __init__(
        self, task: str, config: SimulationConfig, shapes: Collection[str] = (), *, diverse: bool = False,
        policy: PolicyCamera | None = None,
    ) -> None:
        self._task = task
        self._shapes = shapes
        self._diverse = diverse
        self._policy = policy
        self._config = config
        self._env = ManiSkillEnvironment(task, config.model_copy(update={"image_size": 16}), end_on_success=False)
        if policy is None:
            self.stage = ClipStage(task, config.model_copy(update={"image_size": SIDE_PX}))
        else:
            self.stage = ClipStage(task, policy.config, policy=True)

    def origin(self, seed: int) -> Origin:
        if self._policy is not None:
            return self._policy.origin(self._task, seed)
        drawn = draw_origin(self._task, seed, self._shapes)
        return self._draw_scene(seed).origin(self._task, seed, drawn.behaviour) if self._diverse else drawn

    def clip(self, seed: int) -> LabelledClip:
        """Record one episode and draw it."""
        origin = self.origin(seed)
        height = SHAPES[origin.object_id.split("/")[0]]
        layout = self._draw_scene(seed).look.layout if self._diverse else None
        episode = record_states(self._env, origin.behaviour.split()[0], seed, layout)
        states = scene_states(episode, height)
        if self._policy is not None:
            states = self._policy.end_states(states, origin)
            if origin.scene.startswith(IMAGINED):
                drawing = self._policy.imagine(self.stage, states, episode)
                if drawing is not None:
                    return recorded(self._make_clip(drawing, states, origin))
                origin = self._policy.mark_decoded(origin)
        return recorded(self._draw(states, origin))

    def redraw(self, parent: LabelledClip, edit: StateEdit) -> LabelledClip:
        return label_rendered(parent, edit, self._draw(edit.states, parent.clip.origin))

    def close(self) -> None:
        self._env.close()
        self.stage.close()

    def _draw_scene(self, seed: int) -> RandomizedScene:
        return draw_scene(self._task, seed, _part_of_seed(self._task, seed))

    def _draw(self, states: SceneStates, origin: Origin) -> SourceClip:
        if self._policy is not None:
            drawing = self._policy.draw(self.stage, states, origin)
        else:
            camera, look = self._scenery(origin)
            sizes_m = states.half_sizes_m * states.scales
            drawing = self.stage.draw(states.robot_q, states.poses, sizes_m, states.tool, states.goal, camera, look)
        return self._make_clip(drawing, states, origin)

    def _make_clip(self, drawing: Drawing, states: SceneStates, origin: Origin) -> SourceClip:
        return SourceClip(
            drawing.frames, drawing.masks, drawing.tracks, states, origin,
            instruction_of(origin), self._config.control_hz / (1 if self._policy is None else self._policy.stride),
        )

    def _scenery(self, origin: Origin) -> tuple[str | View, SceneAppearance]:
        if self._diverse:
            variation = self._draw_scene(origin.seed)
            return variation.view, variation.look
        colour = origin.object_id.split("/")[1]
        return origin.camera, SceneAppearance(OBJECT_COLOURS[colour], TABLES[origin.scene], seed=origin.seed)


def _part_of_seed(task: str, seed: int) -> Part:
    """The part of an episode whose camera, object and scene are not held out."""
    return HELD_OUT.part(Origin(task, "drawn", "cube/drawn", "drawn", seed))


def draw_origin(task: str, seed: int, shapes: Collection[str] = ()) -> Origin:
    """Behaviour, camera and colours of an episode, drawn by `seed`. shapes: see SetPlan."""
    rng = numpy_stream(seed, f"adversarial_origin/{task}")
    rules = clip_rules(task)
    behaviour = str(rng.choice(list(rules.behaviours), p=list(rules.behaviours.values())))
    things = [f"cube/{colour}" for colour in OBJECT_COLOURS]
    camera, thing = _pick(rng, list(CAMERAS), HELD_OUT.cameras), _pick(rng, things, HELD_OUT.objects)
    others = [shape for shape in SHAPES if shape in shapes and shape != "cube" and rules.any_height]
    if others and behaviour in STEADY:  # drawn apart, so that everything else is as without them
        apart = numpy_stream(seed, f"adversarial_shape/{task}")
        thing = thing.replace("cube", _pick(apart, ["cube", *others], others))
    return Origin(task, camera, thing, _pick(rng, list(TABLES), HELD_OUT.scenes), seed, behaviour)


def _pick(rng: np.random.Generator, values: Sequence[str], rare: Sequence[str]) -> str:
    """One of the values; each rare one with HELD_OUT_SHARE, the others evenly."""
    common = (1 - HELD_OUT_SHARE * len(rare)) / (len(values) - len(rare))
    return str(rng.choice(list(values), p=[HELD_OUT_SHARE if value in rare else common for value in values]))


def instruction_of(origin: Origin) -> str:
    """The task's instruction with the object's colour and shape in place of "blue" and "cube"."""
    shape, _, colour = origin.object_id.partition("/")
    return get_task(origin.task).instruction.replace("blue", colour.split()[0]).replace("cube", shape)


def scene_states(states: EpisodeStates, height: float = 1.0) -> SceneStates:
    """Convert an episode's states; the cube becomes a box of `height` times its height."""
    num_frames = len(states.poses)
    half_sizes_m, poses = np.full((1, 3), CUBE_HALF_SIZE_M, np.float32), states.poses.copy()
    poses[..., 2] += (np.float32(height) - 1) * half_sizes_m[0, 2]  # it stands on the same table
    half_sizes_m[0, 2] *= np.float32(height)
    return SceneStates(
        states.robot_q, states.tool, states.gripper_m, poses, np.ones((num_frames, 1, 3), np.float32), half_sizes_m,
        states.contact, states.goal,
    )


def build(
    folder: Path, plan: SetPlan, config: SimulationConfig, policy: PolicyCamera | None = None, *, progress: bool = True
) -> tuple[Manifest, Counter[str]]:
    """Make the set; returns its manifest, and how often which recipe did not apply and why.

    Raises:
        NoRendererError: Vulkan finds no device. OSError: a full disk.
        FileExistsError: a finished set is there already.
    """
    if (folder / MANIFEST).exists():
        raise FileExistsError(f"{folder / MANIFEST} is there already; take a new folder, or remove the old set")
    skipped: Counter[str] = Counter()

    def make_clips() -> Iterator[LabelledClip]:
        for task in plan.tasks:
            source = LabelledClipSource(task, config, plan.shapes, diverse=plan.diverse, policy=policy)
            try:
                for seed in tqdm(plan.seeds(task), desc=task, disable=not progress):
                    parent = source.clip(seed)
                    edited = children(parent, seed, source.redraw, names=plan.recipes, count=plan.edits_per_clip,
                                    skipped=skipped)
                    stacked = stacks(parent, seed, source.redraw, plan.stacks_per_clip, skipped=skipped)
                    for clip in (parent, *edited, *stacked):
                        write_atomic(clip_path(folder, clip.sha256), to_file(clip))
                        yield clip
            finally:
                source.close()

    manifest = manifest_of(make_clips(), plan.held_out)
    write_atomic(folder / MANIFEST, to_bytes(manifest))
    return manifest, skipped
