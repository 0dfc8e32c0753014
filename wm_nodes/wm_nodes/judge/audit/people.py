"""A judge that answers with people's labels, so that they go through the same states, gates and weights.

A vote is one person's answer, and everybody who was sure votes: their answers are pooled, or left undecided, as the
votes of a server are (RA-7, RA-8 with k the number of people). Every read is the outcome of that vote.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Sequence

from wm_nodes.judge.agent.judge import Capabilities, Health, Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import one_hot, pool, settle
from wm_nodes.judge.agent.types import NUM_PLAN_LEVELS, PLANNING, Stage, Status
from wm_nodes.judge.audit.labels import HACK, HumanLabels, RowLabel, annotators, find_evaluation
from wm_nodes.judge.audit.reading import Record, Subject, subject_of

SAID = {"pass": 4, "fail": 1}
"""The level that an answer without one stands for: clean, or clearly wrong."""


class HumanJudge:
    """Answers from exported labels of a log's evaluations, by the content of a clip and its task, in whatever order the
    files come. Of several evaluations of them, what a person said of the last one counts. It abstains where nobody was
    sure, or as many say that a component passes as say that it fails.

    Raises:
        AuditError: one person labelled an evaluation twice, labels of another log, or a picture is missing.
    """

    def __init__(self, files: Sequence[HumanLabels], record: Record) -> None:
        self._people = sorted(annotators(files))
        self._said: dict[Subject, dict[str, dict[str, RowLabel]]] = defaultdict(dict)
        given = [(label, file.annotator) for file in files for label in file.labels]
        for label, who in sorted(given, key=lambda one: (one[1], one[0].evaluation)):
            evaluation = find_evaluation(label.evaluation, label.audit_id, record.evaluations, f"labels of {who}")
            said = self._said[record.subject(evaluation)]
            said[who] = {**said.get(who, {}), **label.rows}
        content = "".join(sorted(file.model_dump_json() for file in files))
        self._sha = hashlib.sha256(content.encode()).hexdigest()[:12]

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(
            f"human:{self._sha}", "human", ", ".join(self._people), "", None,
            card=f"labels of {', '.join(self._people)} on {len(self._said)} clips",
        )

    async def health(self) -> Health:
        return Health(True, "answers from labels")

    async def read(self, request: ReadRequest) -> list[Read]:
        said = [*self._said.get(subject_of(request.clip.sha256, request.task), {}).values()]
        prefix = HACK if request.stage is Stage.HACK else ""
        return [_answer(name, prefix + name, vote, said) for name in request.components for vote in request.votes]


def _answer(component: str, row: str, vote: Vote, said: Sequence[dict[str, RowLabel]]) -> Read:
    sure = [rows for rows in said if row in rows and rows[row].answer != "unsure"]
    if not sure:
        reason = f"nobody was sure of {row}" if any(row in rows for rows in said) else f"nobody labelled {row}"
        return Read(component, (), "human", vote, status=Status.ABSTAIN, reason=reason)
    if component == PLANNING:
        return _planning(vote, sure)
    labels = [rows[row] for rows in sure]
    levels = [SAID[label.answer] if label.level is None else label.level for label in labels]
    votes = [Read(component, one_hot(level), "human", vote) for level in levels]
    voted = settle(votes, min_label_mass=0)
    if voted.status is not Status.OK:
        return Read(component, (), "human", vote, status=voted.status, reason=voted.reason)
    return Read(component, pool(votes), "human", vote, evidence_text=voted.decided_by if len(votes) > 1 else "")


def _planning(vote: Vote, sure: Sequence[dict[str, RowLabel]]) -> Read:
    """The share of the people per level; what most of them see fail is looked at first."""
    levels = [rows[PLANNING].level for rows in sure]
    known = [one_hot(level, NUM_PLAN_LEVELS) for level in levels if level is not None and level < NUM_PLAN_LEVELS]
    if len(known) < len(levels):
        reason = f"planning needs a level 0 to {NUM_PLAN_LEVELS - 1}, got {', '.join(map(str, levels))}"
        return Read(PLANNING, (), "human", vote, status=Status.ERROR, reason=reason)
    failed = Counter(name for rows in sure for name, other in rows.items() if other.answer == "fail")
    focus = sorted((name for name in failed if not name.startswith(HACK)), key=lambda name: (-failed[name], name))
    pooled = pool([Read(PLANNING, level, "human", vote) for level in known])
    return Read(PLANNING, pooled, "human", vote, focus=tuple(focus))
