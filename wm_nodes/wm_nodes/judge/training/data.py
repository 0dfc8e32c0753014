"""Clips of adversarial sets, several sets at once, with their masks (RA-21).

Shapes: T frames, H W 3 image.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import TaskSpec
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestError, ManifestRow, Part
from wm_nodes.judge.dataset.rows import read_clip
from wm_nodes.judge.dataset.set_files import load_array, load_set


@dataclass(frozen=True, eq=False)
class SetClip:
    """One clip of a set. frames: uint8 (T, H, W, 3). masks: uint8 (T, H, W), what belongs where, seen or not."""

    row: ManifestRow
    frames: UInt8Array
    masks: UInt8Array
    task: TaskSpec


def load_sets(folders: Sequence[Path]) -> list[tuple[Path, Manifest]]:
    """Read sets that are used together. Raises ManifestError: damaged, or of different divisions. OSError."""
    sets = [(folder, load_set(folder)) for folder in folders]
    first = sets[0][1].division
    for folder, manifest in sets:
        if manifest.division != first:
            raise ManifestError(
                f"{folder} holds out {manifest.division}, {sets[0][0]} {first}; use sets of one division"
            )
    return sets


def rows_of(manifest: Manifest, parts: Sequence[Part]) -> list[ManifestRow]:
    """The clips of some parts, in the order of the manifest."""
    return [row for row in manifest.rows if row.part in parts]


def set_clips(sets: Sequence[tuple[Path, Manifest]], parts: Sequence[Part]) -> Iterator[SetClip]:
    """Yield the clips of some parts of all sets. Raises ManifestError: a file is missing or damaged."""
    for folder, manifest in sets:
        for row in rows_of(manifest, parts):
            clip, task = read_clip(folder, row)
            yield SetClip(row, clip.frames, load_array(folder, row.sha256, "masks"), task)
