"""A log of the evaluations on the test split, so that a table says when a judge may have been tuned on it.

A file beside the set has one line for the first evaluation of each judge with a rubric. The evaluations behind the
published tables are part of this package, so that a set that is built again has them, too. The same judge with the same
rubric may be evaluated again, because nothing was tuned in between.
"""

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from wm_nodes.core.files import text_lines, write_atomic
from wm_nodes.judge.agent.judge import Capabilities
from wm_nodes.judge.dataset.edits.manifest import Manifest

LOG_NAME = "test_ledger.jsonl"
PUBLISHED = Path(__file__).with_name("published_evaluations.json")


@dataclass(frozen=True)
class TestSplitEvaluation:
    """One evaluation. test_sha256: see test_sha. reason: why it was taken after another one."""

    judge: str
    rubric: str
    test_sha256: str
    date: str
    reason: str = ""

    @property
    def who(self) -> tuple[str, str, str]:
        return self.judge, self.rubric, self.test_sha256


def judge_name(able: Capabilities) -> str:
    return "/".join(part for part in (able.judge_id, able.transport, able.model, able.server_version) if part)


def test_sha(manifest: Manifest) -> str:
    """Of the recordings of all test clips: other edits of them, or the pixels of another renderer, are no new split."""
    origins = {json.dumps(asdict(row.origin), sort_keys=True) for row in manifest.rows if row.part == "test"}
    return hashlib.sha256("".join(sorted(origins)).encode()).hexdigest()[:16]


def read_evaluations(folder: Path) -> list[TestSplitEvaluation]:
    """The published evaluations, then those that only the log of the set has, oldest first.

    Raises:
        ValueError: a line that cannot be read; the file must not be edited.
    """
    published = [TestSplitEvaluation(**entry) for entry in json.loads(PUBLISHED.read_text(encoding="utf-8"))]
    return [*published, *(entry for entry in _read_log(folder) if entry not in published)]


def _read_log(folder: Path) -> list[TestSplitEvaluation]:
    path = folder / LOG_NAME
    if not path.is_file():
        return []
    try:
        return [TestSplitEvaluation(**json.loads(line)) for line in text_lines(path.read_bytes())]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} cannot be read: {error}; restore it, or build the set again") from error


def record_evaluation(
    folder: Path, manifest: Manifest, able: Capabilities, rubric_version: str, reason: str
) -> list[TestSplitEvaluation]:
    """Enter this evaluation; return the earlier ones by another judge or rubric, which the output must name.

    Raises:
        ValueError: there are earlier ones and no reason was given.
    """
    now = TestSplitEvaluation(judge_name(able), rubric_version, test_sha(manifest), time.strftime("%Y-%m-%d"), reason)
    known = read_evaluations(folder)
    others = [entry for entry in known if entry.who != now.who and entry.test_sha256 == now.test_sha256]
    if now.who in {entry.who for entry in known}:
        return others
    if others and not reason:
        raise ValueError(
            f"the test split of {folder} was already seen by {_describe(others[-1])}: choose on --part validation, or "
            "say with --again REASON why the test split is read once more; the reason is printed with the table"
        )
    lines = [json.dumps(asdict(entry), sort_keys=True) + "\n" for entry in [*_read_log(folder), now]]
    write_atomic(folder / LOG_NAME, "".join(lines).encode())
    return others


def notice(others: Sequence[TestSplitEvaluation], reason: str) -> str:
    """What the output says of earlier evaluations; "" without any."""
    if not others:
        return ""
    return (
        f"NOT A FIRST LOOK: the test split was seen before by {'; '.join(map(_describe, others))}. "
        f"Reason given now: {reason or 'none, this judge and rubric had looked before'}"
    )


def _describe(entry: TestSplitEvaluation) -> str:
    return f"{entry.judge} with rubric {entry.rubric} on {entry.date}" + (f" ({entry.reason})" if entry.reason else "")
