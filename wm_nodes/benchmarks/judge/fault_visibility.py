"""How much of a physical fault can be seen: pixels in which a clip differs from the clean recording that it is made of.

Both lie in the set, so nothing is drawn again. Only clips with one edit, of the states: others change pixels anywhere.

    wm benchmark judge fault-visibility SET [SET ...] --part train
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from wm_nodes.core.progress import tqdm
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestRow, Part
from wm_nodes.judge.dataset.edits.recipes import RECIPES, SEEN_LEVELS
from wm_nodes.judge.dataset.set_files import load_frames
from wm_nodes.judge.training.data import load_sets, rows_of

FAINT_PX = 9
"""A fault that never changes more pixels at once than a patch of 3 x 3 is faint."""
Sets = Sequence[tuple[Path, Manifest]]
Kind = tuple[str, str]


def changed_px(folder: Path, row: ManifestRow) -> int:
    """Pixels that differ visibly from the recording, in the frame where most do.

    Raises:
        ManifestError: a file is missing or damaged.
    """
    edited, clean = (load_frames(folder, sha).astype(np.int16) for sha in (row.sha256, row.root))
    seen = np.abs(edited - clean).max(-1) > SEEN_LEVELS
    return int(seen.sum((1, 2)).max())


def visibility(sets: Sets, part: Part) -> dict[Kind, list[int]]:
    """changed_px of every clip, by severity and recipe; several edits, and other recipes, are left out."""
    counts: dict[Kind, list[int]] = defaultdict(list)
    for folder, row in tqdm(list(_select_clips(sets, part)), desc="compared", unit="clip"):
        counts[row.edits[0].severity, row.edits[0].recipe].append(changed_px(folder, row))
    return dict(sorted(counts.items()))


def _select_clips(sets: Sets, part: Part) -> Iterator[tuple[Path, ManifestRow]]:
    for folder, manifest in sets:
        for row in rows_of(manifest, [part]):
            if len(row.edits) == 1 and RECIPES[row.edits[0].recipe].kind == "S":
                yield folder, row


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sets", type=Path, nargs="+", help="folders made by build-judge-dataset, of one division")
    parser.add_argument("--part", choices=("train", "validation", "test"), default="train")


def run(arguments: argparse.Namespace) -> None:
    """Print a line per recipe."""
    counts = visibility(load_sets(arguments.sets), arguments.part)
    if not counts:
        raise ValueError(f"no {arguments.part} clip has one edit of its states; build larger sets")
    print(f"pixels changed by more than {SEEN_LEVELS} of 255 in the most changed frame")
    print(f"{'severity':8} {'recipe':14} {'n':>5} {'least':>6} {'5 %':>6} {'median':>6} {'faint':>6}")
    for (severity, recipe), values in counts.items():
        low, middle = np.quantile(values, (0.05, 0.5))
        faint = sum(value <= FAINT_PX for value in values)
        print(f"{severity:8} {recipe:14} {len(values):5} {min(values):6} {low:6.0f} {middle:6.0f} {faint:6}")
