"""Held-out contexts beside the training reward: their scores, one ODE clip each.

Shapes: E contexts.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.execution_reward import EXECUTION_SCORES
from wm_nodes.video_rl.reference_reward import load_probe, mix_rewards
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts, sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

OUTCOMES = ("success", "outcome", *EXECUTION_SCORES)
"""How a clip ends. With given actions it should end as its recording did, so that more is not better."""

HeldoutScores = Callable[[], Mapping[str, float]]
"""The held-out scores of a network's weights at the moment of the call."""


def context_scores(
    folder: VideoFolder, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
) -> dict[str, Tensor]:
    """Score one ODE clip of each of the first `evaluation.contexts` held-out contexts, by name, float64 (E,).

    Where the model chooses the motion, how near it is to the recorded one says nothing, and is left out.
    """
    contexts = heldout.first(config.evaluation.contexts)
    rewards = {**config.rewards, "scenery": 0.0}  # here it may be unknown
    whole = config.with_values(groups=config.groups.with_values(history=0), rewards=rewards)
    folder.network.eval()
    frames = sample_by_ode(folder, contexts, config, config.evaluation.num_steps)
    request = GroupRequest(tuple(range(len(contexts))), group_size=1, iteration=0, policy_version=0)
    scores = RecordedContexts(folder, contexts, whole, probe).scores(request, frames)
    return {name: scores[name] for name in OUTCOMES if name in scores} if config.groups.hide_actions else scores


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
    clips = load_clips(bags, folder.clip["stride"], config.clip_steps, config.task)
    probe = load_probe(model_dir, device_of(folder.network))

    def scores() -> dict[str, float]:
        values = context_scores(folder, clips, probe, config)
        if {name for name, weight in config.rewards.items() if weight} <= values.keys():
            values["reward"] = mix_rewards(values, config.rewards)
        return {name: float(value.mean()) for name, value in values.items()}

    return scores
