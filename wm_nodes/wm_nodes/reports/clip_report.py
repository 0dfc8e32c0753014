"""The report of a run of loop 2: summary.json, the table of held-out scores, report.html."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from rich.table import Table

from wm_nodes.reports.console_table import estimate, make_table
from wm_nodes.reports.curves import Panel
from wm_nodes.reports.html import Picture, figures, html_table, made_on, write_page

TITLES = {
    "tracking": "tracking score", "object_cm": "object error, cm", "tool_cm": "tool error, cm", "psnr_db": "PSNR, dB",
    "scenery": "scenery error", "motion": "motion share", "success": "task done at the end", "outcome": "outcome score",
    "ssim": "SSIM", "perceptual": "perceptual score", "closeness": "closeness of pictures",
}
"""Score to its name for people, in the order of the tables; see docs/metrics.md."""
UNREWARDED_TITLES = {
    "executed_success": "executed: task done", "executed_object_cm": "executed: object elsewhere, cm",
    "reader_success": "task done, other reader", "object_permanence": "object still seen (share)",
    "impossible_tool_steps": "impossible tool steps (share)", "ghost_motion": "object moves untouched (share)",
    "scenery_change": "scenery change",
}
"""The same of metrics that no reward can weigh."""
ALL_TITLES = TITLES | UNREWARDED_TITLES


@dataclass(frozen=True)
class ScoreChange:
    """One held-out score, means over the contexts. low, high: 95 % bootstrap interval of after minus before on the same
    contexts. verdict: better or worse; empty where chance may explain it."""

    before: float
    after: float
    difference: float
    low: float
    high: float
    verdict: str


@dataclass(frozen=True)
class ClipSummary:
    """The results of a run of loop 2.

    scores: by name. contexts: held-out ones behind each. iterations: buffers trained on. version: optimizer steps.
    weights: which ones were measured after, "averaged" or "last". unrewarded: as scores, of metrics that no reward can
    weigh. executed: contexts behind those that begin with executed_. not_measured: why one of them is missing, by name.
    evaluations: held-out ones made while training. watched: scores that the alarm of DD-2 compared in them. hacked:
    evaluations with an alarm: step (buffers trained on), reward_slope, slopes by score, text; None: it never looked,
    because there were fewer evaluations than evaluation.window.
    bag: newest recording. minutes, command (as typed), machine (facts by name), date (year-month-day): of the call that
        made the results.
    """

    task: str
    preset: str
    seed: int
    iterations: int
    version: int
    weights: str
    contexts: int
    scores: Mapping[str, ScoreChange]
    unrewarded: Mapping[str, ScoreChange] = field(default_factory=dict)
    executed: int = 0
    not_measured: Mapping[str, str] = field(default_factory=dict)
    evaluations: int = 0
    watched: Sequence[str] = ()
    hacked: Sequence[Mapping[str, Any]] | None = None
    bag: str = ""
    minutes: float = float("nan")
    command: str = ""
    machine: Mapping[str, str] = field(default_factory=dict)
    date: str = ""


def clip_verdict(summary: ClipSummary) -> str:
    """One sentence: which scores changed by more than chance explains."""
    parts = []
    for verdict in ("better", "worse"):
        both = {**summary.scores, **summary.unrewarded}
        names = [ALL_TITLES[name] for name, change in both.items() if change.verdict == verdict]
        if names:
            parts.append(f"{verdict.capitalize()}: {'; '.join(names)}")
    if summary.not_measured:
        parts.append(f"Not measured: {'; '.join(ALL_TITLES[name] for name in summary.not_measured)}")
    sentence = ". ".join(parts) or "No difference that chance does not explain"
    return f"{sentence} (n = {summary.contexts} held-out contexts)."


def hacking_text(summary: ClipSummary) -> str:
    """One sentence: whether the alarm of DD-2 looked, at what, and whether it rang."""
    if summary.hacked is None:
        return (
            f"Not watched: {summary.evaluations} held-out evaluations while training are fewer than the alarm compares "
            "(evaluation.every, evaluation.window)."
        )
    of = f"{summary.evaluations} held-out evaluations of {', '.join(ALL_TITLES[name] for name in summary.watched)}"
    if not summary.hacked:
        return f"No alarm in {of}: none got worse while the training reward rose."
    return f"The training reward rose while held-out scores got worse ({of})."


def scores_table(summary: ClipSummary) -> Table:
    """The table for the terminal."""
    title = f"held-out contexts (n = {summary.contexts}), one ODE clip each, {summary.weights} weights"
    columns = ("score", "before", "after", "difference, 95 % bootstrap interval", "")
    marks = {"better": "[green]better[/]", "worse": "[red]worse[/]"}
    rows = ((name, *cells, marks.get(verdict, "")) for name, verdict, cells in _rows(summary))
    return make_table(title, columns, rows, left=("score", ""), caption=clip_verdict(summary))


def clip_panels(updates: int) -> tuple[Panel, ...]:
    """The course of a training with so many optimizer steps on each buffer."""
    return (
        Panel("reward", {"grpo/reward_mean": "of the clips trained on", "heldout/reward": "held out, ODE"}),
        Panel("held-out tracking score, (0, 1]", {"heldout/tracking": ""}),
        Panel("held-out clips that end with the task done (share)", {"heldout/success": ""}, (0.0, 1.0)),
        Panel("held-out position errors, cm", {"heldout/object_cm": "object", "heldout/tool_cm": "tool"}),
        Panel("held-out scenery error, of [0, 1]", {"heldout/scenery": ""}),
        Panel("KL to the anchor", {f"grpo/kl_{k}": f"update {k}" for k in range(1, updates + 1)}),
        Panel(
            f"clipped transitions (share), update {updates}",
            {f"grpo/clip_low_share_{updates}": "below", f"grpo/clip_high_share_{updates}": "above"}, (0.0, 1.0),
        ),
        Panel("groups without spread (share)", {"grpo/zero_std_ratio": ""}, (0.0, 1.0)),
        Panel("gradient norm before clipping", {f"grpo/grad_norm_{k}": f"update {k}" for k in range(1, updates + 1)}),
    )


def write_clip_report(
    run_dir: Path, summary: ClipSummary, pictures: Sequence[Picture] = (), *, config_text: str = ""
) -> Path:
    """Write <run_dir>/report.html and return its path. Raises FileNotFoundError: a picture does not exist."""
    title = f"{summary.task}: a video world model post-trained by GRPO"
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(clip_verdict(summary))}</p>',
        f'<p class="faint">preset {escape(summary.preset)}, seed {summary.seed}, {summary.iterations} buffers, '
        f"{summary.version} optimizer steps, {summary.minutes:.1f} minutes, {escape(summary.date)}</p>",
        "<h2>Held-out contexts</h2>", _scores(summary),
        "<h2>Reward hacking</h2>", *_hacking(summary),
        *figures(pictures),
        "<h2>Look closer, do it again</h2>", *_again(run_dir, summary),
        *made_on(summary.machine, config_text),
    ]
    return write_page(run_dir, title, body)


def _rows(summary: ClipSummary) -> Iterable[tuple[str, str, tuple[str, str, str]]]:
    """Name, verdict, and the cells before, after, difference."""
    for name, change in {**summary.scores, **summary.unrewarded}.items():
        n = f" (n = {summary.executed})" if name.startswith("executed_") else ""
        interval = estimate((change.difference, change.low, change.high))
        yield ALL_TITLES[name] + n, change.verdict, (f"{change.before:.4f}", f"{change.after:.4f}", interval)
    for name, reason in summary.not_measured.items():
        yield ALL_TITLES[name], "", ("not measured", "not measured", reason)


def _scores(summary: ClipSummary) -> str:
    marks = {"better": "good", "worse": "bad"}
    rows = (
        (escape(title), *map(escape, cells), f'<span class="{marks.get(verdict, "")}">{verdict}</span>')
        for title, verdict, cells in _rows(summary)
    )
    columns = ("score", "before", "after", "difference, 95 % interval", "")
    return (
        html_table(columns, rows, numbers=(1, 2, 3))
        + f'<p class="faint">Means over {summary.contexts} contexts that nothing was trained on, one ODE clip each '
        f"from the same noise; after: the {escape(summary.weights)} weights. Intervals: paired bootstrap over the "
        "contexts. Positions are read off the pictures by a probe that shares nothing with the video model. Executed: "
        "the clip's tool path, followed in the simulator from the same first state.</p>"
    )


def _hacking(summary: ClipSummary) -> Iterable[str]:
    yield f'<p class="{"bad" if summary.hacked else ""}">{escape(hacking_text(summary))}</p>'
    if not summary.hacked:
        return
    rows = ((str(alarm["step"]), escape(str(alarm["text"]))) for alarm in summary.hacked)
    yield html_table(("buffers", "alarm"), rows, numbers=(0,))


def _again(run_dir: Path, summary: ClipSummary) -> Iterable[str]:
    bag = escape(summary.bag or "no bag was recorded")
    yield (
        f"<p>Run folder: <code>{escape(str(run_dir))}</code><br>Bag (clips, pictures, scores, versions): "
        f"<code>{bag}</code></p><p>The command behind this page:</p><pre>{escape(summary.command)}</pre>"
    )
    if summary.bag:
        script = "python3 launch_scripts/wm.py"
        again = f"{script} rescore {run_dir}\n{script} retrain {run_dir}"
        yield (
            "<p>Score the recorded pictures again and compare bit for bit; train again from the kept buffers (all of "
            f"them are needed: --keep-buffers):</p><pre>{escape(again)}</pre>"
        )
