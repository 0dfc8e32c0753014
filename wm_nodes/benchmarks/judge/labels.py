"""What is known of a clip of the benchmark, under the names of Table 2, and what a verdict says of hacking patterns.

A stage fails with any of its components, and is unknown only where none is known to fail. What a verdict decides under
the same names: wm_nodes.judge.decisions.
"""

import math
from collections.abc import Sequence
from typing import Any

from benchmarks.judge.label_judge import ClipLabels
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.dataset.edits.clips import ClipTruth, Edit
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.dataset.edits.planning import planning_level
from wm_nodes.judge.decisions import FAIR_LEVEL, OVERALL, STAGES

Known = bool | int | None


def known_labels(labels: ClipTruth, edits: Sequence[Edit]) -> ClipLabels:
    """What the control is told of a clip; a planning level that nobody knows is fair."""
    level, pattern = planning_level(labels, edits), labels.pattern
    patterns = frozenset({pattern} if pattern is not None else ())
    return ClipLabels(dict(labels.passed), FAIR_LEVEL if level is None else level, labels.tc_level, patterns)


def truth_of(row: ManifestRow, rubric: Rubric) -> dict[str, Known]:
    """The known decision of every row of the table; None where nobody knows."""
    passed = row.labels.passed
    known: dict[str, Known] = {name: passed.get(name) for name in rubric.component_names}
    for stage in STAGES:
        parts = [known[name] for name in rubric.stages[stage].components]
        known[str(stage)] = False if False in parts else None if None in parts else True
    return {**known, PLANNING: planning_level(row.labels, row.edits), OVERALL: row.labels.overall}


def pattern_scores(verdict: Verdict) -> dict[str, dict[str, Any]]:
    """p and confirmed of every hacking pattern that was read; where nobody can say, p is None."""
    return {
        flag.pattern: {"p": None if math.isnan(flag.p_present) else flag.p_present, "confirmed": flag.confirmed}
        for flag in verdict.hack_flags
    }
