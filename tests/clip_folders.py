"""Folders of clips with their clips.jsonl."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from audit_logs import moving_squares


def write_clips(folder: Path, **changed: Any) -> list[dict[str, Any]]:
    """A video, and an array with a picture that it had to start from and the hash of its content."""
    (first, task), (second, _) = moving_squares(2)
    video = cv2.VideoWriter(str(folder / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (96, 96))
    for frame in first.frames:
        video.write(np.ascontiguousarray(frame[..., ::-1]))
    video.release()
    np.save(folder / "b.npy", second.frames)
    cv2.imwrite(str(folder / "start.png"), second.frames[0][..., ::-1])
    lines = [
        {"file": "a.mp4", "instruction": task.instruction},
        {"file": "b.npy", "instruction": task.instruction, "clip_id": "mine", "fps": 10, "reference": "start.png",
         "sha256": second.sha256, **changed},
    ]
    (folder / "clips.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return lines
