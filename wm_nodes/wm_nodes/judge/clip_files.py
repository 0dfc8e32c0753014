"""A folder of clips to judge: video files, and clips.jsonl with the task of each."""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wm_nodes.core.files import file_sha256
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import ClipRef, TaskSpec, clip_ref
from wm_nodes.judge.service import ClipJob

LIST = "clips.jsonl"
AT_ONCE = 64
"""Clips whose pixels are held at a time, as long as the judge does not take more at once."""


class ClipLine(BaseModel):
    """One line of clips.jsonl. Paths are relative to its folder."""

    model_config = ConfigDict(extra="forbid")

    file: Annotated[str, Field(min_length=1)]
    """A video, or a .npy of uint8 (F, H, W, 3), RGB."""
    instruction: str
    clip_id: str = ""
    task_id: str = ""
    robot: str = "panda"
    fps: Annotated[float, Field(gt=0)] = 5.0
    """Of a .npy; a video has its own."""
    reference: str = ""
    """The conditioning image; empty: the first frame."""
    goal: str = ""
    """An image of the goal."""
    sha256: str = ""
    """Of the clip's content; checked where given."""


def read_list(folder: Path) -> list[ClipLine]:
    """The lines of clips.jsonl. Raises ValueError: no such file, or a bad line; names line, field and problem."""
    path = folder / LIST
    if not path.is_file():
        raise ValueError(
            f'{path} is missing: one line per clip, e.g. {{"file": "a.mp4", "instruction": "push the cube", "task_id": '
            '"push_cube"}'
        )
    lines = []
    for number, text in enumerate(path.read_text().splitlines(), 1):
        if not text.strip():
            continue
        try:
            lines.append(ClipLine.model_validate_json(text))
        except ValidationError as error:
            first = error.errors(include_input=False, include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "line"
            raise ValueError(f"{path}:{number}: {where}: {first['msg']}") from None
    return lines


def list_sha256(folder: Path, announced: str = "") -> str:
    """SHA-256 of clips.jsonl. Raises ValueError: it is not the announced one. OSError: it cannot be read."""
    path = folder / LIST
    digest = file_sha256(path)
    if announced and digest != announced:
        raise ValueError(f"{path} is not the announced list ({digest[:12]}, not {announced[:12]}); copy it again")
    return digest


def read_job(folder: Path, line: ClipLine) -> ClipJob:
    """A clip with its pixels. Raises ValueError: an unreadable file, or another content than its sha256; names it."""
    path = folder / line.file
    clip = _read_frames(path, line.fps) if path.suffix == ".npy" else read_video(path)
    if line.sha256 and clip.sha256 != line.sha256:
        raise ValueError(f"{path} has content {clip.sha256}, not {line.sha256}; copy it again")
    clip = ClipRef(line.clip_id or path.stem, clip.sha256, clip.frames, clip.fps)
    reference = read_picture(folder / line.reference) if line.reference else clip.frames[0]
    goal = read_picture(folder / line.goal) if line.goal else None
    return ClipJob(clip, TaskSpec(line.instruction, line.task_id, line.robot, reference, goal))


def read_video(path: Path) -> ClipRef:
    """Every frame of a video, RGB. Raises ValueError: no readable video of two frames or more."""
    capture = cv2.VideoCapture(str(path))
    fps, frames = capture.get(cv2.CAP_PROP_FPS), []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    capture.release()
    if len(frames) < 2 or not fps > 0:
        raise ValueError(f"{path} is no readable video: {len(frames)} frames at {fps:g} per second")
    return clip_ref(path.stem, np.stack(frames), fps)


def read_picture(path: Path) -> UInt8Array:
    """uint8 (H, W, 3), RGB. Raises ValueError where it cannot be read."""
    image = cv2.imread(str(path))
    if image is None:
        raise ValueError(f"{path} is no readable picture")
    return np.ascontiguousarray(image[..., ::-1], np.uint8)


def _read_frames(path: Path, fps: float) -> ClipRef:
    """Load an array of frames; the agent checks their shape and type."""
    try:
        frames = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is no readable array: {error}") from None
    return clip_ref(path.stem, frames, fps)
