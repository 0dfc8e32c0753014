"""The frame codec: an image becomes a grid of latent tokens and back (RS-1a).

Shapes: B batch, H W 3 image, S tokens per frame = (H / patch) (W / patch), row by row, D values per token, P probed
ground-truth values.
"""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wm_nodes.config.schema import PolicyInputs, TokenizerConfig
from wm_nodes.core.types import UInt8Array
from wm_nodes.world_model.parts import in_parts
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.quantizer import quantize

NUM_POSITIONS = 7
"""Of an object, a tool and a goal on a table, see world_model/positions.py."""


def normalise_tokens(latents: Tensor) -> Tensor:
    """Zero mean and unit variance over the last axis, float32: the set that a continuous encoder reaches."""
    return F.layer_norm(latents.float(), latents.shape[-1:])


class ResidualConv(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Conv2d(channels, channels, 3, padding=1)
        self.outer = nn.Conv2d(channels, channels, 1)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        change: Tensor = self.outer(F.silu(self.inner(x)))
        return x + change


def make_probe(features: int, config: TokenizerConfig, values: int) -> nn.Sequential:
    """What reads `values` numbers off the flattened latents of a frame."""
    layers: list[nn.Module] = [nn.Linear(features, 256), nn.SiLU()]
    for _ in range(config.probe_depth - 1):
        layers += [nn.Linear(256, 256), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(256, values))


class Tokenizer(nn.Module):
    """Convolutional encoder and decoder around `latent_dim` values per token, and a probe that reads num_positions
    values off them; none where they are 0.

    kind "continuous": each token is normalised to zero mean and unit variance, which bounds it and gives every token
    the same signal-to-noise ratio; training adds noise, so that nearby latents decode to nearby images.
    kind "lfq": each token is a vector of signs (see quantizer).

    Raises:
        ValueError: the image is not a multiple of patch_px, or patch_px is not a multiple of 4 and a power of two.
    """

    def __init__(
        self, config: TokenizerConfig, height: int, width: int, num_positions: int = NUM_POSITIONS
    ) -> None:
        super().__init__()
        patch = config.patch_px
        if height % patch or width % patch:
            fitting = [str(side) for side in (16, 8, 4) if height % side == 0 and width % side == 0]
            remedy = f"set it to {' or '.join(fitting)}" if fitting else "record pictures of other sizes"
            raise ValueError(f"image {height}x{width} px is not a multiple of tokenizer.patch_px {patch}; {remedy}")
        if patch < 4 or patch & (patch - 1):
            raise ValueError(f"tokenizer.patch_px must be a power of two >= 4, got {patch}")
        self.kind, self.latent_dim, self.height, self.width, self.patch_px = (
            config.kind, config.latent_dim, height, width, patch,
        )
        self.grid = (height // patch, width // patch)
        levels = (patch // 4).bit_length()
        channels = [max(16, int(config.width * factor)) for factor in (0.375, 0.75, 1.0, 1.0, 1.0)][:levels]
        channels[-1] = config.width
        down: list[nn.Module] = [nn.PixelUnshuffle(4), nn.Conv2d(48, channels[0], 3, padding=1), nn.SiLU()]
        for previous, current in pairwise(channels):
            down += [nn.PixelUnshuffle(2), nn.Conv2d(4 * previous, current, 1), nn.SiLU(), ResidualConv(current)]
        down += [ResidualConv(channels[-1]) for _ in range(config.depth)]
        self.encoder = nn.Sequential(*down, nn.Conv2d(channels[-1], config.latent_dim, 1))
        up: list[nn.Module] = [nn.Conv2d(config.latent_dim, channels[-1], 3, padding=1), nn.SiLU()]
        up += [ResidualConv(channels[-1]) for _ in range(config.depth)]
        for previous, current in pairwise(channels[::-1]):
            up += [nn.Conv2d(previous, 4 * current, 1), nn.PixelShuffle(2), nn.SiLU(), ResidualConv(current)]
        self.decoder = nn.Sequential(*up, nn.Conv2d(channels[0], 48, 3, padding=1), nn.PixelShuffle(4))
        self.num_positions = num_positions
        self.probe = make_probe(self.num_tokens * config.latent_dim, config, num_positions) if num_positions else None
        self.background: Tensor
        self.probe_mean: Tensor
        self.probe_std: Tensor
        self.register_buffer("background", torch.full((3, height, width), 0.5))
        self.register_buffer("probe_mean", torch.zeros(num_positions))
        self.register_buffer("probe_std", torch.ones(num_positions))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def num_tokens(self) -> int:
        return self.grid[0] * self.grid[1]

    @property
    def device(self) -> torch.device:
        return self.background.device

    def normalise(self, latents: Tensor) -> Tensor:
        """Bring latents (..., D) back onto the set that the encoder reaches; the identity on its own output (lfq)."""
        return normalise_tokens(latents) if self.kind == "continuous" else latents

    def features(self, pixels_B3HW: Tensor) -> Tensor:
        """Encoder output (B, S, D) before normalisation or quantisation; pixels float in [0, 1]."""
        centred = (pixels_B3HW - self.background) * 2
        grid: Tensor = self.encoder(centred.contiguous(memory_format=torch.channels_last))
        return grid.flatten(2).transpose(1, 2).float()

    def bottleneck(self, features_BSD: Tensor) -> Tensor:
        """Latents (B, S, D): normalised values, or signs with the straight-through gradient."""
        return self.normalise(features_BSD) if self.kind == "continuous" else quantize(features_BSD)

    def decode_pixels(self, latents_BSD: Tensor) -> Tensor:
        """Image (B, 3, H, W) float32, nominally in [0, 1], not clipped."""
        grid = latents_BSD.transpose(1, 2).reshape(len(latents_BSD), self.latent_dim, *self.grid)
        change: Tensor = self.decoder(grid.contiguous(memory_format=torch.channels_last))
        return change.float() / 2 + self.background

    def read_state(self, latents_BSD: Tensor) -> Tensor:
        """Probed ground truth (B, P) in its units."""
        return self.read_state_normalised(latents_BSD) * self.probe_std + self.probe_mean

    def read_state_normalised(self, latents_BSD: Tensor) -> Tensor:
        flat = latents_BSD.flatten(1)
        values: Tensor = flat[:, :0] if self.probe is None else self.probe(flat)
        return values.float()

    def flatten(self, latents_BSD: Tensor, inputs: PolicyInputs) -> Tensor:
        """A policy's features of latents: they themselves (B, S D), the normalised positions (B, P), one after the
        other, or nothing (B, 0)."""
        if inputs == "state":
            return latents_BSD.flatten(1)[:, :0]
        if inputs == "latents":
            return latents_BSD.flatten(1)
        positions = self.read_state_normalised(latents_BSD)
        return positions if inputs == "positions" else torch.cat([latents_BSD.flatten(1), positions], 1)

    def to_pixels(self, images: UInt8Array | Tensor) -> Tensor:
        """Float (B, 3, H, W) in [0, 1] of uint8 images (B, H, W, 3).

        Raises:
            ValueError: another dtype or shape.
        """
        tensor = images if isinstance(images, Tensor) else torch.from_numpy(np.require(images, requirements=["C", "W"]))
        expected = (self.height, self.width, 3)
        if tensor.dtype != torch.uint8 or tensor.ndim != 4 or tuple(tensor.shape[1:]) != expected:
            raise ValueError(
                f"images must be uint8 (B, {self.height}, {self.width}, 3), got {tensor.dtype} {tuple(tensor.shape)}; "
                "the model folder was trained for another camera set-up, see its manifest.json"
            )
        return tensor.to(self.device).permute(0, 3, 1, 2).float() / 255

    def encode(self, images: UInt8Array | Tensor) -> Tensor:
        """Latents (B, S, D) float32 of uint8 images (B, H, W, 3)."""

        def part(rows: slice) -> Tensor:
            with compute_context(self.device):
                return self.bottleneck(self.features(self.to_pixels(images[rows])))

        return in_parts(part, len(images), self.device)

    def decode_part(self, latents_BSD: Tensor) -> Tensor:
        """decode, all at once and in the present autocast."""
        pixels = self.decode_pixels(latents_BSD)
        return pixels.clamp_(0, 1).mul_(255).round_().to(torch.uint8).permute(0, 2, 3, 1).contiguous()

    def decode(self, latents_BSD: Tensor) -> Tensor:
        """Images uint8 (B, H, W, 3) of latents (B, S, D)."""

        def part(rows: slice) -> Tensor:
            with compute_context(self.device):
                return self.decode_part(latents_BSD[rows])

        return in_parts(part, len(latents_BSD), self.device)
