"""A folder of clips to judge: video files, and clips.jsonl with the task of each."""

import hashlib
import os
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Annotated

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wm_nodes.core.files import text_lines
from wm_nodes.core.named_files import CLIP, CLIP_LIST, PICTURE, FileKind, read_regular
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import ClipRef, TaskSpec, clip_ref
from wm_nodes.judge.service import ClipJob

LIST = "clips.jsonl"
Read = Callable[[Path, FileKind], bytes]
"""How the files are read: by default from anywhere; raises ValueError for one that is refused, OSError."""
NO_FRAMES = np.zeros((0, 0, 0, 3), np.uint8)
"""Of a clip that cannot be read."""
AT_ONCE = 64
"""Clips whose pixels are held at a time, as long as the judge does not take more at once."""


class ClipLine(BaseModel):
    """One line of clips.jsonl. Paths are relative to its folder."""

    model_config = ConfigDict(extra="forbid")

    file: Annotated[str, Field(min_length=1)]
    """A video, a .npy of uint8 (F, H, W, 3), RGB, or a .png of the frames one below the other."""
    frames: Annotated[int, Field(ge=2)] | None = None
    """How many a .png holds; of no other file."""
    instruction: str
    """What the clip should show."""
    clip_id: str = ""
    """Empty: the file's name without its ending."""
    task_id: str = ""
    """Name of the task, which chooses an embedded judge."""
    robot: str = "panda"
    """Description for the prompt."""
    fps: Annotated[float, Field(gt=0)] = 5.0
    """Of a .npy or .png; a video has its own."""
    reference: str = ""
    """The conditioning image; empty: the first frame."""
    goal: str = ""
    """An image of the goal."""
    sha256: str = ""
    """Of the clip's content; checked where given."""


def read_list(folder: Path, read: Read = read_regular) -> list[ClipLine]:
    """The lines of clips.jsonl. Raises ValueError: no such file, or a bad line; names line, field and problem."""
    path = folder / LIST
    try:
        content = text_lines(read(path, CLIP_LIST))
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(
            f'{path} is missing: one line per clip, e.g. {{"file": "a.mp4", "instruction": "lift the lid", "task_id": '
            '"push"}'
        ) from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text in UTF-8: {error}; write the list again") from None
    lines = []
    for number, text in enumerate(content, 1):
        if not text.strip():
            continue
        try:
            lines.append(ClipLine.model_validate_json(text))
        except ValidationError as error:
            first = error.errors(include_input=False, include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "line"
            raise ValueError(f"{path}:{number}: {where}: {first['msg']}") from None
    return lines


def list_sha256(folder: Path, announced: str = "", read: Read = read_regular) -> str:
    """SHA-256 of clips.jsonl. Raises ValueError: it is not the announced one. OSError: it cannot be read."""
    path = folder / LIST
    digest = hashlib.sha256(read(path, CLIP_LIST)).hexdigest()
    if announced and digest != announced:
        raise ValueError(f"{path} is not the announced list ({digest[:12]}, not {announced[:12]}); copy it again")
    return digest


def read_job(folder: Path, line: ClipLine, read: Read = read_regular) -> ClipJob:
    """A clip with its pixels; where they cannot be read, a job whose `problem` says why, and the others are judged."""
    try:
        return _read_job(folder, line, read)
    except (ValueError, cv2.error) as error:
        task = TaskSpec(line.instruction, line.task_id, line.robot, NO_FRAMES)
        return ClipJob(ClipRef(line.clip_id or Path(line.file).stem, "", NO_FRAMES, line.fps), task, str(error))


def _read_job(folder: Path, line: ClipLine, read: Read) -> ClipJob:
    """Raises ValueError: an unreadable file, or another content than its sha256; names it."""
    path = folder / line.file
    if (line.frames is None) == (path.suffix == ".png"):
        raise ValueError(f"{path}: `frames` says how many frames a .png holds, and goes with no other file")
    if line.frames:
        clip = _read_strip(path, line.frames, line.fps, read)
    else:
        clip = _read_frames(path, line.fps, read) if path.suffix == ".npy" else read_video(path, read)
    if line.sha256 and clip.sha256 != line.sha256:
        raise ValueError(f"{path} has content {clip.sha256}, not {line.sha256}; copy it again")
    clip = ClipRef(line.clip_id or path.stem, clip.sha256, clip.frames, clip.fps)
    reference = read_picture(folder / line.reference, read) if line.reference else clip.frames[0]
    goal = read_picture(folder / line.goal, read) if line.goal else None
    return ClipJob(clip, TaskSpec(line.instruction, line.task_id, line.robot, reference, goal))


def read_video(path: Path, read: Read = read_regular) -> ClipRef:
    """Every frame of a video, RGB. Raises ValueError: no readable video of two frames or more."""
    descriptor = os.memfd_create("clip")  # OpenCV reads videos by name only
    try:
        with open(descriptor, "wb", closefd=False) as file:
            file.write(_bytes_of(path, CLIP, "video", read))
        capture = cv2.VideoCapture(f"/proc/self/fd/{descriptor}", cv2.CAP_FFMPEG)
        fps, frames = capture.get(cv2.CAP_PROP_FPS), []
        while (following := capture.read())[0]:
            frames.append(following[1][..., ::-1])
        capture.release()
    finally:
        os.close(descriptor)
    if len(frames) < 2 or not fps > 0:
        raise ValueError(f"{path} is no readable video: {len(frames)} frames at {fps:g} per second")
    return clip_ref(path.stem, np.stack(frames), fps)


def read_picture(path: Path, read: Read = read_regular) -> UInt8Array:
    """uint8 (H, W, 3), RGB. Raises ValueError where it cannot be read."""
    data = np.frombuffer(_bytes_of(path, PICTURE, "picture", read), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise ValueError(f"{path} is no readable picture")
    return np.ascontiguousarray(image[..., ::-1], np.uint8)


def _read_frames(path: Path, fps: float, read: Read) -> ClipRef:
    """Load an array of frames; the agent checks their shape and type."""
    try:
        data = BytesIO(_bytes_of(path, CLIP, "array", read))
        frames = np.lib.format.read_array(data, allow_pickle=False)  # type: ignore[no-untyped-call]
    except (ValueError, EOFError, SyntaxError, TokenError, MemoryError) as error:  # its header may say anything
        raise ValueError(f"{path} is no readable array: {error}") from None
    if frames.ndim != 4 or not frames.size:
        raise ValueError(f"{path} holds {frames.dtype} {frames.shape}, not frames (F, H, W, 3); write it again")
    return clip_ref(path.stem, frames, fps)


def _read_strip(path: Path, num_frames: int, fps: float, read: Read) -> ClipRef:
    """Cut a picture into frames of equal height."""
    strip = read_picture(path, read)
    if len(strip) % num_frames:
        raise ValueError(f"{path} is {len(strip)} px high, no multiple of {num_frames} frames; correct `frames`")
    return clip_ref(path.stem, strip.reshape(num_frames, -1, *strip.shape[1:]), fps)


def _bytes_of(path: Path, kind: FileKind, what: str, read: Read) -> bytes:
    try:
        return read(path, kind)
    except OSError as error:
        raise ValueError(f"{path} is no readable {what}: {error.strerror}") from None
