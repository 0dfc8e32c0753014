"""What the reward agent and its judges speak of: stages, states, clips and tasks.

Shapes: T frames, H W 3 image, A action. A component (clarity, robot, ...) is a name that the rubric pack defines, so
that another domain adds its own without code. Levels of a component: 0 unusable, 1 clearly wrong, 2 borderline,
3 minor flaw, 4 clean. Levels of planning: 0 invalid, 1 poor, 2 fair, 3 good. Hack patterns are read on the same five
levels: 0 surely present, 4 surely absent.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import FloatArray, UInt8Array

NUM_LEVELS = 5
NUM_PLAN_LEVELS = 4
PLANNING = "planning"
"""The one component of Stage.PLAN; its distribution has NUM_PLAN_LEVELS entries."""
TASK_COMPLETION = "task_completion"
"""The one component of Stage.TC."""
Component = str


class Stage(StrEnum):
    """What a read is for. VQ, IF, TC, PC are scored and gated, in this order."""

    PLAN = "PLAN"
    VQ = "VQ"
    IF = "IF"
    TC = "TC"
    PC = "PC"
    HACK = "HACK"
    REFLECT = "REFLECT"


GATED = (Stage.VQ, Stage.IF, Stage.TC, Stage.PC)


class Status(StrEnum):
    """OK: there is a number. SKIPPED: not read. ABSTAIN: read, but undecided. ERROR: no answer."""

    OK = "OK"
    SKIPPED = "SKIPPED"
    ABSTAIN = "ABSTAIN"
    ERROR = "ERROR"


class Profile(StrEnum):
    """Which frames a read sees (RA-3): static, instruction, end, dense."""

    S = "S"
    I = "I"  # noqa: E741
    E = "E"
    D = "D"


@dataclass(frozen=True, eq=False)
class ClipRef:
    """A clip to judge. Nothing is checked here: PRECHECK says what is wrong."""

    clip_id: str
    """Its name."""
    sha256: str
    """Of shape, fps and pixels, see clip_ref."""
    frames: UInt8Array
    """uint8 (T, H, W, 3), RGB."""
    fps: float
    """Frames per second, > 0."""
    source: Literal["rollout", "real", "adversarial"] = "rollout"
    """Where it comes from."""


def clip_ref(
    clip_id: str, frames: UInt8Array, fps: float, source: Literal["rollout", "real", "adversarial"] = "rollout"
) -> ClipRef:
    """Name a clip by its content."""
    return ClipRef(clip_id, media_sha(np.asarray(frames), fps), frames, fps, source)


def media_sha(frames: NDArray[Any], fps: float) -> str:
    """SHA-256, hexadecimal, of dtype, shape, fps and pixels."""
    head = f"{frames.dtype.str} {frames.shape} {fps!r} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(frames).tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What the clip should show."""

    instruction: str
    """To the robot, in words."""
    task_id: str
    """Name of the task; "" where unknown."""
    robot: str
    """Description for the prompt."""
    reference_frame: UInt8Array
    """uint8 (H, W, 3), the conditioning image."""
    goal_image: UInt8Array | None = None
    """The same shape; None: there is none."""
    actions: FloatArray | None = None
    """float32 (T - 1, A), action t moves frame t to frame t + 1; None where nobody knows."""


Evidence = Mapping[Component, float]
"""How strange a world model finds what each component speaks about (RA-17): normal to 1, outside above or NaN. It
triggers votes and second looks, and never adds reward."""
