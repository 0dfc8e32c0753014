"""Camera frames to latents and back, through the VAE of a public model.

Shapes: B batch, N camera frames, H W camera pixels, C latent channels, h w latent grid, F = 1 + (N - 1) / 4 latent
frames.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class VideoCodec:
    """AutoencoderKLWan, with latents normalised to mean 0 and deviation 1 per channel, as the models take them.

    device: where it computes.
    """

    def __init__(self, vae: Any, *, device: str | torch.device = "cpu") -> None:
        self.vae, self.device = vae.requires_grad_(False).eval().to(device), torch.device(device)
        self._mean, self._std = (
            torch.tensor(values, device=self.device, dtype=torch.float32).view(1, -1, 1, 1, 1)
            for values in (vae.config.latents_mean, vae.config.latents_std)
        )

    @torch.no_grad()
    def encode(self, frames: Tensor) -> Tensor:
        """Return the latents (mode of the posterior) of uint8 (B, N, H, W, 3), float32 (B, C, F, h, w).

        Raises:
            ValueError: another dtype or layout, or a size that the VAE does not divide.
        """
        self._check(frames)

        def part(some: Tensor) -> Tensor:
            pixels = some.to(self.device).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
            latents: Tensor = self.vae.encode(pixels.to(self.vae.dtype)).latent_dist.mode().float()
            return (latents - self._mean) / self._std

        return _one_by_one(part, frames)

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Return uint8 camera frames (B, N, H, W, 3)."""

        def part(some: Tensor) -> Tensor:
            raw = some.to(self.device, torch.float32) * self._std + self._mean
            pixels: Tensor = self.vae.decode(raw.to(self.vae.dtype), return_dict=False)[0].float()
            return ((pixels + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 4, 1).contiguous()

        return _one_by_one(part, latents)

    def _check(self, frames: Tensor) -> None:
        if frames.dtype != torch.uint8 or frames.ndim != 5 or frames.shape[-1] != 3:
            raise ValueError(
                f"frames must be uint8 (batch, frames, height, width, 3), got {frames.dtype} {tuple(frames.shape)}"
            )
        _, N, H, W, _ = frames.shape
        each, side = self.vae.config.scale_factor_temporal, self.vae.config.scale_factor_spatial
        if (N - 1) % each or H % side or W % side:
            raise ValueError(
                f"this VAE takes 1 + {each} n frames of sides that are multiples of {side}, got {N} frames of {H}x{W}"
            )


def _one_by_one(function: Callable[[Tensor], Tensor], clips: Tensor) -> Tensor:
    """The results of one clip at a time, since the VAE's memory grows with them."""
    return torch.cat([function(clip) for clip in torch.split(clips, 1)])  # type: ignore[no-untyped-call]
