"""The report of a run of loop 2: summary.json, the table of held-out scores, report.html."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from wm_nodes.reports.console_table import estimate, make_table
from wm_nodes.reports.curves import Panel
from wm_nodes.reports.html import MARK, Picture, write_page

TITLES = {
    "tracking": "tracking score", "object_cm": "object error, cm", "tool_cm": "tool error, cm", "psnr_db": "PSNR, dB",
    "scenery": "scenery error", "success": "task done at the end", "outcome": "outcome score",
    "ssim": "SSIM", "perceptual": "perceptual score", "closeness": "closeness of pictures",
    "execution": "done signal of the action world model", "execution_success": "task done in the action world model",
}
"""Score to its name for people, in the order of the tables; see docs/metrics.md."""
UNREWARDED_TITLES = {
    "executed_success": "executed: task done", "executed_object_cm": "executed: object elsewhere, cm",
    "reader_success": "task done, other reader", "object_permanence": "object still seen (share)",
    "impossible_tool_steps": "impossible tool steps (share)",
}
"""The same of metrics that no reward can weigh."""
ALL_TITLES = TITLES | UNREWARDED_TITLES


@dataclass(frozen=True)
class ScoreChange:
    """One held-out score."""

    before: float
    """Mean over the contexts."""
    after: float
    """Mean over the contexts."""
    difference: float
    """After minus before, mean over the same contexts."""
    low: float
    """Of its 95 % bootstrap interval."""
    high: float
    """Of its 95 % bootstrap interval."""
    verdict: str
    """better or worse; empty where chance may explain it."""


@dataclass(frozen=True)
class ClipSummary:
    """The results of a run of loop 2."""

    task: str
    """By name."""
    preset: str
    """That the settings began with."""
    seed: int
    """Of every random number."""
    iterations: int
    """Buffers trained on."""
    version: int
    """Optimizer steps."""
    contexts: int
    """Held-out ones behind each score."""
    scores: Mapping[str, ScoreChange]
    """By name."""
    unrewarded: Mapping[str, ScoreChange] = field(default_factory=dict)
    """As scores, of metrics that no reward can weigh."""
    executed: int = 0
    """Contexts behind those that begin with executed_."""
    not_measured: Mapping[str, str] = field(default_factory=dict)
    """Why one of them is missing, by name."""
    evaluations: int = 0
    """Held-out ones made while training."""
    watched: Sequence[str] = ()
    """Scores that the alarm of DD-2 compared in them."""
    hacked: Sequence[Mapping[str, Any]] | None = None
    """Evaluations with an alarm: step (buffers trained on), reward_slope, slopes by score, text; None: it never looked,
    because there were fewer evaluations than evaluation.window."""
    bag: str = ""
    """Newest recording."""
    minutes: float = float("nan")
    """Of the call that made the results."""
    command: str = ""
    """That call, as typed."""
    machine: Mapping[str, str] = field(default_factory=dict)
    """Facts by name."""
    date: str = ""
    """Year-month-day of that call."""


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
    title = f"held-out contexts (n = {summary.contexts}), one ODE clip each"
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
    classes = {"better": "good", "worse": "bad"}
    scores = (
        (name, *cells, MARK.format(classes.get(verdict, ""), verdict)) for name, verdict, cells in _rows(summary)
    )
    return write_page(
        "clips.html", run_dir, summary, pictures, config_text, title=title, verdict=clip_verdict(summary),
        scores=scores, hacking=hacking_text(summary),
        alarms=[(alarm["step"], alarm["text"]) for alarm in summary.hacked or ()],
    )


def _rows(summary: ClipSummary) -> Iterable[tuple[str, str, tuple[str, str, str]]]:
    """Name, verdict, and the cells before, after, difference."""
    for name, change in {**summary.scores, **summary.unrewarded}.items():
        n = f" (n = {summary.executed})" if name.startswith("executed_") else ""
        interval = estimate((change.difference, change.low, change.high))
        yield ALL_TITLES[name] + n, change.verdict, (f"{change.before:.4f}", f"{change.after:.4f}", interval)
    for name, reason in summary.not_measured.items():
        yield ALL_TITLES[name], "", ("not measured", "not measured", reason)
