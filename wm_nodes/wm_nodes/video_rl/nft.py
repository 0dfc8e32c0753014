"""Negative-aware fine-tuning on the forward process (DiffusionNFT, DD-31): final clips and their advantages are enough,
from any sampler.

Shapes: M rows (video, forward time) of one network call, U generated elements.

v_old is the velocity of the weights that sampled the buffer, a copy of the parameters that train. The authors' lags
behind over several buffers, and samples.

Times are those of the sampler in density: uniform, one in each of nft.times equal parts of (0, 1), then shifted by
rollout.shift. Theirs are the sampler's own times, all of them, each with a noise of its own.
"""

from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.config.video import GrpoConfig, RolloutConfig
from wm_nodes.core.device import device_of
from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model.buffer import RolloutBuffer
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import with_conditioning
from wm_nodes.video_model.network import guided_velocity
from wm_nodes.video_rl.ratio_and_kl import LossTerms, Rows, Terms

LEAST_ERROR = 1e-5
"""Below this mean absolute error the adaptive weight no longer grows."""


class NftTerms(Terms):
    """Objective of noised clips under `model`."""

    def __init__(self, model: nn.Module, settings: GrpoConfig, rollout: RolloutConfig, seed: int) -> None:
        super().__init__(model, settings, rollout, seed)
        self.begin()

    def begin(self) -> None:
        self.old = self.trained()

    def choose(self, buffer: RolloutBuffer) -> Tensor:
        """Return which forward times train, bool (N, times): all."""
        return torch.ones(len(buffer), self.settings.nft.times, dtype=torch.bool)

    def compute(self, buffer: RolloutBuffer, rows: Rows, signals_M: Tensor, version: int) -> LossTerms:
        """Noise the clips, run the current and the old weights, and return minus the loss of DD-31.

        signals_M: the advantages. version: optimizer steps made; with the numbers of a row it decides time and noise.
        """
        device, K = device_of(self.model), buffer.condition.num_conditioning
        videos = rows.videos.to(buffer.rollout.latents.device)
        x_0 = buffer.rollout.latents[videos].to(device)
        condition = buffer.condition.rows(rows.videos.to(buffer.condition.frames.device)).to(device)
        t, noise = self._draw(buffer, rows, version)
        t, noise = t.to(device), noise.to(device)
        share = t.float().view(-1, 1, 1, 1, 1)
        x_t = with_conditioning((1 - share) * x_0 + share * noise, condition.frames.float())
        v = self._velocity(self.model, x_t, t, condition)
        with torch.no_grad():
            old = self._velocity(self.at(self.old), x_t, t, condition)
        clean, noisy = (x[:, :, K:].flatten(1) for x in (x_0, x_t))
        nft, clip, share = self.settings.nft, self.settings.advantage.clip, share.flatten(1)
        change = nft.beta * (v - old)  # exactly 0 while the weights have not moved
        errors = (noisy - share * (old + sign * change) - clean for sign in (1, -1))
        good, bad = (adaptive_error(error) for error in errors)
        share_good = (signals_M / (2 * clip) + 0.5).clamp(0, 1)
        loss = clip * (share_good * good + (1 - share_good) * bad) / nft.beta
        return LossTerms(-loss, torch.zeros_like(signals_M), None)

    # internals

    def _velocity(self, model: Any, x: Tensor, t: Tensor, condition: Condition) -> Tensor:
        v = guided_velocity(model, x, t, condition, self.rollout.cfg).float()
        return v[:, :, condition.num_conditioning :].flatten(1)

    def _draw(self, buffer: RolloutBuffer, rows: Rows, version: int) -> tuple[Tensor, Tensor]:
        """Return times, float64 (M,), and noise (M, C, F, H, W) of the rows, each from its own stream."""
        uniform = torch.empty(len(rows), dtype=torch.float64)
        noise = torch.empty(len(rows), *buffer.rollout.latents.shape[1:])
        groups, samples = buffer.group_ids[rows.videos].tolist(), buffer.sample_ids[rows.videos].tolist()
        for i, place in enumerate(zip(groups, samples, rows.positions.tolist(), strict=True)):
            generator = torch_stream(self.seed, "nft", version, *place)
            uniform[i] = torch.rand((), generator=generator, dtype=torch.float64)
            torch.randn(noise.shape[1:], generator=generator, out=noise[i])
        r, shift = (rows.positions + uniform) / self.settings.nft.times, self.rollout.shift
        return shift * r / (1 + (shift - 1) * r), noise


def adaptive_error(error_MU: Tensor) -> Tensor:
    """Return each row's mean squared error over its mean absolute error, (M,); no gradient through the divisor."""
    return error_MU.square().mean(1) / error_MU.detach().abs().mean(1).clamp_min(LEAST_ERROR)
