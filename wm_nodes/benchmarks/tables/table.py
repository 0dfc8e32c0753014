"""A table of a result page, as Markdown with how its numbers came about under it; and how its cells are written."""

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from statistics import mean
from typing import Any

import wm_nodes
from wm_nodes.core.statistics import paired_difference, t_interval, wilson_interval

ROOT = Path(wm_nodes.__file__).parents[1]
DOCS, FILES = ROOT / "docs", ROOT / "benchmarks" / "results"
PRETRAINED = "../../wm_nodes/pretrained"  # seen from the result files
LONG_PATHS = re.compile(r"(?<!\S)(?:(?:/\S*|\S*shard_\S*|\.\.\.)\s*)+")
BY_HAND = "- By hand, from reports of runs that are not in the repository"
Run = dict[str, Any]
Rows = Iterator[Sequence[object]]


def section(
    page: str, title: str, columns: str, *, rows: str = "", cells: Sequence[Sequence[object]] = (),
    files: Sequence[str] = (), command: str = "", about: str = "",
) -> str:
    """One table of pages.yaml, where the arguments are explained. Raises ValueError: not one cell for each column."""
    heads = columns.split(" | ")
    made = getattr(import_module(f"benchmarks.tables.{page}"), rows)() if rows else cells
    table = [heads, ["---"] * len(heads), *made]
    if wrong := [row for row in table if len(row) != len(heads)]:
        raise ValueError(f"{title}: a row must have {len(heads)} cells, got {wrong[0]}")
    text = [f"## {title}", "", *(f"| {' | '.join(map(str, row))} |" for row in table), ""]
    sources = [f"- Command: `{command}`"] * bool(command) + ([*map(recorded, files)] or [BY_HAND])
    return "\n".join([*text, *[about.replace("\n", "\n\n"), ""] * bool(about), *sources, ""])


def lines(name: str) -> list[Run]:
    """The runs of a .jsonl file; of another file its content alone."""
    text = (FILES / name).read_text(encoding="utf-8")
    return [json.loads(part) for part in (text.splitlines() if name.endswith(".jsonl") else [text])]


def read(name: str) -> Run:
    return lines(name)[0]


def runs(name: str) -> dict[str, Run]:
    """The runs of a .jsonl file by name."""
    return {run["run"]: run for run in lines(name)}


def recorded(name: str) -> str:
    """A link to a result file, and the commands, seeds, machines and dates that its runs hold, without long paths."""
    facts: dict[str, dict[str, None]] = {kind: {} for kind in ("command", "seed", "machine", "date")}
    for run in lines(name):
        made = {**run, **run.get("made", {}), **run.get("story", {})}
        if isinstance(machine := made.get("machine"), dict):
            parts = machine["processor"], f"{machine['cores']} cores", machine.get("device", "cpu"), machine["torch"]
            made |= {"machine": "{}, {}, {}, torch {}".format(*parts), "date": machine["date"][:10]}
        if "command" in made:
            made["command"] = f"`{LONG_PATHS.sub('... ', made['command']).strip()}`"
        made["seed"] = f"seed {made['seed']}" if isinstance(made.get("seed"), int) else ""
        for kind, values in facts.items():
            values |= dict.fromkeys(filter(None, [made.get(kind)]))
    link = os.path.normpath(f"../../../benchmarks/results/{name}")
    texts = ", ".join(text for values in facts.values() for text in values)
    return f"- File: [{name.removeprefix(f'{PRETRAINED}/')}]({link}). Recorded: {texts}"


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def interval(value: float, low: float, high: float, digits: int) -> str:
    """A difference with its 95 % interval, bold where 0 lies outside."""
    text = f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
    return f"**{text}**" if low > 0 or high < 0 else text


def points(before: Sequence[bool], after: Sequence[bool]) -> str:
    """The difference of two success rates on the same episodes, in points, with Tango's interval."""
    pair = paired_difference(before, after)
    return interval(100 * pair.difference, 100 * pair.low, 100 * pair.high, 1)


def over_seeds(changes: Sequence[float], digits: int = 1) -> str:
    """The mean of one change a seed, with Student's t interval over them; without one of a single seed."""
    if len(changes) < 2:
        return f"{changes[0]:+.{digits}f}"
    found = t_interval(changes)
    return interval(found.mean, found.low, found.high, digits)


def points_over_seeds(before: Iterable[Sequence[bool]], after: Iterable[Sequence[bool]]) -> str:
    """The differences of two success rates of each seed, in points, as over_seeds."""
    return over_seeds([100 * (mean(new) - mean(old)) for old, new in zip(before, after, strict=True)])


def share(count: float, n: int) -> str:
    """A share in percent with Wilson's interval."""
    low, high = wilson_interval(count, n)
    return f"{percent(count / n)} [{percent(low)}, {percent(high)}]"
