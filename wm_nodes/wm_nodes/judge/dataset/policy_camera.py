"""Clips of the policy's camera and plain scene: rendered, decoded or imagined by a world model.

A clip shows the window of the camera SEEN, scaled to the size of all clips. A quarter of the episodes is rendered. In
another quarter every frame but the first is encoded and decoded by a world model's tokenizer. The other half is
imagined by that model from the first frame with the recorded actions; such a clip is used only if a position probe
finds object and tool within NEAR_M of their recorded places on every frame, so that the recording's labels hold for it.
Otherwise, and where states are edited, it is decoded. Half of the successful clips end at the success or one frame
later, as episodes do; with a stride above 1, as the video model has, all clips keep their whole length.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wm_nodes.config.load import default_task
from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import clip_rules
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.dataset.edits.clips import Origin, SceneStates
from wm_nodes.judge.dataset.edits.truth import tc_level
from wm_nodes.judge.dataset.rendering import ClipStage, Drawing, EpisodeStates, SceneAppearance
from wm_nodes.judge.evidence.window import Window
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.validation.open_loop import OBJECT, TOOL, imagine

SEEN = "side"
DRAWN, DECODED, IMAGINED = "plain", "plain, decoded", "plain, imagined"
"""Origin.scene of the kinds; of the last two followed by "by" and the first digits of the world model's SHA-256."""
KINDS = {DRAWN: 0.25, DECODED: 0.25, IMAGINED: 0.5}
NEAR_M = {"object": 0.04, "tool": 0.05}
"""An imagined thing may be read so far from where the recorded one is read; an object is 4 cm wide."""
SHORTEST = 4
"""Frames of a clip that ends with its success, at least."""
LOOK = SceneAppearance(num_clutter=0, tiled=False)


def policy_window(config: SimulationConfig, side: int) -> Window:
    """The part of the policy's pictures that a judge reads. Raises ValueError: the scene has no such camera."""
    if SEEN not in config.cameras:
        raise ValueError(f"a judge of the loops' clips reads the camera {SEEN}, there are {', '.join(config.cameras)}")
    size, index = config.image_size, config.cameras.index(SEEN)
    return Window(size, size * len(config.cameras), size * index, size * (index + 1), side)


def policy_models(folder: Path) -> Path:
    """The world model's folder; the shipped one where none is named."""
    return folder if folder.name else shipped_model(default_task())


@dataclass(frozen=True)
class PolicyCamera:
    """Makes clips of the policy's camera. models: decode and imagine. side: of a frame, px. stride: steps per frame."""

    models: WorldModels
    side: int
    stride: int = 1

    @property
    def config(self) -> SimulationConfig:
        return self.models.simulation

    def origin(self, task: str, seed: int) -> Origin:
        """Behaviour and kind of drawing of an episode, drawn by `seed`."""
        rng = numpy_stream(seed, f"policy_view/{task}")
        shares = clip_rules(task).policy_behaviours
        behaviour = str(rng.choice(list(shares), p=list(shares.values())))
        kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
        return Origin(task, SEEN, "cube/blue", self._scene(kind), seed, behaviour)

    def _scene(self, kind: str) -> str:
        return kind if kind == DRAWN else f"{kind} by {self.models.sha256[:12]}"

    def end_states(self, states: SceneStates, origin: Origin) -> SceneStates:
        """The states of the frames of a clip, up to the end of its episode."""
        if self.stride > 1:
            return _take_every(states, self.stride)
        rng = numpy_stream(origin.seed, f"policy_view_end/{origin.task}")
        late, cut = int(rng.integers(2)), rng.random() < 0.5
        if not cut:
            return states
        rule = clip_rules(origin.task).label
        for end in range(SHORTEST, len(states) - late):
            if tc_level(states.at(np.arange(end)), rule) == 4:
                return states.at(np.arange(end + late))
        return states

    def draw(self, stage: ClipStage, states: SceneStates, origin: Origin) -> Drawing:
        """Draw an episode or an edit of it, decoded where it is not of the renderer's kind."""
        drawing, pictures = self.render(stage, states)
        if origin.scene != DRAWN:
            tokenizer = self.models.tokenizer
            pictures[1:] = tokenizer.decode(tokenizer.encode(pictures[1:])).cpu().numpy()
        return self._crop(drawing, pictures)

    def imagine(self, stage: ClipStage, states: SceneStates, episode: EpisodeStates) -> Drawing | None:
        """Imagine a clip from an episode's first frame and actions; None where object or tool go elsewhere.

        Args:
            states: of the clip's frames, as `end_states` gives them.

        Raises:
            ValueError: the model has no position probe.
        """
        if self.models.probe is None:
            raise ValueError("the world model has no position probe to compare with the recording; take the shipped")
        drawing, pictures = self.render(stage, states)
        steps = (len(states) - 1) * self.stride
        imagined = imagine(
            self.models.tokenizer, self.models.action, pictures[:1], episode.actions[None, :steps],
            episode.commanded[None, : steps + 1],
        )
        frames = imagined.frames[0, self.stride - 1 :: self.stride]
        seen, real = self.models.probe.read(frames), self.models.probe.read(pictures[1:])
        for name, columns in {"object": OBJECT, "tool": TOOL}.items():
            if np.linalg.norm((seen - real)[:, columns], axis=1).max() > NEAR_M[name]:
                return None
        return self._crop(drawing, np.concatenate([pictures[:1], frames]))

    def render(self, stage: ClipStage, states: SceneStates) -> tuple[Drawing, UInt8Array]:
        """The drawing of SEEN, and all cameras' pictures side by side, uint8 (T, H, W, 3)."""
        others = [name for name in self.config.cameras if name != SEEN]
        sizes_m = states.half_sizes_m * states.scales
        drawing = stage.draw(states.robot_q, states.poses, sizes_m, states.tool, states.goal, SEEN, LOOK, others)
        views = {SEEN: drawing.frames, **drawing.others}
        return drawing, np.concatenate([views[name] for name in self.config.cameras], axis=2)

    def _crop(self, drawing: Drawing, pictures: UInt8Array) -> Drawing:
        window = policy_window(self.config, self.side)
        tracks = {name: window.track(track) for name, track in drawing.tracks.items()}
        return replace(drawing, frames=window.pictures(pictures), masks=window.masks(drawing.masks), tracks=tracks)

    def mark_decoded(self, origin: Origin) -> Origin:
        """The origin of an episode whose imagined clip was refused: its pictures are decoded instead."""
        return replace(origin, scene=self._scene(DECODED))


def _take_every(states: SceneStates, stride: int) -> SceneStates:
    """Every stride-th frame; contact is true where any frame since the one before had contact."""
    chosen = states.at(np.arange(0, len(states), stride))
    touched = states.contact[1 : (len(chosen) - 1) * stride + 1].reshape(-1, stride).any(1)
    return replace(chosen, contact=np.concatenate([states.contact[:1], touched]))
