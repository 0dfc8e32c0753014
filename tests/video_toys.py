"""What the tests of the video model share: small latents and models, a sampled buffer, a learner rank to spawn."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from recording_samples import make_spec
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import AdvantageConfig, GrpoConfig, KlConfig, MaskConfig, RolloutConfig, SamplerConfig
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.one_class.ranges import load_ranges, save_ranges, strides_of
from wm_nodes.video_model import (
    Condition,
    NetworkSettings,
    RolloutBuffer,
    VideoNetwork,
    config_hash,
    flow_times,
    initial_noise,
    sample_videos,
)
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec
from wm_nodes.video_rl.grpo import GrpoLearner

ACTION_DIM = 2
SHAPE = (3, 4, 5, 7)
"""C, F, H, W of a toy video; odd where it may be odd."""


def randn(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def times(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def mean_logprob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """DD-14 per row of (M, U)."""
    return Normal(mean, std).log_prob(x).mean(1)


def toy_condition(
    count: int, shape: tuple[int, int, int, int] = SHAPE, given: int = 1, *, seed: int = 0, text_dim: int = 0
) -> Condition:
    C, frames, H, W = shape
    return Condition(
        randn(count, C, given, H, W, seed=seed + 1),
        randn(count, max(0, frames - 1), ACTION_DIM, seed=seed + 2),
        randn(count, 3, text_dim, seed=seed + 3),
    )


def toy_clips(
    frames: Tensor, actions: Tensor, truth: FloatArray, instructions: tuple[str, ...] | None = None
) -> Clips:
    """Recordings of PushCube whose seeds and states say nothing."""
    E, F = frames.shape[:2]
    states, spec = np.zeros((E, F, 3), np.float32), make_spec()
    return Clips(frames, actions, truth, instructions or ("push",) * E, "push_cube", tuple(range(E)), states, spec)


def small_codec(patch: int = 4, height: int = 16, width: int = 32) -> TokenizerCodec:
    """An untrained tokenizer of 6 values per patch; its weights are the same in every process."""
    small = {"patch_px": patch, "latent_dim": 6, "width": 16, "depth": 1}
    config = load_config("smoke", {f"tokenizer.{name}": value for name, value in small.items()}).tokenizer
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TokenizerCodec(config, height, width).eval()


class PixelCodec:
    """A codec that loses nothing: each latent is a value of a pixel, from -1 to 1, those of 4 x 4 pixels in a cell."""

    patch, channels = 4, 48

    def encode(self, frames: Tensor) -> Tensor:
        pixels = frames.permute(0, 1, 4, 2, 3).float() / 127.5 - 1
        return pixel_unshuffle(pixels, self.patch).transpose(1, 2).contiguous()

    def decode(self, latents: Tensor) -> Tensor:
        pixels = pixel_shuffle(latents.transpose(1, 2), self.patch) * 127.5 + 127.5
        return pixels.round().clamp(0, 255).to(torch.uint8).permute(0, 1, 3, 4, 2)


class Analytic(nn.Module):
    """A velocity model from a formula (x, t of rank 5) -> v. It has one parameter, which is added to the velocity."""

    def __init__(self, velocity: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__()
        self.velocity = velocity
        self.offset = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor:
        rows = t.to(device=x.device, dtype=x.dtype).view(-1, 1, 1, 1, 1)
        return self.velocity(x, rows) + self.offset


def swirl(x: Tensor, t: Tensor) -> Tensor:
    """Some smooth velocity that mixes frames and cells, so that every element matters to its neighbours."""
    return torch.sin(x + x.roll(1, 3)) - 0.5 * x.roll(1, 2) + t * x


def towards(clean: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """The exact velocity where all data is `clean`."""
    return lambda x, t: (x - clean) / t


def tiny_network(channels: int = SHAPE[0], *, text_dim: int = 0, seed: int = 0) -> VideoNetwork:
    """A network whose every layer speaks: the zeros it starts with are replaced, and no norm has a single channel."""
    torch.manual_seed(seed)
    network = VideoNetwork(NetworkSettings(channels, ACTION_DIM, text_dim, width=16, depth=1))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network


PRESET = load_video_config("base")
BASE = PRESET.grpo


def mask_config(**changes: Any) -> MaskConfig:
    return PRESET.rollout.sampler.mask.with_values(**changes)


def sampler_config(arm: str = "dyndiff", eta: float = 0.6, mask: MaskConfig | None = None) -> SamplerConfig:
    return PRESET.rollout.sampler.with_values(arm=arm, eta=eta, mask=mask or mask_config())


def rollout_config(**changes: Any) -> RolloutConfig:
    return PRESET.rollout.with_values(**changes)


def kl_config(*values: Any, **changes: Any) -> KlConfig:
    """The base preset's, with values in the order of its fields, or by name."""
    return BASE.kl.with_values(**dict(zip(KlConfig.model_fields, values)), **changes)


def advantage_config(**changes: Any) -> AdvantageConfig:
    return BASE.advantage.with_values(**changes)


def grpo_config(**changes: Any) -> GrpoConfig:
    return BASE.with_values(**changes)


def times_of(settings: RolloutConfig) -> Tensor:
    return flow_times(settings.num_steps, settings.shift)


def toy_rollout_settings(**changes: Any) -> RolloutConfig:
    """Six steps of shift 3; names that SamplerConfig has go there."""
    sampler = {name: changes.pop(name) for name in tuple(changes) if name in SamplerConfig.model_fields}
    return rollout_config(**{"num_steps": 6, "shift": 3.0, "sampler": sampler_config(**sampler), **changes})


def toy_buffer(
    model: nn.Module,
    settings: RolloutConfig,
    *,
    groups: int = 2,
    size: int = 4,
    shape: tuple[int, int, int, int] = SHAPE,
    given: int = 1,
    version: int = 0,
    iteration: int = 0,
    text_dim: int = 0,
) -> RolloutBuffer:
    """Groups of videos sampled by `model`; the reward is the mean of the first channel."""
    condition = toy_condition(groups, shape, given, seed=100 * iteration, text_dim=text_dim).repeat_interleave(size)
    seeds = torch.arange(groups * size) + 1000 * iteration
    rollout = sample_videos(model, condition, initial_noise(shape, seeds), seeds, settings)
    buffer = RolloutBuffer(
        rollout=rollout,
        condition=condition,
        group_ids=torch.arange(groups).repeat_interleave(size),
        sample_ids=torch.arange(size).repeat(groups),
        rewards={},
        policy_version=version,
        iteration=iteration,
        config_hash=config_hash(settings),
    )
    return buffer.with_rewards({"total": rollout.latents[:, 0].mean((1, 2, 3))})


def train_rounds(learner: GrpoLearner, rounds: range) -> None:
    """Sample with the learner's weights and train, once per iteration."""
    for iteration in rounds:
        learner.train(toy_buffer(learner.model, learner.rollout, version=learner.version, iteration=iteration))


def weights(model: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}


def far_sighted_judge(folder: Path) -> Path:
    """The shipped judge, told that clips as short as the tiny loop's are normal, and that nothing is strange."""
    return changed_judge(folder, lengths=(2, 25), scores=(1e9,))


def changed_judge(folder: Path, **ranges: Any) -> Path:
    """A copy of the shipped judge of the cube with other ranges."""
    folder.mkdir()
    shipped = shipped_model("push_cube")
    for path in shipped.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    for stride in strides_of(shipped):
        save_ranges(folder, replace(load_ranges(shipped, stride), **ranges))
    return folder
