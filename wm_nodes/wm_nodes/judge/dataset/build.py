"""Build a set of clips with known labels from the simulator: record, draw, edit, draw again, describe (RA-21).

A folder holds manifest.jsonl and one compressed .npz per clip (frames, masks, fps), named by its hash. The manifest is
written last: a folder without one is unfinished. Equal arguments give equal bytes.

    python3 launch_scripts/make_adversarial_set.py FOLDER --tasks push_cube --episodes 8
    python3 launch_scripts/make_adversarial_set.py FOLDER --benchmark
    python3 launch_scripts/make_adversarial_set.py FOLDER --diverse --episodes 40 --edits 26 --seed 20000
    python3 launch_scripts/make_adversarial_set.py FOLDER --policy-view --development --episodes 40 --edits 26

--benchmark is the set that judges are compared on: three tasks, shapes that no judge was trained on, and seeds of its
own; its test split is fixed by the manifest (rows.select_rows) and has 400 clips or more.
--development leaves out the episodes of the test part, which training does not read; --diverse does so too, and draws
cameras, colours, light and push directions from ranges that exclude what is held out (domain_randomization.py).
--policy-view draws the policy's scene and camera, most through a world model (policy_camera.py).
"""

import argparse
import itertools
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from wm_nodes.config.load import default_task, load_config
from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.tasks import clip_rules, get_task, task_names
from wm_nodes.core.files import write_atomic
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.judge.dataset.domain_randomization import RandomizedScene, draw_scene
from wm_nodes.judge.dataset.edits import (
    RECIPES,
    Division,
    LabelledClip,
    Manifest,
    Origin,
    SceneStates,
    SourceClip,
    StateEdit,
    children,
    label_rendered,
    manifest_of,
    recorded,
    stacks,
    to_bytes,
)
from wm_nodes.judge.dataset.edits.manifest import Part
from wm_nodes.judge.dataset.policy_camera import IMAGINED, PolicyCamera, policy_models
from wm_nodes.judge.dataset.rendering import (
    CAMERAS,
    ClipStage,
    Drawing,
    EpisodeStates,
    SceneAppearance,
    View,
    cube_half_sizes,
    record_states,
)
from wm_nodes.judge.dataset.set_files import MANIFEST, check_set, clip_path, to_file
from wm_nodes.world_model import load_model_folder

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
        """Of the recorded episodes."""
        numbers = itertools.count(self.seed)
        wanted = (seed for seed in numbers if not self.development or self.part(task, seed) != "test")
        return list(itertools.islice(wanted, self.num_episodes))

    def part(self, task: str, seed: int) -> Part:
        return _part_of_seed(task, seed) if self.diverse else self.held_out.part(draw_origin(task, seed, self.shapes))


BENCHMARK = SetPlan(
    ("push_cube", "reach", "pull_cube"), 20, 26, 9000, replace(HELD_OUT, tasks=("pull_cube",)), ("post", "slab")
)
"""The set that judges are compared on. Train on other seeds; all its clips of pull_cube are test clips, for judges that
were trained without that task."""


class ClipSource:
    """Records clips of one task and renders edits of them. shapes, diverse: see SetPlan. It starts the simulator.

    Raises:
        NoRendererError: Vulkan finds no device.
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
            drawing = self.stage.draw(
                states.robot_q, states.poses, sizes_m, states.tool, states.goal, camera, look
            )
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
    half_sizes_m, poses = cube_half_sizes(1)[0], states.poses.copy()
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
            source = ClipSource(task, config, plan.shapes, diverse=plan.diverse, policy=policy)
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


def main(argv: Sequence[str]) -> int:
    """Build a set and print its prevalence. Return the exit code: 0 done, 2 a clear error."""
    parser = argparse.ArgumentParser(prog="adversarial_set", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="new folder of the set")
    parser.add_argument("--tasks", nargs="+", choices=task_names(), default=[default_task()])
    parser.add_argument("--episodes", type=int, default=8, help="recorded episodes per task")
    parser.add_argument("--edits", type=int, help="edits tried on each; all by default")
    parser.add_argument(
        "--stacks", type=int, default=0, help="clips of up to three mild edits, every other one on a physical defect"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shapes", nargs="+", choices=sorted(SHAPES), default=[], help="besides the cube, held out")
    parser.add_argument("--recipes", nargs="+", choices=sorted(RECIPES), default=tuple(RECIPES), help="all by default")
    parser.add_argument("--development", action="store_true", help="only episodes of the training and validation parts")
    parser.add_argument("--diverse", action="store_true", help="the same, with cameras, colours, light, ways at random")
    parser.add_argument(
        "--policy-view", nargs="?", type=Path, const=Path(), metavar="MODEL_DIR",
        help="the loops' own scene and camera, most as a world model draws them; default: the shipped one",
    )
    parser.add_argument("--stride", type=int, default=1, help="of --policy-view: steps between two frames of a clip")
    parser.add_argument("--benchmark", action="store_true", help="the set that judges are compared on; nothing else")
    parser.add_argument("--check", action="store_true", help="build nothing, verify the set that is there")
    arguments = parser.parse_args(argv)
    try:
        if arguments.check:
            manifest, skipped = check_set(arguments.folder), Counter[str]()
        else:
            shapes = tuple(arguments.shapes)
            plan = SetPlan(
                tuple(arguments.tasks), arguments.episodes, arguments.edits, arguments.seed, shapes=shapes,
                development=arguments.development or arguments.diverse, diverse=arguments.diverse,
                recipes=tuple(arguments.recipes), policy=arguments.policy_view is not None,
                stacks_per_clip=arguments.stacks,
            )
            if arguments.stride < 1 or (arguments.stride > 1 and not plan.policy):
                raise ValueError(f"--stride is of --policy-view and at least 1, got {arguments.stride}")
            plan = BENCHMARK if arguments.benchmark else plan
            policy = None
            if plan.policy:
                policy = PolicyCamera(
                    load_model_folder(policy_models(arguments.policy_view)), SIDE_PX, arguments.stride
                )
            manifest, skipped = build(arguments.folder, plan, load_config("cpu").simulation, policy)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    splits = Counter(row.split for row in manifest.rows)
    parts = Counter(row.part for row in manifest.rows)
    print(f"{len(manifest.rows)} clips in {arguments.folder}: " + ", ".join(f"{n} {s}" for s, n in splits.items()))
    print(", ".join(f"{count} {part}" for part, count in sorted(parts.items())))
    print(f"{'label':16} {'pass':>6} {'fail':>6} {'unknown':>8}  fails")
    for name, counts in manifest.prevalence["all"].items():
        share = counts["fail"] / max(1, counts["pass"] + counts["fail"])
        print(f"{name:16} {counts['pass']:6} {counts['fail']:6} {counts['unknown']:8}  {share:5.1%}")
    for reason, count in skipped.most_common(10):
        print(f"left out {count} times: {reason}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
