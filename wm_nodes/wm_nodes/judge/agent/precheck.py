"""Checks of a clip that need no model (RA-2). Shapes: T frames, H W 3 image.

Two kinds of refusal. `malformed`: a mistake of the caller (one frame, NaN pixels, wrong encoding, no instruction); the
verdict is an ERROR without a reward. `no video`: a well-formed clip that is black or still; the verdict is level 0 with
reward 0.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from wm_nodes.judge.agent.types import ClipRef, TaskSpec

BLACK_MAX = 8
"""A clip is black where no pixel is brighter, of 255."""
STILL_MAX = 2
"""Frames are equal where no pixel differs by more, of 255."""
MIN_ACTION = 1e-6


@dataclass(frozen=True)
class Precheck:
    kind: Literal["ok", "malformed", "no video"]
    reason: str = ""


def precheck(clip: ClipRef, task: TaskSpec) -> Precheck:
    """Check a clip and its task."""
    if fault := _format_problem(clip, task):
        return Precheck("malformed", fault)
    if clip.frames.max() <= BLACK_MAX:
        return Precheck("no video", f"all black: no pixel above {BLACK_MAX} of 255")
    moved = task.actions is not None and bool((np.abs(task.actions) > MIN_ACTION).any())
    first = clip.frames[0].astype(np.int16)
    if moved and all(np.abs(frame - first).max() <= STILL_MAX for frame in clip.frames[1:]):
        return Precheck("no video", f"all {len(clip.frames)} frames are equal while the actions are not zero")
    return Precheck("ok")


def _format_problem(clip: ClipRef, task: TaskSpec) -> str:
    frames, reference, goal = clip.frames, task.reference_frame, task.goal_image
    if frames.ndim != 4 or frames.shape[3] != 3 or 0 in frames.shape:
        return f"frames must have shape (T, H, W, 3), got {frames.shape}"
    if np.issubdtype(frames.dtype, np.floating) and not np.isfinite(frames).all():
        return "frames hold pixels that are not finite"
    if frames.dtype != np.uint8:
        return f"frames must be uint8 RGB, got {frames.dtype}; scale to 0..255 and convert"
    if len(frames) < 2:
        return f"a clip needs at least 2 frames, got {len(frames)}"
    if not (np.isfinite(clip.fps) and clip.fps > 0):
        return f"fps must be finite and > 0, got {clip.fps}"
    if not task.instruction.strip():
        return "the instruction is empty; say what the clip should show"
    for name, image in (("reference_frame", reference), ("goal_image", goal)):
        if image is not None and (image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size):
            return f"{name} must be uint8 (H, W, 3), got {image.dtype} {image.shape}"
    if task.actions is not None:
        if task.actions.ndim != 2 or len(task.actions) != len(frames) - 1:
            return f"actions must have shape ({len(frames) - 1}, A) for {len(frames)} frames, got {task.actions.shape}"
        if not np.isfinite(task.actions).all():
            return "actions are not finite"
    return ""

