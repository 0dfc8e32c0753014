"""From evidence to calibrated answers, and to none where a clip is unlike all training (RA-18, RA-19).

A question is "is the level above k?"; its trees give log-odds, and a line fitted on the validation part makes
probabilities of them (Platt 1999). On disk: a folder with judge.safetensors, and judge.json, which says how it was
made.
Shapes: N clips, F evidence.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save
from torch import nn

from wm_nodes.core.model_folder import ModelFolderError, read_manifest, read_model_file, write_model_folder
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.agent.types import NUM_LEVELS, NUM_PLAN_LEVELS, PLANNING
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.evidence.sequence import TemporalNetwork
from wm_nodes.judge.evidence.trees import Floats, Trees
from wm_nodes.judge.evidence.window import Window

FORMAT = "embedded-judge-1"
TENSORS, MANIFEST = "judge.safetensors", "judge.json"
TREE_ARRAYS = ("features", "thresholds", "leaves", "gains")
TASK_COMPLETION = "task_completion"
CLARITY, SHARPNESS = "clarity", "sharpness_min"
"""A component, and the evidence of its blurriest frame."""
FAIL_LEVEL, PASS_LEVEL = 1, 4
"""A component's labels are pass and fail only: fail is read as "clearly wrong", pass as "clean"."""
HACK = "hack/"
"""In front of a pattern's name: a component and a pattern may share one (background)."""
CLIP_AT = 6.0
"""Standardised evidence is cut here, so that one wild number does not make a clip foreign."""

_Network = TypeVar("_Network", bound=nn.Module)


@dataclass(frozen=True, eq=False)
class HeadQuestion:
    """P(yes) = sigmoid(slope * log-odds of the trees + offset)."""

    trees: Trees
    slope: float
    offset: float

    def probability(self, rows: FloatArray) -> Floats:
        """(N,) of rows (N, F)."""
        odds = self.slope * self.trees.log_odds(rows).astype(np.float64) + self.offset
        return np.asarray(1 / (1 + np.exp(-np.clip(odds, -30, 30))))


@dataclass(frozen=True, eq=False)
class Familiarity:
    """How far evidence is from that of training: Mahalanobis distance of standardised numbers, over sqrt(F).

    centre, scale: (F,). precision: (F, F), of shrunk covariance. limit: of the distance, from the validation part.
    """

    centre: FloatArray
    scale: FloatArray
    precision: FloatArray
    limit: float

    def distance(self, rows: FloatArray) -> Floats:
        """(N,) of rows (N, F)."""
        z = np.asarray(np.clip((rows - self.centre) / self.scale, -CLIP_AT, CLIP_AT), np.float64)
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", z, self.precision.astype(np.float64), z) / z.shape[1]))


@dataclass(frozen=True, eq=False)
class JudgeHead:
    """What was learned. names: F evidence names, in order. questions: for a component or pattern one, "does it pass"
    or "is it absent"; for task completion one per level above the lowest; for planning "is it a video" and "is it
    readable", and it is good where no component fails. clean_low, clean_high: (F,), 5 %
    and 95 % quantiles over clips in which nothing fails. size: H, W that evidence is measured at. lengths: fewest and
    most frames. window: what is read of a picture; None: all of it. readers: their mean is among the evidence.
    sharpness_limit: a clip with a frame below it is not clear, as the trees learned from whole clips and let one sharp
    frame excuse the others. story: how it was made and what it measured.
    """

    segmenter: Segmenter
    names: tuple[str, ...]
    questions: Mapping[str, tuple[HeadQuestion, ...]]
    familiarity: Familiarity
    clean_low: FloatArray
    clean_high: FloatArray
    size: tuple[int, int]
    lengths: tuple[int, int]
    story: Mapping[str, Any] = field(default_factory=dict)
    sha256: str = ""
    window: Window | None = None
    readers: tuple[TemporalNetwork, ...] = ()
    sharpness_limit: float = 0.0

    @property
    def picture_size(self) -> tuple[int, int]:
        """H, W of the pictures that it judges."""
        return self.size if self.window is None else (self.window.height, self.window.width)

    def seen(self, pictures: UInt8Array) -> UInt8Array:
        """What evidence is measured on, uint8 (..., *size, 3), of pictures (..., H, W, 3)."""
        return pictures if self.window is None else self.window.pictures(pictures)

    def row(self, evidence: Mapping[str, float]) -> FloatArray:
        """(1, F) of named evidence. Raises ValueError: other names than it was trained on; says which."""
        if missing := sorted(set(self.names) - evidence.keys()):
            raise ValueError(f"the head needs evidence {', '.join(missing[:5])}, which is not given; train it anew")
        return np.array([[evidence[name] for name in self.names]], np.float32)

    def levels(self, target: str, row: FloatArray) -> tuple[float, ...]:
        """Probability of each level, worst first, of a row (1, F). Raises KeyError: no head for this target."""
        above = [float(p) for p in above_levels(self.questions, target, row)[:, 0]]
        if target in (CLARITY, PLANNING) and self._blurriest(row) < self.sharpness_limit:
            above[-1] = 0.0  # neither clear nor of the highest planning level
        return levels_of(target, above)

    def conformal(self, coverage: float) -> dict[str, tuple[float, float]]:
        """(low, high) of p_fail per component, see conformal_limits. Raises ValueError: coverage not calibrated."""
        kept: Mapping[str, Mapping[str, Sequence[float]]] = self.story.get("conformal", {})
        known = sorted({name for limits in kept.values() for name in limits})
        if f"{coverage:g}" not in known:
            there = ", ".join(known) or "none; train it anew"
            raise ValueError(f"conformal coverage {coverage:g} was not calibrated for this judge; there are: {there}")
        limits = {target: of[f"{coverage:g}"] for target, of in kept.items()}
        return {target: (float(low), float(high)) for target, (low, high) in limits.items()}

    def evidence_text(self, target: str, row: FloatArray) -> str:
        """Up to three signals that the trees ask most about and that lie outside of what clean clips show; of a blurred
        frame, its sharpness.
        """
        if target == CLARITY and (sharpness := self._blurriest(row)) < self.sharpness_limit:
            return f"{SHARPNESS} {sharpness:.3g}: a frame is blurred (clear from {self.sharpness_limit:.3g})"
        weight = np.sum([q.trees.importance(len(self.names)) for q in self.questions[target]], 0)
        width = np.maximum(self.clean_high - self.clean_low, 1e-3 + 0.02 * np.abs(self.clean_high))
        outside = np.maximum(row[0] - self.clean_high, self.clean_low - row[0]) / width
        score = weight * np.clip(outside, 0, 3)
        chosen = [int(i) for i in np.argsort(-score, kind="stable")[:3] if score[i] > 0]
        parts = [
            f"{self.names[i]} {row[0, i]:.3g} (clean {self.clean_low[i]:.3g} to {self.clean_high[i]:.3g})"
            for i in chosen
        ]
        return "; ".join(parts) or "all evidence within what clean clips show"

    def _blurriest(self, row: FloatArray) -> float:
        """Sharpness of the blurriest frame."""
        return float(row[0, self.names.index(SHARPNESS)]) if self.sharpness_limit else np.inf


def above_levels(questions: Mapping[str, tuple[HeadQuestion, ...]], target: str, rows: FloatArray) -> Floats:
    """(K, N) probabilities of being above levels 0 to K - 1 of a target, of rows (N, F)."""
    above = [question.probability(rows) for question in questions[target]]
    if target == PLANNING:
        above.append(np.min([questions[name][0].probability(rows) for name in components_of(questions)], axis=0))
    return np.stack(above)


def components_of(questions: Mapping[str, tuple[HeadQuestion, ...]]) -> list[str]:
    """The targets that pass or fail."""
    return [name for name, asked in questions.items() if len(asked) == 1 and not name.startswith(HACK)]


def levels_of(target: str, above: Sequence[float]) -> tuple[float, ...]:
    """Levels from the probabilities of being above level 0, 1, ..; these are made non-increasing first."""
    if len(above) == 1:
        levels = [0.0] * NUM_LEVELS
        levels[FAIL_LEVEL], levels[PASS_LEVEL] = 1 - above[0], above[0]
        return tuple(levels)
    ordered = np.concatenate([[1.0], np.minimum.accumulate(np.asarray(above, np.float64)), [0.0]])
    return tuple(float(p) for p in ordered[:-1] - ordered[1:])


def num_questions(target: str) -> int:
    """How many questions of its own a target has."""
    return {PLANNING: NUM_PLAN_LEVELS - 2, TASK_COMPLETION: NUM_LEVELS - 1}.get(target, 1)


def save_head(folder: Path, head: JudgeHead) -> Path:
    """Write the folder; equal heads give equal bytes of judge.safetensors."""
    arrays: dict[str, NDArray[Any]] = {
        f"{part}.{name}": tensor.cpu().numpy().astype(np.float16)
        for part, network in (("segmenter", head.segmenter), *((f"reader{k}", r) for k, r in enumerate(head.readers)))
        for name, tensor in network.state_dict().items()
    }
    lines: dict[str, list[list[float]]] = {}
    for target, questions in head.questions.items():
        lines[target] = [[q.slope, q.offset, q.trees.bias] for q in questions]
        for k, question in enumerate(questions):
            arrays |= {f"{target}.{k}.{part}": getattr(question.trees, part) for part in TREE_ARRAYS}
    known = head.familiarity
    arrays |= {"centre": known.centre, "scale": known.scale, "precision": known.precision,
               "clean_low": head.clean_low, "clean_high": head.clean_high}
    data = save({name: np.ascontiguousarray(array) for name, array in sorted(arrays.items())})
    manifest = {
        "format": FORMAT, "sha256": hashlib.sha256(data).hexdigest(), "evidence": list(head.names), "lines": lines,
        "limit": known.limit, "size": list(head.size), "lengths": list(head.lengths), "readers": len(head.readers),
        "sharpness_limit": head.sharpness_limit,
        **({} if head.window is None else {"window": asdict(head.window)}), **head.story,
    }
    return write_model_folder(folder, {TENSORS: data}, manifest, MANIFEST)


def load_head(folder: Path, device: torch.device | str = "cpu") -> JudgeHead:
    """Load and verify a judge's folder; its networks compute on `device`.

    Raises:
        ModelFolderError: names the file, what is wrong, and the remedy.
    """
    manifest = read_manifest(folder, "judge", FORMAT, MANIFEST)
    data = read_model_file(folder / TENSORS, manifest["sha256"])
    try:
        arrays = load(data)
        segmenter = _network(Segmenter(), "segmenter", arrays).to(device)
        num_readers = manifest.get("readers", 0)
        readers = tuple(_network(TemporalNetwork(), f"reader{k}", arrays).to(device) for k in range(num_readers))
        questions = {
            target: tuple(
                HeadQuestion(Trees(**{p: arrays[f"{target}.{k}.{p}"] for p in TREE_ARRAYS}, bias=bias), slope, offset)
                for k, (slope, offset, bias) in enumerate(lines)
            )
            for target, lines in manifest["lines"].items()
        }
        known = Familiarity(arrays["centre"], arrays["scale"], arrays["precision"], manifest["limit"])
        names = tuple(manifest["evidence"])
        height, width = manifest["size"]
        fewest, most = manifest["lengths"]
        window = Window(**manifest["window"]) if "window" in manifest else None
        sharpness_limit = float(manifest["sharpness_limit"])
        clean_low, clean_high = arrays["clean_low"], arrays["clean_high"]
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ModelFolderError(f"{folder} is of another architecture: {error}; train it anew") from error
    _check(folder, names, questions, known, (clean_low, clean_high))
    own = {"format", "sha256", "evidence", "lines", "limit", "size", "lengths", "readers", "window", "sharpness_limit"}
    story = {name: value for name, value in manifest.items() if name not in own}
    return JudgeHead(
        segmenter, names, questions, known, clean_low, clean_high, (height, width), (fewest, most), story,
        manifest["sha256"], window, readers, sharpness_limit,
    )


def _network(network: _Network, part: str, arrays: Mapping[str, NDArray[Any]]) -> _Network:
    """The network with its weights, which are kept as float16."""
    weights = {name: torch.from_numpy(arrays[f"{part}.{name}"].astype(np.float32)) for name in network.state_dict()}
    network.load_state_dict(weights)
    network.eval().requires_grad_(False)
    return network


def _check(
    folder: Path, names: tuple[str, ...], questions: Mapping[str, tuple[HeadQuestion, ...]], known: Familiarity,
    ranges: tuple[FloatArray, ...],
) -> None:
    """Every array has to fit the list of evidence."""
    count = len(names)
    for array in (known.centre, known.scale, *ranges):
        if array.shape != (count,):
            raise ModelFolderError(f"{folder}: {count} evidence names, but an array {array.shape}; train it anew")
    if known.precision.shape != (count, count):
        shape = known.precision.shape
        raise ModelFolderError(f"{folder}: {count} evidence names, but precision {shape}; train it anew")
    for target, asked in questions.items():
        if len(asked) != num_questions(target):
            raise ModelFolderError(f"{folder}: {target} has {len(asked)} questions, not {num_questions(target)}")
        for question in asked:
            trees = question.trees
            fits = trees.leaves.shape == (len(trees.features), 2 ** trees.features.shape[1])
            fits = fits and trees.thresholds.shape == trees.gains.shape == trees.features.shape
            if not fits or not 0 <= trees.features.max() < count:
                raise ModelFolderError(f"{folder}: trees of {target} do not fit {count} evidence names; train it anew")
