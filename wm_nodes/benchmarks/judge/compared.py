"""Other papers' rewards on the same clips: how well they rank them, and how often a hacked clip wins.

A score is measured without a threshold, since each has a scale of its own: AUROC of good clips against others, and the
share of hacked clips that score at least as high as their clean recording. Answers are kept, one JSON line each.
"""

import asyncio
import hashlib
import json
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.table import Table

from benchmarks.judge.comparisons.chat import ChatComparison, ComparisonReward
from benchmarks.judge.comparisons.protocols import PAIRWISE, POINTWISE
from benchmarks.judge.line_file import LineFile
from benchmarks.judge.metrics import mean
from wm_nodes.core.statistics import auroc, wilson_interval
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.dataset.rows import read_clip
from wm_nodes.reports.console_table import decimal, make_table, percent, percent_interval

PROTOCOLS = (*POINTWISE, *PAIRWISE)


@dataclass(frozen=True)
class ComparedAnswer:
    """of: sha256 of a clip, or of both of a pair. value: of the clip, or the preference for the clean one of the pair;
    None where nothing usable was said."""

    of: str
    value: float | None
    reason: str
    calls: int
    tokens: int
    images: int


@dataclass(frozen=True)
class ComparedRow:
    """n: clips or pairs with a number. area: AUROC against the overall label; NaN for pairs. pairs: hacked clips with a
    clean recording. win_rate: share of them that score at least as high, with its Wilson interval. calls, tokens,
    images: mean per clip or pair."""

    name: str
    n: int
    invalid: int
    area: float
    pairs: int
    win_rate: float
    low: float
    high: float
    calls: float
    tokens: float
    images: float


def answer_file(folder: Path, protocol: str, model: str, seed: int) -> LineFile[ComparedAnswer]:
    """The answers kept so far; failures among them are asked again."""
    name = hashlib.sha256(json.dumps([protocol, model, seed]).encode()).hexdigest()[:16]
    return LineFile(folder / f"{protocol}-{name}.jsonl", ComparedAnswer, "of")


def hacked_pairs(rows: Sequence[ManifestRow]) -> list[tuple[ManifestRow, ManifestRow]]:
    """(hacked clip, its recording), where the recording is good throughout."""
    good = {row.sha256: row for row in rows if not row.edits and row.labels.overall}
    return [(row, good[row.root]) for row in rows if row.labels.pattern is not None and row.root in good]


async def compared(
    judge: ChatComparison, protocol: str, folder: Path, rows: Sequence[ManifestRow], file: LineFile[ComparedAnswer], *,
    at_once: int = 1, on_answer: Callable[[], object] = lambda: None,
) -> ComparedRow:
    """Ask one protocol about every clip, or about every hacked clip beside its recording.

    Raises:
        ManifestError: a clip cannot be read.
    """
    gate = asyncio.Semaphore(at_once)
    pairs = hacked_pairs(rows)

    async def answer(key: str, ask: Callable[[], Awaitable[ComparisonReward]]) -> ComparedAnswer:
        async with gate:
            known = file.rows.get(key)
            if known is None or known.value is None:
                reward = await ask()
                cost, value = reward.cost, reward.value if reward.valid else None
                tokens = cost.prompt_tokens + cost.completion_tokens
                known = ComparedAnswer(key, value, reward.reason, cost.calls, tokens, cost.images)
                file.add(known)
            on_answer()
            return known

    async def compare_pair(hacked: ManifestRow, clean: ManifestRow) -> ComparisonReward:
        other, task = read_clip(folder, clean)
        return await judge.compare(PAIRWISE[protocol], other, read_clip(folder, hacked)[0], task)

    async def score_clip(row: ManifestRow) -> ComparisonReward:
        return await judge.score(POINTWISE[protocol], *read_clip(folder, row))

    if protocol in PAIRWISE:
        asked = (answer(f"{pair[0].sha256}/{pair[1].sha256}", partial(compare_pair, *pair)) for pair in pairs)
        answers = list(await asyncio.gather(*asked))
        wins = [answer.value <= 0.5 for answer in answers if answer.value is not None]
        return _row(protocol, answers, float("nan"), wins)
    answers = list(await asyncio.gather(*(answer(row.sha256, partial(score_clip, row)) for row in rows)))
    values = {row.sha256: answer.value for row, answer in zip(rows, answers)}
    known = [(row.labels.overall, value) for row in rows if (value := values[row.sha256]) is not None]
    both = [(values[hacked.sha256], values[clean.sha256]) for hacked, clean in pairs]
    wins = [mine >= clean for mine, clean in both if mine is not None and clean is not None]
    return _row(protocol, answers, auroc([label for label, _ in known], [value for _, value in known]), wins)


def num_answers(protocol: str, rows: Sequence[ManifestRow]) -> int:
    return len(hacked_pairs(rows)) if protocol in PAIRWISE else len(rows)


def comparison_table(rows: Sequence[ComparedRow], caption: str) -> Table:
    columns = ("reward", "n", "invalid", "AUROC", "hacked pairs", "hacked wins", "95 % Wilson", "calls", "tokens",
               "images")
    cells = (
        (
            row.name, row.n, row.invalid, decimal(row.area), row.pairs, percent(row.win_rate),
            percent_interval(row.low, row.high), f"{row.calls:.2f}", f"{row.tokens:.0f}", f"{row.images:.1f}",
        )
        for row in rows
    )
    return make_table("comparison rewards", columns, cells, caption=caption)


def _row(name: str, answers: Sequence[ComparedAnswer], area: float, wins: Sequence[bool]) -> ComparedRow:
    invalid = sum(answer.value is None for answer in answers)
    low, high = wilson_interval(sum(wins), len(wins))
    means = (mean([getattr(answer, part) for answer in answers]) for part in ("calls", "tokens", "images"))
    return ComparedRow(
        name, len(answers) - invalid, invalid, area, len(wins), mean([float(win) for win in wins]), low, high, *means
    )
