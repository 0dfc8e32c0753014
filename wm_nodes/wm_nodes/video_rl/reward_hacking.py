"""Detects reward hacking (DD-2): the training reward goes up while what it stands for does not.

Alarms are numbers of a line of metrics.jsonl: `hacked`, how many metrics did not follow the reward; `reward_slope`, and
`hacked_<metric>`, the slope of each.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from wm_nodes.core.statistics import t_975
from wm_nodes.video_rl.reference_reward import CLIP_SCORES, PICTURE_SCORES, more_is_better
from wm_nodes.video_rl.validation import OUTCOMES

SECTION = "heldout"
"""Of metrics.jsonl: scores by name, mean over the contexts, at the number of buffers trained on."""
WATCHED = (*CLIP_SCORES, *PICTURE_SCORES)
"""See watched_scores()."""


def find_hacked_metrics(proxy: Sequence[float], held_out: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return by name the least-squares slope of each metric where it is < 0 while the proxy's is > 0.

    Both count only where their 95 % interval (Student's, n - 2 degrees of freedom) leaves out 0: two flat, noisy curves
    raise an alarm in less than one case of a thousand, however few the evaluations.

    Args:
        proxy: the training reward at each of n >= 3 evaluations. held_out: true metrics at the same ones, more is
            better.
    """
    widths = t_975(len(proxy) - 2)
    rise, rise_error = slope(proxy)
    if rise <= widths * rise_error:
        return {}
    slopes = {name: slope(values) for name, values in held_out.items()}
    return {name: trend for name, (trend, error) in slopes.items() if trend < -widths * error}


def watched_scores(hide_actions: bool) -> tuple[str, ...]:
    """Return what is compared with the reward: with given actions not OUTCOMES, of which more is no better there."""
    return tuple(name for name in WATCHED if hide_actions or name not in OUTCOMES)


def slope(values: Sequence[float]) -> tuple[float, float]:
    """Return the least-squares slope per step and its standard error."""
    y = np.asarray(values, np.float64)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    trend = float((x * y).sum() / (x * x).sum())
    residual = y - y.mean() - trend * x
    return trend, float(np.sqrt((residual**2).sum() / max(1, len(y) - 2) / (x * x).sum()))


def hacking_alarms(
    lines: Sequence[Mapping[str, Any]], window: int, watched: Sequence[str] = WATCHED
) -> dict[str, float]:
    """Return the alarms over the newest `window` evaluations in lines of metrics.jsonl; {} while there are fewer.

    The reward of an evaluation is the mean of the buffers since the one before; slopes are per evaluation, of
    more_is_better(). watched: the scores that are compared, where every one of these evaluations has them.
    """
    rewards = {line["step"]: line["reward_mean"] for line in lines if line["section"] == "grpo"}
    evaluations = {line["step"]: line for line in lines if line["section"] == SECTION}
    proxy, rows, begin = list[float](), list[Mapping[str, Any]](), 0
    for step in sorted(evaluations):
        since = [value for at, value in rewards.items() if begin < at <= step and value is not None]
        begin = step
        if since:
            proxy.append(sum(since) / len(since))
            rows.append(evaluations[step])
    if len(proxy) < window:
        return {}
    rows = rows[-window:]
    names = [name for name in watched if all(row.get(name) is not None for row in rows)]
    curves = {name: more_is_better(name, [row[name] for row in rows]).tolist() for name in names}
    found = find_hacked_metrics(proxy[-window:], curves)
    alarms = {"reward_slope": slope(proxy[-window:])[0], **{f"hacked_{name}": found[name] for name in found}}
    return {"hacked": float(len(found)), **(alarms if found else {})}


def hacked_slopes(line: Mapping[str, Any]) -> dict[str, float]:
    """The slopes of the hacked metrics in a line of metrics.jsonl."""
    return {name: line[f"hacked_{name}"] for name in WATCHED if line.get(f"hacked_{name}") is not None}


def alarm_text(line: Mapping[str, Any]) -> str:
    """One sentence for the alarms in a line of metrics.jsonl; empty where there are none."""
    if not line.get("hacked"):
        return ""
    worse = ", ".join(f"{name} by {-trend:.3g}" for name, trend in hacked_slopes(line).items())
    return (
        f"the training reward rises by {line['reward_slope']:.3g} per evaluation while held-out scores get worse: "
        f"{worse}; weigh them in, or stop earlier"
    )
