"""Episodes as a picture: one row per label, time from left to right, or as it passes. Shapes: T frames, H W 3 image."""

import io
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import UInt8Array

INK, FAINT, PAPER = (32, 32, 36), (120, 120, 128), 255
GAP_PX, HEADER_PX, FONT = 6, 26, cv2.FONT_HERSHEY_SIMPLEX
LABEL_SCALE, STEP_SCALE = 0.6, 0.5
STEP_MS, END_MS = 350, 2000
"""How long a moving picture shows a step, and its last one."""


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
    steps = _shown_steps(max(len(frames) for frames in rows.values()), max_columns, (marks or {}).values())
    cells = dict[str, list[UInt8Array | None]]()
    for label, frames in rows.items():
        if len(frames) == 1:  # a goal
            cells[label] = [None] * (len(steps) - 1) + [frames[0]]
        else:
            cells[label] = [frames[step] if step < len(frames) else None for step in steps]
    headers = [f"step {step}" if column == 0 else str(step) for column, step in enumerate(steps)]
    done = {(label, steps.index(step)) for label, step in (marks or {}).items() if label in rows and step in steps}
    picture = _sheet(cells, headers, done, scale)
    if path is not None:
        write_atomic(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return picture


def moving_picture(
    episodes: Sequence[Mapping[str, UInt8Array]], path: Path, *, scale: int = 3,
    marks: Sequence[Mapping[str, int]] = (),
) -> None:
    """Write a GIF of several episodes beside each other, a row per label, played together and again and again.

    Args:
        episodes: each as the rows of a film strip, all with the same labels; one that has ended keeps its last frame.
        path: of the GIF.
        scale: enlargement of every pixel.
        marks: of each episode, label to the step at which the row's signal said "done"; from there on the frame is
            green.

    Raises:
        ValueError: as film_strip.
    """
    from PIL import Image

    for rows in episodes:
        _check(rows)
    lasts = [max(map(len, rows.values())) - 1 for rows in episodes]
    sheets = []
    for step in range(max(lasts, default=-1) + 1):
        cells = {
            label: [rows[label][min(step, len(rows[label]) - 1)] for rows in episodes] for label in episodes[0]
        }
        done = {
            (label, column) for column, its in enumerate(marks) for label, first in its.items() if step >= first
        }
        sheets.append(_sheet(cells, [f"step {min(step, last)}" for last in lasts], done, scale))
    if not sheets:
        raise ValueError("a moving picture needs at least one episode")
    palette = Image.fromarray(np.concatenate(sheets)).quantize(256)
    first, *others = [Image.fromarray(sheet).quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    data = io.BytesIO()
    first.save(
        data, "GIF", save_all=True, append_images=others, loop=0, duration=[STEP_MS] * len(others) + [END_MS]
    )
    write_atomic(path, data.getvalue())


def _sheet(
    cells: Mapping[str, Sequence[UInt8Array | None]], headers: Sequence[str], done: Collection[tuple[str, int]],
    scale: int,
) -> UInt8Array:
    """Frames in rows with their labels left, one of `headers` above each column, and a green frame around cells in
    `done`. None stays empty."""
    height, width = (side * scale for side in next(f for row in cells.values() for f in row if f is not None).shape[:2])
    left = 16 + max(cv2.getTextSize(label, FONT, LABEL_SCALE, 1)[0][0] for label in cells)
    shape = (HEADER_PX + len(cells) * (height + GAP_PX), left + len(headers) * (width + GAP_PX), 3)
    picture = np.full(shape, PAPER, np.uint8)
    for column, text in enumerate(headers):
        x = left + column * (width + GAP_PX)
        cv2.putText(picture, text, (x + 2, HEADER_PX - 9), FONT, STEP_SCALE, FAINT, 1, cv2.LINE_AA)
    for index, (label, frames) in enumerate(cells.items()):
        y = HEADER_PX + index * (height + GAP_PX)
        cv2.putText(picture, label, (6, y + height // 2 + 6), FONT, LABEL_SCALE, INK, 1, cv2.LINE_AA)
        for column, frame in enumerate(frames):
            if frame is None:
                continue
            x = left + column * (width + GAP_PX)
            picture[y : y + height, x : x + width] = frame.repeat(scale, 0).repeat(scale, 1)
            if (label, column) in done:
                cv2.rectangle(picture, (x, y), (x + width - 1, y + height - 1), (30, 170, 80), 3)
    return picture


def _shown_steps(num_frames: int, max_columns: int, wanted: Iterable[int]) -> list[int]:
    """Evenly spaced steps; a wanted step replaces the nearest inner one that is not wanted."""
    count = min(num_frames, max_columns)
    steps = [int(step) for step in np.linspace(0, num_frames - 1, count).round()]
    wanted = {step for step in wanted if 0 < step < num_frames - 1}
    for step in sorted(wanted - {*steps}):
        if inner := [other for other in steps[1:-1] if other not in wanted]:
            steps[steps.index(min(inner, key=lambda other: abs(other - step)))] = step
    return sorted(steps)


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
