"""Codec of pictures by principal components of square patches.

Shapes: B clips, F frames, H W 3 image, p patch side, C components, h = H / p, w = W / p.

Linear, orthogonal and local: no training beyond one eigen-decomposition, any resolution that p divides, and an error
that can be named (what the left-out components carried). Components are whitened half way: over the data of the fit
their standard deviations are the square roots of the pixels' (mean 1), so that fine texture, which is mostly noise,
does not weigh as much in a flow-matching loss as the shapes that the coarse components carry.
"""

from typing import Any

import torch
from torch import Tensor, nn

MIN_SHARE = 1e-3
"""A component's standard deviation is taken as at least this share of the largest one."""
ENCODE_BATCH = 256


class PatchCodec(nn.Module):
    """uint8 frames (B, F, H, W, 3) <-> latents float32 (B, C, F, h, w)."""

    def __init__(self, patch: int, channels: int) -> None:
        super().__init__()
        values = 3 * patch * patch
        if not 0 < channels <= values:
            raise ValueError(
                f"a {patch} x {patch} patch has {values} values; channels must be 1 to {values}, got {channels}"
            )
        self.patch, self.channels = patch, channels
        self.mean: Tensor
        self.basis: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("basis", torch.eye(values)[:channels])
        self.register_buffer("scale", torch.ones(channels))

    def settings(self) -> dict[str, Any]:
        """Return the kind and the arguments of __init__, as JSON."""
        return {"kind": "patch", "patch": self.patch, "channels": self.channels}

    @torch.no_grad()
    def fit(self, frames: Tensor) -> float:
        """Fit to uint8 frames (N, H, W, 3); return the share of variance that the components keep."""
        patches = torch.cat([self._patches(part).flatten(0, 2) for part in torch.split(frames, ENCODE_BATCH)]).double()  # type: ignore[no-untyped-call]
        mean = patches.mean(0)
        covariance = (patches - mean).T @ (patches - mean) / len(patches)
        variances, vectors = torch.linalg.eigh(covariance)
        order = variances.argsort(descending=True)[: self.channels]
        deviations = variances[order].clamp_min(0).sqrt()
        self.mean.copy_(mean)
        self.basis.copy_(vectors[:, order].T)
        deviations = deviations.clamp_min(MIN_SHARE * float(deviations[0]))
        self.scale.copy_((deviations * deviations.mean()).sqrt())
        return float(variances[order].sum() / variances.sum())

    @torch.no_grad()
    def encode(self, frames: Tensor) -> Tensor:
        """Return latents (B, C, F, h, w) of uint8 frames (B, F, H, W, 3).

        Raises:
            ValueError: not uint8, or a size that the patch does not divide.
        """
        B, F = frames.shape[:2]
        parts = torch.split(frames.reshape(-1, *frames.shape[2:]), ENCODE_BATCH)  # type: ignore[no-untyped-call]
        latents = torch.cat([(self._patches(part) - self.mean) @ self.basis.T / self.scale for part in parts])
        return latents.view(B, F, *latents.shape[1:]).permute(0, 4, 1, 2, 3).contiguous()

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Return uint8 frames (B, F, H, W, 3) of latents (B, C, F, h, w); what lies outside [0, 255] is clipped.

        Raises:
            ValueError: another number of channels.
        """
        if latents.shape[1] != self.channels:
            raise ValueError(f"this codec has {self.channels} channels, got latents of {latents.shape[1]}")
        B, _, F, h, w = latents.shape
        patches = (latents.to(self.basis.device).float().permute(0, 2, 3, 4, 1) * self.scale) @ self.basis + self.mean
        p = self.patch
        pixels = patches.view(B, F, h, w, p, p, 3).permute(0, 1, 2, 4, 3, 5, 6).reshape(B, F, h * p, w * p, 3)
        return (pixels * 255).round().clamp(0, 255).to(torch.uint8)

    def _patches(self, frames: Tensor) -> Tensor:
        """float32 (N, h, w, 3 p p) in [0, 1]."""
        N, H, W, _ = frames.shape
        p = self.patch
        if frames.dtype != torch.uint8 or H % p or W % p:
            raise ValueError(f"frames must be uint8 with sides that {p} divides, got {frames.dtype} of {H} x {W}")
        frames = frames.to(self.basis.device)
        cut = frames.view(N, H // p, p, W // p, p, 3).permute(0, 1, 3, 2, 4, 5)
        return cut.reshape(N, H // p, W // p, -1).float() / 255
