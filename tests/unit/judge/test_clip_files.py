"""Clips as one picture each: the frames of a .png, one below the other."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import clip_ref
from wm_nodes.judge.clip_files import ClipLine, read_job


@pytest.fixture
def frames() -> UInt8Array:
    return np.random.default_rng(0).integers(0, 256, (5, 8, 12, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path, frames: UInt8Array) -> Path:
    cv2.imwrite(str(tmp_path / "a.png"), frames.reshape(-1, 12, 3)[..., ::-1])
    return tmp_path


def test_frames_below_each_other_are_the_clip_to_the_bit(folder: Path, frames: UInt8Array) -> None:
    known = clip_ref("a", frames, 4.0)
    job = read_job(folder, ClipLine(file="a.png", frames=5, fps=4, instruction="push", sha256=known.sha256))
    assert job.problem == "" and (job.clip.frames == frames).all()
    assert job.clip.sha256 == known.sha256 and job.clip.clip_id == "a"
    assert (job.task.reference_frame == frames[0]).all()


def test_a_picture_that_cannot_be_cut_says_so(folder: Path) -> None:
    job = read_job(folder, ClipLine(file="a.png", frames=3, instruction=""))
    assert "40 px high, no multiple of 3 frames" in job.problem


def test_frames_are_counted_for_pictures_and_for_nothing_else(folder: Path) -> None:
    assert "`frames` says how many" in read_job(folder, ClipLine(file="a.png", instruction="")).problem
    assert "no other file" in read_job(folder, ClipLine(file="a.npy", frames=5, instruction="")).problem
