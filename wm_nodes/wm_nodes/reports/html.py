"""report.html: everything about one run in one file without outside parts, readable on light and dark screens."""

import base64
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from wm_nodes.core.files import write_atomic
from wm_nodes.reports.summary import Summary, acceptance_outcome
from wm_nodes.reports.tables import (
    EXPLOIT_COLUMNS,
    ROUND_COLUMNS,
    TASK_COLUMNS,
    exploit_rows,
    exploit_title,
    result_rows,
    round_rows,
    task_rows,
    verdict,
)

FILE_NAME = "report.html"
MARKS = {"passed": "good", "failed": "bad", "undecided": "faint"}
"""CSS class of each outcome of a criterion."""

STYLE = """
:root { color-scheme: light dark; --ink: #1d1d22; --faint: #66666f; --paper: #fbfbf9; --card: #fff; --line: #dcdcd8;
  --good: #1c7a4b; --bad: #b3362b; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8ea; --faint: #a0a0aa; --paper: #17171a; --card: #202024;
  --line: #3a3a40; --good: #5cc98e; --bad: #f0857a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 2rem 1.25rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
p.lead { font-size: 1.1rem; margin: 0; } .faint, figcaption { color: var(--faint); font-size: .92rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; background: var(--card); border: 1px solid var(--line); }
th, td { padding: .4rem .65rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.last td { font-weight: 600; border-bottom: 0; }
.good { color: var(--good); font-weight: 600; } .bad { color: var(--bad); font-weight: 600; }
figure { margin: 0 0 1.2rem; } figure img { max-width: 100%; background: #fff; border: 1px solid var(--line); }
pre, code { font: .86rem/1.45 ui-monospace, monospace; }
pre { overflow-x: auto; background: var(--card); border: 1px solid var(--line); padding: .7rem .9rem; margin: .4rem 0; }
code { overflow-wrap: anywhere; } summary { cursor: pointer; }
"""


@dataclass(frozen=True)
class Picture:
    """A PNG of the report. caption: what one sees in it."""

    title: str
    caption: str
    path: Path


def write_report(run_dir: Path, summary: Summary, pictures: Sequence[Picture] = (), *, config_text: str = "") -> Path:
    """Write <run_dir>/report.html and return its path. Raises FileNotFoundError: a picture does not exist."""
    title = f"{summary.task}: a policy trained inside a world model"
    reward = f"{summary.reward} ({summary.judge})" if summary.judge else summary.reward
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(verdict(summary))}</p>',
        f'<p class="faint">preset {escape(summary.preset)}, seed {summary.seed}, reward {escape(reward)}, '
        f"{summary.samples} imagined environment steps at {summary.imagined_steps_per_s:.0f} per second, "
        f"{summary.minutes:.1f} minutes in all</p>",
        "<h2>Success</h2>", _results(summary),
        *_tasks(summary), *_rounds(summary), *_exploit_meter(summary),
        "<h2>Acceptance of the world model</h2>", _acceptance(summary.acceptance),
        *figures(pictures),
        "<h2>Look closer, do it again</h2>", _again(run_dir, summary),
        *made_on(summary.machine, config_text),
    ]
    return write_page(run_dir, title, body)


def write_page(run_dir: Path, title: str, body: Iterable[str]) -> Path:
    """Write <run_dir>/report.html from the parts of its body; return its path."""
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>{escape(title)}</title><style>{STYLE}</style></head>'
        f"<body>{''.join(body)}</body></html>\n"
    )
    path = Path(run_dir) / FILE_NAME
    write_atomic(path, page.encode())
    return path


def figures(pictures: Sequence[Picture]) -> Iterable[str]:
    """Each picture, inside the page, under its title. Raises FileNotFoundError: a picture does not exist."""
    for picture in pictures:
        if not picture.path.is_file():
            raise FileNotFoundError(f"picture {picture.path} of the report does not exist")
        data = base64.b64encode(picture.path.read_bytes()).decode()
        yield (
            f'<h2>{escape(picture.title)}</h2><figure><img alt="{escape(picture.title)}" '
            f'src="data:image/png;base64,{data}"><figcaption>{escape(picture.caption)}</figcaption></figure>'
        )


def made_on(machine: Mapping[str, str], config_text: str) -> Iterable[str]:
    """The machine and, folded, the settings."""
    yield f"<h2>Made on</h2>{html_table(('', ''), (tuple(map(escape, fact)) for fact in machine.items()))}"
    if config_text:
        yield (
            f"<h2>Settings</h2><details><summary>resolved configuration</summary><pre>{escape(config_text)}</pre>"
            "</details>"
        )


def html_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Collection[int] = (), mark_last: bool = False
) -> str:
    """A table as HTML.

    Args:
        columns: headings; without any text there is no heading line.
        rows: cells, which are HTML already.
        numbers: indices of the columns that are aligned right.
    """

    def line(tag: str, cells: Sequence[str], kind: str = "") -> str:
        classes = (' class="number"' if index in numbers else "" for index in range(len(cells)))
        return f"<tr{kind}>" + "".join(f"<{tag}{c}>{cell}</{tag}>" for c, cell in zip(classes, cells)) + "</tr>"

    body = list(rows)
    last = ' class="last"' if mark_last else ""
    lines = [line("td", cells, last if index == len(body) - 1 else "") for index, cells in enumerate(body)]
    head = line("th", columns) if any(columns) else ""
    return f'<div class="wide"><table>{head}{"".join(lines)}</table></div>'


def _results(summary: Summary) -> str:
    rows = (
        [row.label, *(text for c in (row.real, row.imagined)
                      for text in (c.count, c.percent, c.interval.removeprefix("95 %: ")))]
        for row in result_rows(summary)
    )
    columns = ("", *(text for side in ("real simulator", "imagined") for text in (side, "", "95 % interval")))
    table = html_table(columns, (tuple(map(escape, row)) for row in rows), numbers=range(1, 7), mark_last=True)
    return table + (
        '<p class="faint">Intervals of rates: Wilson. Interval of the real difference: the same seeds before and after '
        "(Tango's score interval). Imagined success is what the world model claims; only real success counts.</p>"
    )


def _rounds(summary: Summary) -> Iterable[str]:
    if not summary.rounds:
        return
    table = html_table(ROUND_COLUMNS, (tuple(map(escape, row)) for row in round_rows(summary)))
    yield f"<h2>Online rounds</h2>{table}" + (
        '<p class="faint">After each round but the last, the policy acted in the simulator and the world model went on '
        "training on what it saw there. The refreshed model is taken only where it is no worse on held-out episodes. "
        "Imagined rates are those of the model that the round trained in.</p>"
    )


def _tasks(summary: Summary) -> Iterable[str]:
    if summary.by_task:
        table = html_table(TASK_COLUMNS, (tuple(map(escape, row)) for row in task_rows(summary)), numbers=range(1, 4))
        yield f"<h2>Real success by task</h2>{table}"


def _exploit_meter(summary: Summary) -> Iterable[str]:
    if not summary.exploit_meter:
        return
    table = html_table(EXPLOIT_COLUMNS, (tuple(map(escape, row)) for row in exploit_rows(summary)), numbers=range(4))
    yield f"<h2>{escape(exploit_title(summary).capitalize())}</h2>{table}" + (
        '<p class="faint">The same first frames each time. Imagined: the policy in the model. Replayed: the actions it '
        "chose there, in the simulator. Real: the policy in the simulator. Precision: share of the imagined successes "
        "that replayed succeed; recall: share of the replayed successes that are imagined ones.</p>"
    )
    yield from (f"<p>Training ended early: {escape(reason)}.</p>" for reason in summary.stopped)


def _acceptance(report: Mapping[str, Any]) -> str:
    if not report:
        return "<p>Not measured.</p>"
    rows = []
    for criterion in report["criteria"]:
        outcome = acceptance_outcome(criterion)
        why = {"failed": str(criterion["remedy"]), "undecided": "too few episodes"}.get(outcome, "")
        mark = f'<span class="{MARKS[outcome]}">{outcome}</span>{": " if why else ""}{escape(why)}'
        interval = " to ".join(f"{end:.2f}" for end in criterion.get("interval") or ())
        threshold = "" if criterion["threshold"] is None else f"{float(criterion['threshold']):g}"
        rule = escape(f"{criterion['rule']} {threshold}")
        rows.append((escape(str(criterion["name"])), _value(criterion["value"]), interval, rule, mark))
    notes = "".join(f'<p class="faint">{escape(str(note))}</p>' for note in report.get("notes", ()))
    metrics = [(escape(name), _value(value)) for name, value in report.get("metrics", {}).items()]
    if metrics:
        table = html_table(("metric", "value"), metrics)
        notes += f"<details><summary>all numbers of the held-out rollouts</summary>{table}</details>"
    words = {"failed": "Failed: trained in it all the same", "undecided": "Undecided: too few episodes"}.get(
        acceptance_outcome(report), "Passed"
    )
    return (
        f"<p>{words}. Judged on {report['episodes']} held-out real episodes.</p>"
        f"{html_table(('criterion', 'value', '95 %', 'must be', ''), rows, numbers=(1, 2))}{notes}"
    )


def _again(run_dir: Path, summary: Summary) -> str:
    bag = escape(summary.bag or "no bag was recorded")
    parts = [
        f"<p>Run folder: <code>{escape(str(run_dir))}</code><br>Bag (images, actions, rewards, episodes, versions): "
        f"<code>{bag}</code></p>"
    ]
    if summary.command:
        parts.append(f"<p>The command behind this page:</p><pre>{escape(summary.command)}</pre>")
    if summary.bag and len(summary.rounds) < 2:
        replay = (
            f"python3 launch_scripts/replay_offline.launch.py bag_uri:={summary.bag} "
            f"config_file:={run_dir}/config.yaml initial_policy:={run_dir}/policies/weak.safetensors rate:=100"
        )
        parts.append(
            "<p>Play the bag to a learner, which trains from it to the same weights, file for file (in a run folder of "
            f"its own):</p><pre>{escape(replay)}</pre>"
        )
    return "".join(parts)


def _value(value: Any) -> str:
    return "undefined" if value is None else f"{float(value):.3f}"
