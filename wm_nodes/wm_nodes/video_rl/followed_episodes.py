"""Episodes that the action world model imagines when it follows a video model's clips, of the clips that it accepts: a
bag of them trains a policy without a demonstration.

Shapes: N clips, F frames, T control steps, H W 3 image.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import SOURCE_IMAGINED
from wm_nodes.core.types import Episode, FloatArray
from wm_nodes.recording import BagError, EpisodeBagWriter
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.execution_reward import ExecutionReward, make_execution_reward
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.world_model.position_probe import PositionProbe

BEHAVIOUR = "followed_clip"
"""Who acted in the episodes."""
BATCH = 64
"""Clips that are sampled and followed at a time."""


def write_followed_episodes(
    path: Path, folder: VideoFolder, recordings: Clips, config: VideoRlConfig, probe: PositionProbe, episodes: int, *,
    version: int = 0, on_progress: Callable[[int, int], object] = lambda accepted, followed: None,
) -> None:
    """Follow a clip from the first frame of each recording, then another of each, until `episodes` are accepted; write
    these as a bag.

    Args:
        recordings: as ExecutionReward's. Of a context, neither actions nor later frames are seen.
        config: its `execution` names the action world model; its rewards do not matter.
        version: of the video model's weights, for the episodes' policy_version.
        on_progress: called with how many clips were accepted and followed.

    Raises:
        BagError: the path exists. ValueError: clips of given actions; as make_execution_reward; no clip of any
            recording is accepted.
    """
    if path.exists():
        raise BagError(f"{path} exists already; choose another name or remove it")
    if not config.groups.hide_actions:
        raise ValueError("the clips of this run repeat the recorded actions, and following them gives the recordings "
                         "again; name a run of train-video-model --preset outcome (groups.hide_actions)")
    reward = make_execution_reward(config, folder, recordings, probe)
    custom = {"wm.video_model_sha256": pack_weights(folder.network).sha256, "wm.video_model_version": str(version)}
    spec = reward.spec(recordings.frames.shape[1])
    accepted = followed = 0
    with EpisodeBagWriter(path, spec, run_id="follow-clips", custom=custom, start_ns=1, discard_partial=True) as bag:
        for frames, references in sampled_clips(folder, recordings, config):
            made = accepted_episodes(reward, frames, references)
            for number, episode in enumerate(made, accepted + 1):
                if number <= episodes:
                    bag.write(replace(episode, episode_id=number, policy_version=version))
            accepted, followed = accepted + len(made), followed + len(frames)
            on_progress(accepted, followed)
            if accepted >= episodes:
                return
            if not accepted and followed >= len(recordings):
                raise ValueError(f"none of {followed} clips is accepted: the action world model follows them, and its "
                                 f"done signal stays below {reward.threshold}; train the video model longer")


def sampled_clips(folder: VideoFolder, contexts: Clips, config: VideoRlConfig) -> Iterator[tuple[Tensor, Clips]]:
    """Yield decoded clips, uint8 (N, F, H, W, 3), and the recordings that they begin with, a round over all contexts
    after the other, without end. Noise: stream `followed_clips` at (round, first context)."""
    for number in count():
        for first in range(0, len(contexts), BATCH):
            references = contexts.select(torch.arange(first, min(first + BATCH, len(contexts))))
            drawn = config.with_values(seed=stream_seed(config.seed, "followed_clips", number, first))
            yield sample_by_ode(folder, references, drawn, config.evaluation.num_steps), references


@torch.inference_mode()
def accepted_episodes(reward: ExecutionReward, frames: Tensor, references: Clips) -> list[Episode]:
    """Return what the action world model imagines of each decoded clip, uint8 (N, F, H, W, 3), whose done signal
    exceeds the threshold: pictures, states and actions at control rate up to that step, the last.

    Without ids and versions; `extra` has the signal that it ends with.
    """
    shown, states = [references.frames[:, 0].cpu().numpy()], [references.first_states()]
    actions, signals = list[FloatArray](), list[FloatArray]()
    for step in reward.follow(reward.paths(frames, references), references):
        shown.append(step.arm.frames_NHWC.cpu().numpy().copy())
        states.append(step.arm.states_NP.cpu().numpy().copy())
        actions.append(step.actions_NA.cpu().numpy())
        signals.append(step.signal_N.cpu().numpy())
    images_NT = np.stack(shown, 1)
    states_NT, actions_NT, signals_NT = (np.stack(some, 1) for some in (states, actions, signals))
    done_NT = signals_NT > reward.threshold
    episodes = list[Episode]()
    for row in np.flatnonzero(done_NT.any(1)).tolist():
        steps = int(done_NT[row].argmax()) + 1
        episodes.append(Episode(
            images=images_NT[row, : steps + 1], states=states_NT[row, : steps + 1], actions=actions_NT[row, :steps],
            ground_truth=np.zeros((steps + 1, 0), np.float32), success=np.arange(steps + 1) == steps,
            rewards=np.full(steps, np.nan, np.float32), terminated=True, truncated=False, task=references.task,
            instruction=references.instructions[row], behaviour=BEHAVIOUR,
            seed=references.seeds[row], episode_id=0, source=SOURCE_IMAGINED,
            extra={"done_signal": float(signals_NT[row, steps - 1])},
        ))
    return episodes
