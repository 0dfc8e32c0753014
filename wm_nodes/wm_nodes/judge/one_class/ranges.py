"""What the numbers of a clip are where nothing is wrong, and the limit that follows (RA-27).

The recordings say where each number lies and how far it goes. How far a recording's strangest number goes in the ranges
of the other parts of the recordings gives the limit. No fault is ever shown. Shapes: N clips, F numbers.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import ModelFolderError, read_json
from wm_nodes.judge.one_class import imagination, pictures

Floats = NDArray[np.float64]

FORMAT = "normal-ranges-2"
COMPONENTS = {**pictures.COMPONENTS, **imagination.COMPONENTS}
NAMES = tuple(sorted(COMPONENTS))
KEPT = 0.97
"""Share of the recordings, in every form, whose strangest number stays within the limit."""
WITHIN = 0.99
"""Share of the recordings whose largest value of a number is within its spread."""
WRONGLY_DONE = 0.1
"""Share of undone recordings that is said to be done."""
FOLDS = 5
"""Parts of the recordings, each scored by the ranges of the others."""
LEAST = 100
"""Recordings that are needed."""
LEAST_SPREAD = {"_m": 0.01, "_px": 1.0, "": 0.05}
"""A number's spread is at least this, by its unit: m, px, and shares or grey levels."""
PIXELS = {"thing_moves_alone", "thing_far_of_robot", "stranger"}
"""Numbers in px."""


@dataclass(frozen=True)
class NormalRanges:
    """The ranges of one world model's clips at one number of steps between two frames."""

    world_model: str
    """SHA-256 of the world model."""
    stride: int
    """Steps between two frames."""
    lengths: tuple[int, int]
    """Fewest and most frames of a clip that is judged."""
    still: tuple[bool, ...]
    """Whether the camera of each view stands still."""
    origin: tuple[float, float, float]
    """What the position probe's tool lacks to be the model's state, m."""
    height_m: float
    """Of the object's middle: as low as the tool goes in a quarter of the recordings."""
    middle: Mapping[str, float]
    """Median of each number."""
    spread: Mapping[str, float]
    """How far each number goes above its median."""
    scores: tuple[float, ...]
    """Of each recording the strangest number of its strangest form, in spreads of the other parts, sorted."""
    done: Mapping[str, float]
    """By task, the done signal from which it counts as done."""
    words: tuple[str, ...]
    """Pairs of neighbouring words of the recordings' instructions, with a space between."""
    story: Mapping[str, Any] = field(default_factory=dict)
    """How it was made."""

    def limit(self, kept: float = KEPT) -> float:
        """The score that a share `kept` of new recordings like these stays within (RA-27)."""
        place = min(len(self.scores), math.ceil(kept * (len(self.scores) + 1)))
        return self.scores[max(place, 1) - 1]

    def strangeness(self, numbers: Mapping[str, float]) -> dict[str, float]:
        """Each number in spreads above its median."""
        return {name: (numbers[name] - self.middle[name]) / self.spread[name] for name in NAMES}

    @property
    def sha256(self) -> str:
        """Of everything that decides an answer."""
        return hashlib.sha256(json.dumps(asdict(self) | {"story": {}}, sort_keys=True).encode()).hexdigest()


def file_of(folder: Path, stride: int) -> Path:
    """Where the ranges of a world model's folder are."""
    return folder / f"normal_ranges_{stride}.json"


def strides_of(folder: Path) -> list[int]:
    """Of which a world model's folder has ranges."""
    names = (path.stem.removeprefix("normal_ranges_") for path in folder.glob("normal_ranges_*.json"))
    return sorted(int(name) for name in names if name.isdecimal())


def has_ranges(folder: Path) -> bool:
    """Whether a world model's folder is a judge."""
    return bool(strides_of(folder))


def save_ranges(folder: Path, ranges: NormalRanges) -> Path:
    """Write the ranges into the world model's folder."""
    path = file_of(folder, ranges.stride)
    write_atomic(path, (json.dumps({"format": FORMAT, **asdict(ranges)}, indent=1) + "\n").encode())
    return path


def load_ranges(folder: Path, stride: int) -> NormalRanges:
    """Load the ranges of a world model's folder.

    Raises:
        ModelFolderError: there are none for this stride, or they are damaged or of another version; names the remedy.
    """
    path, remedy = file_of(folder, stride), f"make it: wm judge calibrate {folder} BAG --stride {stride}"
    content = read_json(path, remedy)
    try:
        if content.pop("format") != FORMAT or any(set(content[part]) != set(NAMES) for part in ("middle", "spread")):
            raise ValueError("it is of another version")
        if content["stride"] != stride or not _usable(content):
            raise ValueError("it is damaged")
        pairs = {name: tuple(content[name]) for name in ("lengths", "still", "origin", "scores", "words")}
        return NormalRanges(**{**content, **pairs})
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFolderError(f"{path} cannot be used: {error}; {remedy}") from None


def _usable(content: Mapping[str, Any]) -> bool:
    """Whether a score can be formed and has a limit."""
    scores, spread = content["scores"], content["spread"].values()
    values = [*scores, *spread, *content["middle"].values(), content["height_m"]]
    finite = all(math.isfinite(value) for value in values)
    return finite and bool(scores) and min(spread) > 0 and list(scores) == sorted(scores)


def fit(rows: Sequence[Mapping[str, float]], recordings: ArrayLike, seed: int) -> dict[str, Any]:
    """Return middle, spread and scores of NormalRanges.

    Args:
        rows: the numbers of each clip.
        recordings: of each row, the recording that it is a form of.
        seed: decides which recordings are of which part.

    Raises:
        ValueError: fewer than LEAST recordings.
    """
    recordings = np.asarray(recordings)
    known, values = np.unique(recordings), np.array([[row[name] for name in NAMES] for row in rows])
    if len(known) < LEAST:
        raise ValueError(f"normal ranges need at least {LEAST} recordings, got {len(known)}; name more bags")
    which = np.searchsorted(known, recordings)
    scores = np.empty(len(known))
    for part in np.array_split(np.random.default_rng(seed).permutation(len(known)), FOLDS):
        own = np.isin(which, part)
        middle, spread = _middle_and_spread(values[~own], which[~own])
        scores[part] = _worst((values[own] - middle) / spread, which[own], part).max(1)
    middle, spread = _middle_and_spread(values, which)
    return {
        "middle": dict(zip(NAMES, middle.tolist())), "spread": dict(zip(NAMES, spread.tolist())),
        "scores": tuple(sorted(scores.tolist())),
    }


def _middle_and_spread(values: Floats, recordings: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Of each number (F,); values: (N, F)."""
    middle = np.median(values, axis=0)
    least = [LEAST_SPREAD["_px" if n in PIXELS else "_m" if n.endswith("_m") else ""] for n in NAMES]
    worst = _worst(values, recordings, np.unique(recordings))
    return middle, np.maximum(np.quantile(worst, WITHIN, axis=0) - middle, least)


def _worst(values: Floats, recordings: NDArray[np.intp], wanted: NDArray[np.intp]) -> Floats:
    """The largest values of each wanted recording's forms, (len(wanted), F)."""
    return np.stack([values[recordings == recording].max(0) for recording in wanted])


def done_threshold(signals: Sequence[float], done: Sequence[bool]) -> float:
    """The signal that a share WRONGLY_DONE of undone recordings reaches, between 0.05 and 0.95."""
    undone = sorted(signal for signal, is_done in zip(signals, done, strict=True) if not is_done)
    if not undone:
        return 0.5
    place = min(len(undone), math.ceil((1 - WRONGLY_DONE) * (len(undone) + 1)))
    return min(max(undone[place - 1], 0.05), 0.95)
