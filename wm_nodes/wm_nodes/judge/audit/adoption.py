"""Decide whether a new version of a rubric is adopted (RA-25).

Both versions judged the clips of two labelled sets. The frozen set guards what was reached, the newest round shows what
was gained. Measured by the balanced accuracy, averaged over the components and "overall", because a judge that
always says "pass" is right on most clips; a clip that a version leaves without an answer counts as a wrong one. The
difference, new minus old, is bootstrapped over clips, which both versions share. Adopted where

    frozen set: low end of the 95 % interval >= -MARGIN        (not worse)
    newest round: low end of the 95 % interval > 0             (better)
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from wm_nodes.core.files import write_atomic
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.audit.entries import plain
from wm_nodes.judge.audit.labels import HumanLabels, known_answers
from wm_nodes.judge.audit.log import AuditError, AuditLog, read_lines
from wm_nodes.judge.audit.reading import Record, RecordedEvaluation
from wm_nodes.judge.decisions import OVERALL, decisions_of

MARGIN = 0.01
"""Of balanced accuracy: a loss that may be chance is let pass only up to this."""
DRAWS = 4000
CURRENT = "current.yaml"


@dataclass(frozen=True)
class RubricComparison:
    """One labelled set. clips: judged by both and labelled. rows: component -> (old, new) balanced accuracy. old, new:
    their means. low, high: 95 % bootstrap interval of new - old.
    """

    clips: int
    rows: Mapping[str, tuple[float, float]]
    old: float
    new: float
    low: float
    high: float

    @property
    def difference(self) -> float:
        return self.new - self.old


@dataclass(frozen=True)
class AdoptionDecision:
    """adopted, and why, in a sentence."""

    adopted: bool
    reason: str
    old_version: str
    new_version: str
    frozen: RubricComparison
    newest: RubricComparison


def compare(old: Record, new: Record, files: Sequence[HumanLabels], *, seed: int = 0) -> RubricComparison:
    """Measure two logs of the same clips against labels; clips are matched by content.

    Raises:
        AuditError: a clip that both judged has no label, no clip is left, or no component has labels of both kinds.
    """
    first, second = _by_clip(old), _by_clip(new)
    known = _known_labels(files, _only_rubric(old))
    shared = sorted(first.keys() & second.keys() & known.keys())
    if not shared:
        raise AuditError(
            f"{old.folder} and {new.folder} share no clip that is labelled: {len(first)} and {len(second)} clips, "
            f"{len(known)} labelled; judge the labelled clips with both versions"
        )
    names = [name for name in (*_only_rubric(old).component_names, OVERALL) if any(name in known[s] for s in shared)]
    truth = np.array([[_as_number(known[sha].get(name)) for name in names] for sha in shared])
    right = [_is_right(verdicts, shared, names, truth) for verdicts in (first, second)]
    ones = np.ones((1, len(shared)))
    before, after = (_balanced_accuracies(ones, truth, hits)[0] for hits in right)
    usable = ~np.isnan(before)
    if not usable.any():
        raise AuditError("no component has labels that pass and labels that fail; label more clips")
    rng = numpy_stream(seed, "audit_adoption", len(shared))
    counts = rng.multinomial(len(shared), np.full(len(shared), 1 / len(shared)), size=DRAWS).astype(np.float64)
    drawn = [_balanced_accuracies(counts, truth[:, usable], hits[:, usable]) for hits in right]
    low, high = np.nanquantile(_row_means(drawn[1]) - _row_means(drawn[0]), (0.025, 0.975))
    rows = {name: (float(b), float(a)) for name, b, a in zip(names, before, after) if not math.isnan(b)}
    return RubricComparison(
        len(shared), rows, float(before[usable].mean()), float(after[usable].mean()), float(low), float(high)
    )


def decide(
    frozen: RubricComparison, newest: RubricComparison, old: str, new: str, *, margin: float = MARGIN
) -> AdoptionDecision:
    """Apply the rule."""
    reasons = []
    if frozen.low < -margin:
        rule = f"the low end must be >= {-100 * margin:g}"
        reasons.append(f"not shown to be no worse on the frozen set ({_describe(frozen)}; {rule})")
    if newest.low <= 0:
        reasons.append(f"not shown to be better on the newest round ({_describe(newest)}; the low end must be > 0)")
    good = f"no worse on the frozen set ({_describe(frozen)}), better on the newest round ({_describe(newest)})"
    return AdoptionDecision(not reasons, "; ".join(reasons) or good, old, new, frozen, newest)


class Registry:
    """A folder with the rubric in force (current.yaml, which load_rubric reads) and a chained log of decisions."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    @property
    def current(self) -> str:
        """The version in force; "" before the first."""
        versions = [line.body["in_force"] for line in self._lines() if line.kind == "adoption"]
        return str(versions[-1]) if versions else ""

    @property
    def frozen_set(self) -> str:
        """Hash of the frozen set's labels at the last decision; "" before the first."""
        shas = [line.body["frozen_set"] for line in self._lines() if line.kind == "adoption"]
        return str(shas[-1]) if shas else ""

    def record(
        self, decided: AdoptionDecision, rubrics: Mapping[str, Rubric], frozen_set: str, facts: Mapping[str, Any]
    ) -> None:
        """Note a decision and write the rubric now in force. Raises AuditError: the old version was not in force."""
        if self.current not in ("", decided.old_version):
            raise AuditError(
                f"{self.folder} has {self.current} in force, the old log was judged by {decided.old_version}; compare "
                "with verdicts of the version in force"
            )
        in_force = decided.new_version if decided.adopted else decided.old_version
        with AuditLog(self.folder) as log:
            body = {"in_force": in_force, "frozen_set": frozen_set, **plain(asdict(decided)), **plain(facts)}
            log.append("adoption", body, sync=True)
        values = rubrics[in_force].model_dump(mode="json")
        write_atomic(self.folder / CURRENT, yaml.safe_dump(values, sort_keys=False, allow_unicode=True).encode())

    def _lines(self) -> list[Any]:
        return list(read_lines(self.folder)) if (self.folder / "log.jsonl").is_file() else []


def _only_rubric(record: Record) -> Rubric:
    used = {evaluation.agent.rubric_version for evaluation in record.judged()}
    if len(used) != 1:
        raise AuditError(f"{record.folder} must hold verdicts of one rubric, got {', '.join(sorted(used)) or 'none'}")
    return record.rubrics[used.pop()]


def _by_clip(record: Record) -> dict[str, RecordedEvaluation]:
    """The last verdict on each clip."""
    return {evaluation.sha256: evaluation for evaluation in record.judged()}


def _known_labels(files: Sequence[HumanLabels], rubric: Rubric) -> dict[str, dict[str, Any]]:
    """Sure labels by clip; the first file that has one counts."""
    known: dict[str, dict[str, Any]] = {}
    for file in files:
        for label in file.labels:
            sure = {name: answer for name, answer in known_answers(label, rubric).items() if answer is not None}
            known[label.sha256] = {**sure, **known.get(label.sha256, {})}
    return known


def _as_number(answer: bool | None) -> float:
    return math.nan if answer is None else float(answer)


def _is_right(
    verdicts: Mapping[str, RecordedEvaluation], shared: Sequence[str], names: Sequence[str], truth: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """bool (clips, names): the version's decision is the label."""
    decisions = [decisions_of(verdict) if (verdict := verdicts[sha].verdict) else {} for sha in shared]
    said = np.array(
        [[_as_number(bool(row[name].value)) if name in row else math.nan for name in names] for row in decisions]
    )
    return np.asarray(said == truth)


def _balanced_accuracies(counts: NDArray[Any], truth: NDArray[Any], right: NDArray[Any]) -> NDArray[np.float64]:
    """Balanced accuracy by draw and name. counts: (draws, clips), how often a clip was drawn."""
    shares = []
    for value in (1.0, 0.0):
        with np.errstate(invalid="ignore", divide="ignore"):
            shares.append(counts @ ((truth == value) & right) / (counts @ (truth == value)))
    return np.asarray((shares[0] + shares[1]) / 2)


def _row_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the names that a draw has both kinds of; NaN where it has none."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(known, values, 0).sum(1) / known.sum(1))


def _describe(comparison: RubricComparison) -> str:
    difference, low, high = (100 * share for share in (comparison.difference, comparison.low, comparison.high))
    return f"{difference:+.1f} points, {low:+.1f} to {high:+.1f}, n = {comparison.clips}"
