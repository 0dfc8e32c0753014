"""Read the clips of a benchmark set as a judge gets them: pixels, instruction, reference image (RA-21)."""

from pathlib import Path

from wm_nodes.judge.agent.types import ClipRef, TaskSpec
from wm_nodes.judge.dataset.build import instruction_of
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestError, ManifestRow, Part
from wm_nodes.judge.dataset.set_files import load_array, load_frames

ROBOT = "panda"
MIN_TEST_CLIPS = 400
"""Below this the intervals are too wide to claim anything."""


def read_clip(folder: Path, row: ManifestRow) -> tuple[ClipRef, TaskSpec]:
    """Read a clip and its task. Raises ManifestError: a file is missing, damaged or holds another clip.

    The reference image is the first frame of the recorded clip, which a video model would be conditioned on. The task
    has no actions, because most edits do not follow from the robot's.
    """
    frames = load_frames(folder, row.sha256)
    first = frames[0] if row.root == row.sha256 else load_frames(folder, row.root)[0]
    fps = float(load_array(folder, row.sha256, "fps"))
    clip = ClipRef(row.sha256[:16], row.sha256, frames, fps, "adversarial" if row.edits else "rollout")
    return clip, TaskSpec(instruction_of(row.origin), row.origin.task, ROBOT, first, camera_id=row.origin.camera)


def select_rows(manifest: Manifest, part: Part, count: int | None = None) -> list[ManifestRow]:
    """The first `count` clips of a part in the order of their hashes, a random one. Raises ManifestError: no clips."""
    rows = [row for row in manifest.rows if row.part == part][:count]
    if not rows:
        raise ManifestError(f"the set has no {part} clips; build it with more episodes")
    return rows
