"""Clips of a benchmark set as a judge sees them: pixels, instruction, reference image (RA-21)."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from wm_nodes.judge.agent.types import ClipRef, TaskSpec
from wm_nodes.judge.dataset.build import clip_path, instruction_of, load_frames
from wm_nodes.judge.dataset.edits import Manifest, ManifestError
from wm_nodes.judge.dataset.edits.manifest import ManifestRow, Part

ROBOT = "panda"
MIN_TEST_CLIPS = 400
"""Below this the intervals are too wide to claim anything."""


def read_clip(folder: Path, row: ManifestRow) -> tuple[ClipRef, TaskSpec]:
    """A clip and what it should show. The reference image is the first frame of the recorded clip, as a video model
    would have been given it; actions are not told: most edits are none of the robot's.

    Raises:
        ManifestError: a file is missing, damaged or holds another clip.
    """
    frames = load_frames(folder, row.sha256)
    first = frames[0] if row.root == row.sha256 else load_frames(folder, row.root)[0]
    clip = ClipRef(row.sha256[:16], row.sha256, frames, _fps(folder, row), "adversarial" if row.edits else "rollout")
    return clip, TaskSpec(
        instruction_of(row.origin), row.origin.task, ROBOT, first, camera_id=row.origin.camera
    )


def select_rows(manifest: Manifest, part: Part, count: int | None = None) -> list[ManifestRow]:
    """The clips of a part in the order of their hashes, which is as good as drawn by lot; the first `count` of them.

    The test split of a set is chosen_rows(manifest, "test"): frozen by the manifest, the same on every machine.

    Raises:
        ManifestError: the part has no clips.
    """
    rows = [row for row in manifest.rows if row.part == part][:count]
    if not rows:
        raise ManifestError(f"the set has no {part} clips; build it with more episodes")
    return rows


def _fps(folder: Path, row: ManifestRow) -> float:
    path = clip_path(folder, row.sha256)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return float(arrays["fps"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ManifestError(f"{path} cannot be read: {error}; build the set again") from error
