"""What group methods are compared with at equal compute: flow matching towards recordings, or towards a group's best.

Compute is counted in forwards of one clip by the network; forward and backward count three. Shapes: N clips.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig, RolloutConfig
from wm_nodes.core.device import device_of
from wm_nodes.video_model import RolloutBuffer, VideoNetwork, VideoRollout, config_hash
from wm_nodes.video_model.flow_matching import flow_matching_loss
from wm_nodes.video_rl.grpo import BufferReport, UpdateReport
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts

TRAINING_CALLS = 3
"""Forwards that one forward and backward cost."""
NAN = math.nan


class FlowMatchingLearner:
    """Trains `model` in place by flow matching on the valid clips of a buffer; the interface is that of GrpoLearner.

    Args:
        settings: learning_rate, weight_decay, max_grad_norm, updates_per_buffer are used.
        draws: (time, noise) pairs per kept clip and buffer, spread over the updates; a multiple of updates_per_buffer.
        seed: of times and noise (stream `flow_matching`).
    """

    def __init__(
        self, model: VideoNetwork, settings: GrpoConfig, rollout: RolloutConfig, *, seed: int, draws: int
    ) -> None:
        if draws % settings.updates_per_buffer:
            raise ValueError(f"{draws} draws cannot be spread over {settings.updates_per_buffer} updates evenly")
        self.model, self.settings, self.rollout, self.seed = model, settings, rollout, seed
        self.draws, self.version, self.iterations = draws, 0, 0
        self._flow = load_video_config("base").model.training.with_values(drop=0.0)
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        self._optimizer = torch.optim.AdamW(
            self.parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay
        )

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Make updates_per_buffer optimizer steps.

        Raises:
            RolloutBufferError: another sampler configuration, or other weights.
            FloatingPointError: a gradient is not finite.
        """
        buffer.check(self.rollout, self.version)
        rows = torch.nonzero(buffer.valid)[:, 0]
        updates = tuple(self._update(buffer, rows) for _ in range(self.settings.updates_per_buffer))
        self.iterations += 1
        rewards = buffer.reward
        groups = len(set(buffer.group_ids.tolist()))
        return BufferReport(
            updates=updates, reward_mean=float(rewards[buffer.valid].mean()), advantage_abs_mean=NAN,
            zero_std_ratio=NAN, invalid=int((~buffer.valid).sum()), skipped=0, dropped_groups=0,
            kept=len(rows), group_size=len(buffer) / groups, noise_share=buffer.rollout.spent_noise,
            raw_rewards={
                name: float(values[torch.isfinite(values)].mean())
                for name, values in buffer.rewards.items() if name != "total"
            },
        )

    def _update(self, buffer: RolloutBuffer, rows: Tensor) -> UpdateReport:
        device, settings = device_of(self.model), self.settings
        repeated = rows.repeat(self.draws // settings.updates_per_buffer)
        self.model.train()
        self._optimizer.zero_grad(set_to_none=True)
        latents, condition = buffer.rollout.latents[repeated].to(device), buffer.condition.rows(repeated).to(device)
        loss = flow_matching_loss(self.model, latents, condition, self._flow, self.seed, self.version)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = float(clip_grad_norm_(self.parameters, settings.max_grad_norm))
        if not math.isfinite(norm):
            raise FloatingPointError(f"the gradient is not finite at version {self.version}; lower the learning rate")
        self._optimizer.step()
        self.version += 1
        return UpdateReport(-float(loss.detach()), NAN, NAN, NAN, NAN, norm, len(repeated))


def best_and_worst(rewards: Tensor, group_ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return of each group, ascending, the rows of highest and of lowest reward, int64 (G,) each; where all are equal
    two others, too. rewards: (N,), NaN counts as lowest."""
    best, worst = [], []
    for group in sorted(set(group_ids.tolist())):
        rows = torch.nonzero(group_ids == group)[:, 0]
        order = rewards[rows].nan_to_num(nan=-math.inf).argsort(stable=True)
        best.append(int(rows[order[-1]]))
        worst.append(int(rows[order[0]]))
    return torch.tensor(best), torch.tensor(worst)


class BestAndRecorded(RecordedContexts):
    """Of each group the clip of highest reward trains, and as much the context's recording, in the row of the lowest.

    Without recordings flow matching on own clips diverges: made in a few steps, they vary less than recorded ones.
    """

    def score(self, request: GroupRequest, clips: RolloutBuffer) -> RolloutBuffer:
        scored = super().score(request, clips)
        best, worst = best_and_worst(scored.reward, scored.group_ids)
        latents, total = scored.rollout.latents.clone(), torch.full_like(scored.reward, NAN)
        recorded = self.folder.codec.encode(self.references(replace(request, group_size=1)).frames)
        latents[worst] = recorded.to(latents)
        total[best], total[worst] = scored.reward[best], scored.reward[best]
        clips = replace(scored, rollout=replace(scored.rollout, latents=latents))
        return clips.with_rewards({**scored.rewards, "total": total})


class RecordedTargets(RecordedContexts):
    """Clips that are not sampled but recorded, one per context, each after what the model itself made of the context.

    They all have reward 0.
    """

    def request(self, iteration: int, policy_version: int) -> GroupRequest:
        return replace(super().request(iteration, policy_version), group_size=1)

    def sample(
        self, request: GroupRequest, on_progress: Callable[[int, int], None] = lambda done, total: None
    ) -> RolloutBuffer:
        condition = self.condition(request)
        latents = self.folder.codec.encode(self.references(request).frames)
        settings, N = self.config.rollout, len(latents)
        none = latents.new_zeros(N, 0, *latents.shape[1:])
        rollout = VideoRollout(
            latents, (), none, none[:, :, :1], none, latents.new_zeros(0)
        )
        rows = torch.arange(N)
        return RolloutBuffer(
            rollout, condition, rows, torch.zeros_like(rows), {}, request.policy_version, request.iteration,
            config_hash(settings),
        )

    def score(self, request: GroupRequest, clips: RolloutBuffer) -> RolloutBuffer:
        return clips.with_rewards({"total": torch.zeros(len(clips))})
