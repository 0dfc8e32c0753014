"""A judge that answers with people's labels, so that they go through the same states, gates and weights.

A vote is one person's answer: where people differ, components are voted on, pooled or left undecided as the reads of a
server are.
"""

import hashlib
from collections import defaultdict
from collections.abc import Sequence

from wm_nodes.judge.agent.judge import Capabilities, Health, Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import one_hot
from wm_nodes.judge.agent.types import NUM_PLAN_LEVELS, PLANNING, Stage, Status
from wm_nodes.judge.audit.labels import HACK, HumanLabels, RowLabel, annotators

SAID = {"pass": 4, "fail": 1}
"""The level that an answer without one stands for: clean, or clearly wrong."""


class HumanJudge:
    """Answers from exported labels, by the content of a clip. Vote j is the answer of person j, counted round among
    those who were sure; it abstains where nobody was. Raises AuditError: one person labelled an evaluation twice.
    """

    def __init__(self, files: Sequence[HumanLabels]) -> None:
        self._people = annotators(files)
        self._said: dict[str, list[dict[str, RowLabel]]] = defaultdict(list)
        for file in files:
            for label in file.labels:
                self._said[label.sha256].append(label.rows)
        content = "".join(file.model_dump_json() for file in files)
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
        said = self._said.get(request.clip.sha256, [])
        prefix = HACK if request.stage is Stage.HACK else ""
        return [_answer(name, prefix + name, vote, said) for name in request.components for vote in request.votes]


def _answer(component: str, row: str, vote: Vote, said: Sequence[dict[str, RowLabel]]) -> Read:
    sure = [rows for rows in said if row in rows and rows[row].answer != "unsure"]
    if not sure:
        reason = f"nobody was sure of {row}" if any(row in rows for rows in said) else f"nobody labelled {row}"
        return Read(component, (), "human", vote, status=Status.ABSTAIN, reason=reason)
    rows = sure[vote.index % len(sure)]
    label = rows[row]
    if component != PLANNING:
        return Read(component, one_hot(SAID[label.answer] if label.level is None else label.level), "human", vote)
    if label.level is None or label.level >= NUM_PLAN_LEVELS:
        reason = f"planning needs a level 0 to {NUM_PLAN_LEVELS - 1}, got {label.level}"
        return Read(component, (), "human", vote, status=Status.ERROR, reason=reason)
    failed = tuple(name for name, other in rows.items() if other.answer == "fail" and not name.startswith(HACK))
    return Read(component, one_hot(label.level, NUM_PLAN_LEVELS), "human", vote, focus=failed)
