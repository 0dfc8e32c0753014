"""Held-out contexts beside the training reward: their scores, one ODE clip each, and the alarm of DD-2.

Shapes: E contexts.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.execution_reward import EXECUTION_SCORES, load_execution_reward
from wm_nodes.video_rl.reference_reward import (
    PICTURE_SCORES,
    ClipScores,
    all_scores,
    load_probe,
    mix_rewards,
    more_is_better,
)
from wm_nodes.video_rl.reward_hacking import HackedMetric, find_hacked_metrics
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

SECTION = "heldout"
"""Of metrics.jsonl: scores by name, mean over the contexts, at the number of buffers trained on."""
WATCHED = (*ClipScores.__dataclass_fields__, *PICTURE_SCORES)
OUTCOMES = ("success", "outcome", *EXECUTION_SCORES)

HeldoutScores = Callable[[], Mapping[str, float]]
"""The held-out scores of a network's weights at the moment of the call."""


def context_scores(
    folder: VideoFolder, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
) -> dict[str, Tensor]:
    """Score one ODE clip of each of the first `evaluation.contexts` held-out contexts, by name, float64 (E,).

    Where the model chooses the motion, how near it is to the recorded one says nothing, and is left out.
    """
    contexts = evaluated_contexts(heldout, config)
    folder.network.eval()
    frames = sample_by_ode(folder, contexts, config, config.evaluation.num_steps)
    scores = all_scores(
        frames, contexts, probe, folder.codec, folder.clip["num_conditioning"], config.rewards,
        load_execution_reward(config, folder, contexts, probe),
    )
    return {name: scores[name] for name in OUTCOMES if name in scores} if config.groups.hide_actions else scores


def evaluated_contexts(heldout: Clips, config: VideoRlConfig) -> Clips:
    """Return the first `evaluation.contexts` held-out contexts, or all where there are fewer."""
    return heldout.select(torch.arange(min(config.evaluation.contexts, len(heldout))))


def load_or_measure_scores(
    path: Path, folder: VideoFolder, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
) -> dict[str, list[float]]:
    """Return context_scores(): read from `path` where they are of the same weights, else measured and written there."""
    def measure() -> dict[str, list[float]]:
        return {name: values.tolist() for name, values in context_scores(folder, heldout, probe, config).items()}

    return measured_once(path, {"sha256": pack_weights(folder.network).sha256}, measure)


def measured_once(path: Path, of: Mapping[str, Any], measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what `measure` finds, as JSON: read from `path` where that is `of` the same, else written there."""
    if path.is_file() and (saved := read_json(path, AGAIN)).get("of") == of:
        return dict(saved["found"])
    found = measure()
    write_atomic(path, json.dumps({"of": of, "found": found}).encode())
    return found


def validation_scores(
    folder: VideoFolder, bags: Sequence[Path], model_dir: Path, config: VideoRlConfig
) -> HeldoutScores:
    """Return the scores of the weights that folder.network has at a call; `reward` too, where the rewards are such.

    Raises:
        BagError: an unusable bag. ValueError: model_dir has no position probe.
    """
    clips = load_clips(bags, folder.clip["stride"], config.clip_steps)
    probe = load_probe(model_dir, device_of(folder.network))

    def scores() -> dict[str, float]:
        values = context_scores(folder, clips, probe, config)
        if config.rewards.keys() <= values.keys():
            values["reward"] = mix_rewards(values, config.rewards)
        return {name: float(value.mean()) for name, value in values.items()}

    return scores


def find_hacked_now(lines: Sequence[Mapping[str, Any]], window: int) -> list[HackedMetric] | None:
    """Return the metrics that fell over the newest `window` evaluations in lines of metrics.jsonl while the training
    reward rose (DD-2), None while there are fewer evaluations. The reward of an evaluation is the mean of the buffers
    since the one before; slopes are per evaluation, of more_is_better(). Only WATCHED scores are compared.
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
        return None
    names = [name for name in WATCHED if all(row.get(name) is not None for row in rows)]
    curves = {name: more_is_better(name, [row[name] for row in rows]).tolist() for name in names}
    return find_hacked_metrics(proxy, curves, window=window)


def alarm_scalars(alarms: Sequence[HackedMetric] | None) -> dict[str, float]:
    """Return for metrics.jsonl the number of alarms, and the slopes of the reward and of each score; {} for None."""
    if alarms is None:
        return {}
    scalars = {"hacked": float(len(alarms))}
    for alarm in alarms:
        scalars |= {"reward_slope": alarm.proxy_slope, f"hacked_{alarm.metric}": alarm.true_slope}
    return scalars


def alarms_of(line: Mapping[str, Any]) -> list[HackedMetric]:
    """Read the alarms in a line of metrics.jsonl."""
    slopes = {name: line.get(f"hacked_{name}") for name in WATCHED}
    return [HackedMetric(name, line["reward_slope"], slope) for name, slope in slopes.items() if slope is not None]


def alarm_text(alarms: Sequence[HackedMetric]) -> str:
    """One sentence for the alarms of an evaluation; empty where there are none."""
    if not alarms:
        return ""
    worse = ", ".join(f"{alarm.metric} by {-alarm.true_slope:.3g}" for alarm in alarms)
    return (
        f"the training reward rises by {alarms[0].proxy_slope:.3g} per evaluation while held-out scores get worse: "
        f"{worse}; weigh them in, or stop earlier"
    )
