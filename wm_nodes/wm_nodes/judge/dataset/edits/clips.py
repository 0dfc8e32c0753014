"""Clips whose truth is known, and what is known of them (RA-21).

Shapes: T frames, H W 3 image, J joints, K things, 7 pose (x y z in m, quaternion w x y z), world frame. Thing 0 is the
one that the instruction names. The table top is z = 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.judge.agent.types import ClipRef, clip_ref

Component = Literal[
    "clarity", "brightness", "color", "temporal", "background", "objective", "robot", "viewpoint", "interaction",
    "deformation", "geometry",
]
Pattern = Literal["occlusion", "motion", "background", "physics"]
Severity = Literal["clean", "mild", "fail"]

COMPONENTS: tuple[Component, ...] = get_args(Component)
"""What a clip is labelled on besides TC; the names of the robot rubric pack, in its order."""
PHYSICS: tuple[Component, ...] = ("interaction", "deformation", "geometry")
TC = "task_completion"
TC_PASS_LEVEL = 3
"""TC passes from "nearly" on: level 2 is as likely to fail as to pass (RA-5), so a certain 2 has p_fail 0.5."""

BACKGROUND, ROBOT, OBJECT, DISTRACTOR = 0, 1, 2, 3
"""Values of a mask. OBJECT is thing 0; DISTRACTOR is clutter that has no part in the task, and belongs to the scene."""
MIN_SIDE_PX = 96
"""Below this nobody can judge contact or shape."""


class NotApplicableError(ValueError):
    """A recipe has nothing to work on in this clip, e.g. no motion to freeze; the generator takes another one."""


@dataclass(frozen=True, eq=False)
class SceneStates:
    """What the simulator knew at each frame; enough to draw the clip again without stepping physics.

    robot_q: (T, J), rad or m. tool: (T, 3) m, the point between the finger tips. gripper_m: (T,), opening between the
    fingers. poses: (T, K, 7). scales: (T, K, 3), 1 is the true size. half_sizes_m: (K, 3) before scaling. contact:
    bool (T,), the robot touches thing 0. goal: (T, 3) m, NaN on axes that do not count. flags: the task's own
    sub-flags (grasped, placed, ...), bool (T,) each. All floats are float32.
    """

    robot_q: FloatArray
    tool: FloatArray
    gripper_m: FloatArray
    poses: FloatArray
    scales: FloatArray
    half_sizes_m: FloatArray
    contact: BoolArray
    goal: FloatArray
    flags: Mapping[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        num_frames, things = len(self.poses), self.poses.shape[1] if self.poses.ndim == 3 else 0
        wanted = {
            "robot_q": (num_frames, self.robot_q.shape[-1]), "tool": (num_frames, 3), "gripper_m": (num_frames,),
            "poses": (num_frames, max(1, things), 7), "scales": (num_frames, things, 3), "half_sizes_m": (things, 3),
            "contact": (num_frames,), "goal": (num_frames, 3),
        }
        arrays = {name: getattr(self, name) for name in wanted} | {f"flags[{n}]": v for n, v in self.flags.items()}
        for name, values in arrays.items():
            shape, dtype = wanted.get(name, (num_frames,)), bool if name[:5] in ("conta", "flags") else np.float32
            if values.shape != shape or values.dtype != dtype:
                raise ValueError(
                    f"states.{name} must be {np.dtype(dtype)} {shape}, got {values.dtype} {values.shape}; "
                    "record every field once per frame"
                )

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def thing(self) -> FloatArray:
        """(T, 3), the centre of thing 0."""
        return self.poses[:, 0, :3]

    @property
    def bottom_m(self) -> FloatArray:
        """(T,), how far thing 0 is above the table; < 0 inside of it. Of a box that stands upright."""
        bottom: FloatArray = self.poses[:, 0, 2] - self.half_sizes_m[0, 2] * self.scales[:, 0, 2]
        return bottom

    def at(self, order: NDArray[np.intp]) -> "SceneStates":
        """The states at frames `order`."""
        moved = {f.name: getattr(self, f.name)[order] for f in fields(self) if f.name not in ("half_sizes_m", "flags")}
        return replace(self, **moved, flags={name: values[order] for name, values in self.flags.items()})


@dataclass(frozen=True)
class Origin:
    """Where a recorded clip comes from; the splits are made of this. object_id: shape and colour, e.g. "cube/blue".
    scene: table, light and clutter. behaviour: who acted (expert, near_miss, ...).
    """

    task: str
    camera: str
    object_id: str
    scene: str
    seed: int
    behaviour: str = ""


@dataclass(frozen=True, eq=False)
class SourceClip:
    """A rendered clip with all that is known about its pixels.

    frames: uint8 (T, H, W, 3) RGB, T >= 4, H and W >= 96. masks: uint8 (T, H, W) of BACKGROUND, ROBOT, OBJECT,
    DISTRACTOR. tracks: name -> float32 (T, 2) row and column in px, whole numbers at pixel centres, NaN out of view;
    "object" and "tool" at least. After an edit of pixels, masks and tracks say what belongs where, seen or not.

    Raises:
        ValueError: wrong shapes or types; names what, and the remedy.
    """

    frames: UInt8Array
    masks: UInt8Array
    tracks: Mapping[str, FloatArray]
    states: SceneStates
    origin: Origin
    instruction: str
    fps: float

    def __post_init__(self) -> None:
        shape = self.frames.shape
        if self.frames.dtype != np.uint8 or len(shape) != 4 or shape[-1] != 3 or len(self.frames) < 4:
            raise ValueError(f"frames must be uint8 (T >= 4, H, W, 3), got {self.frames.dtype} {shape}")
        if min(shape[1:3]) < MIN_SIDE_PX:
            raise ValueError(f"frames must be >= {MIN_SIDE_PX} px high and wide, got {shape[1:3]}; render them larger")
        if self.masks.dtype != np.uint8 or self.masks.shape != shape[:3] or self.masks.max() > DISTRACTOR:
            raise ValueError(
                f"masks must be uint8 {shape[:3]} of 0 to {DISTRACTOR}, got {self.masks.dtype} {self.masks.shape} up "
                f"to {self.masks.max()}; render the segmentation with the frames"
            )
        if len(self.states) != shape[0]:
            raise ValueError(f"{shape[0]} frames have {len(self.states)} states; record one per frame")
        for name in {"object", "tool"} | set(self.tracks):
            track = self.tracks.get(name, np.zeros(0))
            if track.shape != (shape[0], 2):
                raise ValueError(f"track {name!r} must be ({shape[0]}, 2), got {track.shape}; project it per frame")
        if not self.fps > 0:
            raise ValueError(f"fps must be > 0, got {self.fps}")

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, order: NDArray[np.intp]) -> "SourceClip":
        """The clip played in another order: frame t is frame order[t], with all that is known about it."""
        return replace(
            self, frames=self.frames[order], masks=self.masks[order], states=self.states.at(order),
            tracks={name: track[order] for name, track in self.tracks.items()},
        )


@dataclass(frozen=True)
class ClipTruth:
    """What is known of a clip. components: name -> passed. One that is left out is unknown: a recipe made it
    ambiguous, and no judge is measured on it. tc_level: 0 none, 1 started, 2 half, 3 nearly, 4 done. pattern: the
    hacking pattern that is present.

    Raises:
        ValueError: an unknown name or level, or an unknown component in a clip where nothing else fails: then nobody
            knows the overall label either.
    """

    components: Mapping[Component, bool]
    tc_level: int
    pattern: Pattern | None = None

    def __post_init__(self) -> None:
        foreign = sorted(set(self.components) - set(COMPONENTS))
        if foreign or not 0 <= self.tc_level <= 4:
            raise ValueError(f"labels need names of {', '.join(COMPONENTS)} and a level 0 to 4, got {foreign}, {self}")
        if self.overall and len(self.components) < len(COMPONENTS):
            missing = sorted(set(COMPONENTS) - set(self.components))
            raise ValueError(f"{', '.join(missing)} unknown and nothing fails: nobody knows the whole; drop the clip")

    @property
    def passed(self) -> dict[str, bool]:
        """Every known component and task completion -> passed."""
        return {**{str(name): ok for name, ok in self.components.items()}, TC: self.tc_level >= TC_PASS_LEVEL}

    @property
    def overall(self) -> bool:
        """Nothing fails."""
        return all(self.passed.values())


@dataclass(frozen=True)
class Edit:
    """One recipe as it was applied. seed: with the parent's SHA-256 and the recipe it fixes everything random.
    amount: what was drawn, in the recipe's unit.
    """

    recipe: str
    severity: Severity
    seed: int
    amount: float


@dataclass(frozen=True, eq=False)
class LabelledClip:
    """A clip and its labels. root: SHA-256 of the recorded clip that all `edits` began with; its own where none is."""

    clip: SourceClip
    labels: ClipTruth
    edits: tuple[Edit, ...] = ()
    root: str = ""
    ref: ClipRef = field(init=False)

    def __post_init__(self) -> None:
        ref = clip_ref("", self.clip.frames, self.clip.fps, "adversarial" if self.edits else "rollout")
        object.__setattr__(self, "ref", replace(ref, clip_id=ref.sha256[:16]))
        object.__setattr__(self, "root", self.root or ref.sha256)

    @property
    def sha256(self) -> str:
        """Of fps and pixels."""
        return self.ref.sha256

    @property
    def recipe(self) -> str:
        """The last edit's; "" for a recorded clip."""
        return self.edits[-1].recipe if self.edits else ""

    @property
    def severity(self) -> Severity:
        """fail where any edit is meant to fail, else mild; clean without edits."""
        kinds = {edit.severity for edit in self.edits}
        return "fail" if "fail" in kinds else "mild" if kinds else "clean"
