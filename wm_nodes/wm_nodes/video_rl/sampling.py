"""Groups of clips for GRPO: contexts in, a rollout buffer out. Shapes: N clips of a buffer, E of an evaluation."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wm_nodes.config.schema import EXECUTION
from wm_nodes.config.video import RolloutConfig, VideoRlConfig
from wm_nodes.core.device import device_of, explain_memory
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.video_model import (
    Condition,
    RolloutBuffer,
    config_hash,
    initial_noise,
    sample_videos,
    stochastic_steps,
)
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.continuation import ClipLengths, clip_condition, continue_videos
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.execution_reward import ExecutionReward, make_execution_reward
from wm_nodes.video_rl.reference_reward import (
    PICTURE_SCORES,
    check_scenery,
    mix_rewards,
    score_clips,
    score_pictures,
)
from wm_nodes.world_model.position_probe import PositionProbe


@dataclass(frozen=True)
class GroupRequest:
    """What to sample."""

    contexts: tuple[int, ...]
    """Rows of the generator's clips."""
    group_size: int
    """Clips of each context."""
    iteration: int
    """Of the learner."""
    policy_version: int
    """Of the weights that sample."""
    history: int | None = None
    """Clips that the model makes one after the other before those of a group, which share them; None: the group's are
    of whole recordings."""


def sample_buffer(
    network: nn.Module, config: VideoRlConfig, condition: Condition, noise: Tensor, seeds: Tensor, groups: Tensor,
    samples: Tensor, iteration: int, policy_version: int,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> RolloutBuffer:
    """Sample one video per row of `noise`, stochastic at the window's steps of `iteration`; the buffer has no rewards.

    Noise and condition are moved to the network. seeds: of each video's step noise. groups, samples: int64 (N,), see
    RolloutBuffer.
    """
    settings = config.rollout
    steps = stochastic_steps(settings.num_steps, config.window, iteration)
    device = device_of(network)
    condition = condition.to(device)
    with explain_memory(device, rollout__micro_batch=settings.micro_batch, groups__contexts=config.groups.contexts):
        rollout = sample_videos(network, condition, noise.to(device), seeds, settings, steps, on_progress)
    condition = condition.to(rollout.latents.device)
    return RolloutBuffer(rollout, condition, groups, samples, {}, policy_version, iteration, config_hash(settings))


class RecordedContexts:
    """Recorded contexts as a source of post-training (train.ClipSource): clips of their first frames, actions (unless
    groups.hide_actions) and instruction, scored against the recordings. With groups.history they are continuations
    (DD-33): one clip each, from the last frames that the model itself made of a context.

    Args:
        folder: codec and network; the network is used as it is, so loading newer weights into it is enough.
        contexts: the recorded clips to draw contexts from.
        probe: reads positions off the clips; None: they are sampled and not scored.

    Raises:
        ValueError: groups.history of a model that makes whole episodes, or of recordings that end before; as
            make_execution_reward; as check_scenery where that is a reward.
    """

    def __init__(
        self, folder: VideoFolder, contexts: Clips, config: VideoRlConfig, probe: PositionProbe | None = None
    ) -> None:
        self.folder, self.contexts, self.config, self._probe = folder, contexts, config, probe
        clips, frames = config.groups.history, contexts.frames.shape[1]
        if clips and (wanted := self._made(clips + 1)) > frames:
            raise ValueError(
                f"{clips} clips and one more have {wanted} frames, the recordings {frames}; lower groups.history"
            )
        if probe is not None and config.rewards.get("scenery"):
            for history in range(clips + 1):
                check_scenery(self._part(contexts, history if clips else None))
        self.execution: ExecutionReward | None = None
        """Of the clips, where `execution` has a weight."""
        if probe is not None and config.rewards.get(EXECUTION):
            self.execution = make_execution_reward(config, folder, contexts, probe)

    @property
    def probe(self) -> PositionProbe:
        """Raises ValueError where there is none."""
        if self._probe is None:
            raise ValueError("these contexts have no probe to score clips with; give them one")
        return self._probe

    def request(self, iteration: int, policy_version: int) -> GroupRequest:
        """Draw the contexts of an iteration without replacement from stream `contexts`."""
        groups, seed, history = self.config.groups, self.config.seed, None
        count = min(groups.contexts, len(self.contexts))
        drawn = numpy_stream(seed, "contexts", iteration).choice(len(self.contexts), count, replace=False)
        if groups.history:  # from 0 on: without the first clips a model forgets how to make them
            history = int(numpy_stream(seed, "history", iteration).integers(groups.history + 1))
        contexts = tuple(int(i) for i in drawn)
        return GroupRequest(contexts, groups.group_size, iteration, policy_version, history)

    def sample(
        self, request: GroupRequest, on_progress: Callable[[int, int], None] = lambda done, total: None
    ) -> RolloutBuffer:
        """Sample len(contexts) x group_size clips without rewards; equal requests and weights give equal bytes.

        on_progress: called with (clips sampled, of how many); may raise to stop.
        """
        group = torch.arange(len(request.contexts)).repeat_interleave(request.group_size)
        sample = torch.arange(request.group_size).repeat(len(request.contexts))
        seeds = _seeds(self.config.seed, "clip_steps", request.iteration, group, sample)
        noises = torch.zeros_like(sample) if self.config.groups.shared_noise else sample
        condition = self.condition(request)
        _, _, H, W, _ = self.contexts.frames.shape
        codec = self.folder.codec
        shape = codec.channels, condition.actions.shape[1] + 1, H // codec.patch, W // codec.patch
        noise = initial_noise(shape, _seeds(self.config.seed, "clip_noise", request.iteration, group, noises))
        return sample_buffer(
            self.folder.network, self.config, condition, noise, seeds, group, sample, request.iteration,
            request.policy_version, on_progress,
        )

    def condition(self, request: GroupRequest) -> Condition:
        """Return what the request's clips are made of, a row per clip: recorded first frames, or the last frames of its
        history, which the model makes here by ODE, once per context."""
        start = _condition(self.folder, self.contexts.select(torch.tensor(request.contexts)), self.config)
        if request.history is None:
            return start.repeat_interleave(request.group_size)
        lengths, contexts = self._lengths(), torch.arange(len(request.contexts))

        def seeds(clip: int) -> Tensor:
            of = torch.full_like(contexts, clip)
            return _seeds(self.config.seed, "history_noise", request.iteration, contexts, of)

        frames, settings = self._made(request.history), _ode(self.config, self.config.rollout.num_steps)
        videos = continue_videos(self.folder.network, start, lengths, frames, seeds, settings)
        return clip_condition(videos, start, lengths).repeat_interleave(request.group_size)

    def place(self, history: int | None) -> tuple[int, int]:
        """Return where in the recordings clips after such a history begin, and how many of their frames are given."""
        if history is None:
            return 0, self.folder.clip["num_conditioning"]
        return self._lengths().place(self._made(history))

    def references(self, request: GroupRequest) -> Clips:
        """Return the recordings that the request's clips are scored against, one row per clip, of the same frames."""
        recorded = self.contexts.select(torch.tensor(request.contexts).repeat_interleave(request.group_size))
        return self._part(recorded, request.history)

    def score(self, request: GroupRequest, clips: RolloutBuffer) -> RolloutBuffer:
        """Return the buffer with every score of its clips and the training reward `total`, mixed by config.rewards."""
        scores = self.scores(request, self.folder.codec.decode(clips.rollout.latents))
        return clips.with_rewards({**scores, "total": mix_rewards(scores, self.config.rewards)})

    def scores(self, request: GroupRequest, frames: Tensor, also: Collection[str] = ()) -> dict[str, Tensor]:
        """Return by name the scores of the request's decoded clips, uint8 (N, F, H, W, 3): those of score_clips(), of
        `execution`, and where one is wanted PICTURE_SCORES, which cost twice as much.

        also: scores that are wanted beside the rewards.
        """
        references, (_, given) = self.references(request), self.place(request.history)
        scores = score_clips(frames, references, self.probe, given)
        if not {*self.config.rewards, *also}.isdisjoint(PICTURE_SCORES):
            scores |= score_pictures(frames, references, self.folder.codec, given)
        if self.execution is not None:
            scores |= self.execution.score(frames, references)
        return scores

    def _part(self, recordings: Clips, history: int | None) -> Clips:
        """The frames of recordings that clips after such a history show."""
        first, given = self.place(history)
        return recordings if history is None else recordings.window(first, given + self._lengths().new)

    def _made(self, history: int) -> int:
        """Frames of so many clips, the recorded first ones among them."""
        return self.folder.clip["num_conditioning"] + history * self._lengths().new

    def _lengths(self) -> ClipLengths:
        if self.folder.lengths is None:
            raise ValueError(
                "this video model makes whole episodes and cannot go on from its own frames; set groups.history 0, or "
                "train a model of the preset closed_loop"
            )
        return self.folder.lengths


def sample_by_ode(folder: VideoFolder, contexts: Clips, config: VideoRlConfig, num_steps: int) -> Tensor:
    """Sample one clip of each context and decode it: uint8 (E, F, H, W, 3).

    A model that goes on from its own frames makes it clip after clip.
    """
    rows, condition = torch.arange(len(contexts)), _condition(folder, contexts, config)

    def seeds(clip: int) -> Tensor:
        return _seeds(config.seed, "clip_evaluation", clip, rows, torch.zeros_like(rows))

    K, count = condition.num_conditioning, contexts.frames.shape[1]
    lengths = folder.lengths or ClipLengths(K, count - K)
    videos = continue_videos(folder.network, condition, lengths, count, seeds, _ode(config, num_steps))
    return folder.codec.decode(videos)


def _condition(folder: VideoFolder, contexts: Clips, config: VideoRlConfig) -> Condition:
    text_dim = folder.network.settings.text_dim
    condition = contexts.condition(folder.codec, folder.clip["num_conditioning"], text_dim)
    return condition.without_actions() if config.groups.hide_actions else condition


def _ode(config: VideoRlConfig, num_steps: int) -> RolloutConfig:
    sampler = config.rollout.sampler.with_values(arm="ode")
    return config.rollout.with_values(num_steps=num_steps, sampler=sampler, buffer_device="model")


def _seeds(seed: int, name: str, iteration: int, group: Tensor, sample: Tensor) -> Tensor:
    pairs = zip(group.tolist(), sample.tolist(), strict=True)
    return torch.tensor([stream_seed(seed, name, iteration, g, s) for g, s in pairs])
