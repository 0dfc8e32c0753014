"""Episodes as a picture: one row per label, time from left to right. Shapes: T frames, H W 3 image."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import UInt8Array

INK, FAINT, PAPER = (32, 32, 36), (120, 120, 128), 255
GAP_PX, HEADER_PX, FONT = 6, 26, cv2.FONT_HERSHEY_SIMPLEX
LABEL_SCALE, STEP_SCALE = 0.6, 0.5


def film_strip(
    rows: Mapping[str, UInt8Array], path: Path | None = None, *, scale: int = 2, max_columns: int = 7,
    marks: Mapping[str, int] | None = None,
) -> UInt8Array:
    """Draw frames 0, ..., T - 1 of each row; labels left, step numbers on top, pixels enlarged as they are.

    Of long rows, max_columns frames evenly apart are shown, first and last among them. A row of one frame (a goal)
    stands under the last column. A shorter row (an episode that ended) leaves its last columns empty.

    Args:
        rows: label to uint8 (T, H, W, 3), all of one H and W.
        path: PNG to write; None: only return the picture.
        scale: enlargement of every pixel.
        marks: label to the step at which the row's signal said "done"; that frame gets a green frame.

    Returns:
        The picture, uint8 RGB.

    Raises:
        ValueError: no rows, or frames that are not uint8 (T, H, W, 3) of one size.
    """
    _check(rows)
    if scale < 1 or max_columns < 2:
        raise ValueError(f"scale must be >= 1 and max_columns >= 2, got {scale} and {max_columns}")
    height, width = (side * scale for side in next(iter(rows.values())).shape[1:3])
    steps = _shown_steps(max(len(frames) for frames in rows.values()), max_columns, (marks or {}).values())
    left = 16 + max(cv2.getTextSize(label, FONT, LABEL_SCALE, 1)[0][0] for label in rows)
    shape = (HEADER_PX + len(rows) * (height + GAP_PX), left + len(steps) * (width + GAP_PX), 3)
    picture = np.full(shape, PAPER, np.uint8)
    for column, step in enumerate(steps):
        x = left + column * (width + GAP_PX)
        text = f"step {step}" if column == 0 else str(step)
        cv2.putText(picture, text, (x + 2, HEADER_PX - 9), FONT, STEP_SCALE, FAINT, 1, cv2.LINE_AA)
    for index, (label, frames) in enumerate(rows.items()):
        y = HEADER_PX + index * (height + GAP_PX)
        cv2.putText(picture, label, (6, y + height // 2 + 6), FONT, LABEL_SCALE, INK, 1, cv2.LINE_AA)
        for column, step in enumerate(steps):
            is_goal = len(frames) == 1
            if (column < len(steps) - 1) if is_goal else step >= len(frames):
                continue
            x = left + column * (width + GAP_PX)
            frame = frames[0 if is_goal else step]
            picture[y : y + height, x : x + width] = frame.repeat(scale, 0).repeat(scale, 1)
            if marks and marks.get(label) == step:
                cv2.rectangle(picture, (x, y), (x + width - 1, y + height - 1), (30, 170, 80), 3)
    if path is not None:
        write_atomic(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return picture


def _shown_steps(num_frames: int, max_columns: int, wanted: Iterable[int]) -> list[int]:
    """Evenly spaced steps; a wanted step replaces its nearest inner neighbour."""
    count = min(num_frames, max_columns)
    steps = [int(step) for step in np.linspace(0, num_frames - 1, count).round()]
    for step in wanted:
        if count > 2 and 0 < step < num_frames - 1 and step not in steps:
            inner = np.asarray(steps[1:-1])
            steps[1 + int(np.abs(inner - step).argmin())] = step
    return sorted(set(steps))


def _check(rows: Mapping[str, UInt8Array]) -> None:
    if not rows:
        raise ValueError("a film strip needs at least one row of frames")
    sizes = set()
    for label, frames in rows.items():
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[-1] != 3 or not len(frames):
            raise ValueError(f"row {label!r} must be uint8 (T, H, W, 3) with T >= 1, got {frames.dtype} {frames.shape}")
        sizes.add(frames.shape[1:3])
    if len(sizes) > 1:
        raise ValueError(f"all rows of a film strip must have one image size, got {sorted(sizes)}")
