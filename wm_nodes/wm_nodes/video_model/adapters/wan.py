"""Wan 2.1 and 2.2 behind VelocityModel.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid.

Wan's path is x = (1 - sigma) x_0 + sigma eps and its network returns eps - x_0, so sigma is our t and its output our v;
it is told 1000 t (the scheduler's num_train_timesteps).
Schedulers that round the time they tell to an integer (UniPC in diffusers) differ from this by that rounding.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model.adapters.velocity import CfgConvention, PublicVelocity, num_cells
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import with_conditioning

CACHED_CONTINUATIONS = 32

GivenFrames = Literal["none", "fused", "channels"]
Continuation = Callable[[Tensor, int], Tensor]
"""(clean latents of the first K frames, F) -> latents of them and of grey frames after them, (B, C, F, H, W)."""


class WanVelocity(PublicVelocity):
    """WanTransformer3DModel, or any module with its call.

    Args:
        frames: how first frames are given. `none`: they are not (text to video). `fused` (Wan 2.2 TI2V-5B; also takes
            none): clean latents in place, whose tokens are told time 0. `channels` (I2V-A14B): clean latents and a mask
            in extra input channels; the network still expects noise in place, so it gets the given frames at time t
            with one fixed noise (in the pipeline they follow the sampler's own).
        continuation: needed by `channels`; VideoCodec.continuation.
        low_noise, boundary: the second expert of Wan 2.2 A14B and the t below which it takes over.
        time_scale: what t = 1 is told as.
    """

    cfg_convention: ClassVar[CfgConvention] = "unconditional"

    def __init__(
        self, transformer: nn.Module, null_text: Tensor | None = None, *, frames: GivenFrames = "none",
        continuation: Continuation | None = None, low_noise: nn.Module | None = None, boundary: float = 0.0,
        time_scale: float = 1000.0,
    ) -> None:
        config: Any = transformer.config
        super().__init__(transformer, null_text)
        self.low_noise: Any = low_noise
        self.frames, self.boundary, self.time_scale = frames, boundary, time_scale
        self.patch: tuple[int, int, int] = tuple(config.patch_size)
        self.channels = int(config.out_channels)
        self.mask_channels = int(config.in_channels) - 2 * self.channels
        self._continue = _ContinuationCache(continuation)
        self._check(config, continuation)

    def transformers(self) -> list[Any]:
        return [self.transformer] if self.low_noise is None else [self.transformer, self.low_noise]

    def forward(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor:
        """See VelocityModel; the result is float32.

        Raises:
            ValueError: given frames, text or latents that this model does not take.
        """
        self._check_grid(x, self.patch, self.channels)
        K = condition.num_conditioning
        if self.frames == "none" and K:
            raise ValueError(f"this Wan model makes video from text alone and takes no given frames, got {K}")
        if self.low_noise is None:
            return self._velocity(self.transformer, x, t, condition, drop)
        high = (t >= self.boundary).to(x.device)
        out = torch.empty_like(x, dtype=torch.float32)
        for expert, rows in ((self.transformer, high), (self.low_noise, ~high)):
            if bool(rows.any()):
                part = condition.rows(rows.to(condition.frames.device))
                dropped = None if drop is None else drop[rows.to(drop.device)]
                velocity = self._velocity(expert, x[rows], t[rows.to(t.device)], part, dropped)
                out = out.index_put((rows,), velocity)
        return out

    def _velocity(self, network: Any, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None) -> Tensor:
        K, dtype = condition.num_conditioning, network.patch_embedding.weight.dtype
        times = self._frame_times(t, x, K if self.frames == "fused" else 0, clean=0.0)
        token_times = times.repeat_interleave(num_cells(x, self.patch), 1) if self.frames == "fused" else times[:, 0]
        text = self._text(condition, drop, dtype)
        out = network(
            hidden_states=self._inputs(x, t, condition).to(dtype), timestep=(token_times * self.time_scale).float(),
            encoder_hidden_states=text, return_dict=False,
        )[0]
        velocity: Tensor = out.float()
        return velocity

    def _inputs(self, x: Tensor, t: Tensor, condition: Condition) -> Tensor:
        if self.frames != "channels":
            return with_conditioning(x, condition.frames)
        B, _, F, H, W = x.shape
        K, clean = condition.num_conditioning, condition.frames.to(x)
        time = t.to(x).view(-1, 1, 1, 1, 1)
        noise = torch.randn((1, self.channels, K, H, W), generator=torch_stream(0, "given_frames")).to(x)
        given = self._continue(clean, F)
        mask = x.new_zeros(B, self.mask_channels, F, H, W)
        mask[:, :, :K] = 1
        return torch.cat([with_conditioning(x, (1 - time) * clean + time * noise), mask, given], 1)

    def _check(self, config: Any, continuation: Continuation | None) -> None:
        if getattr(config, "image_dim", None) is not None:
            raise ValueError(
                "this Wan model also wants CLIP embeddings of the first frame (Wan 2.1 I2V), which are not supported; "
                "take Wan 2.2 (TI2V-5B or I2V-A14B)"
            )
        if (self.frames == "channels") != (self.mask_channels > 0):
            raise ValueError(
                f"frames is {self.frames!r}, but the transformer has {config.in_channels} input and {self.channels} "
                f"output channels; `channels` belongs to a transformer with mask channels, and only to it"
            )
        if self.frames == "channels" and continuation is None:
            raise ValueError("frames channels needs the codec: pass continuation=VideoCodec.continuation")


class _ContinuationCache:
    """Caches the last CACHED_CONTINUATIONS continuations; copies of the model share it, VAE included."""

    def __init__(self, continuation: Continuation | None) -> None:
        self._continuation = continuation
        self._cache: dict[tuple[bytes, int], Tensor] = {}

    def __deepcopy__(self, _memo: dict[int, Any]) -> "_ContinuationCache":
        return self

    def __call__(self, frames: Tensor, num_frames: int) -> Tensor:
        return torch.cat([self._row(row.unsqueeze(0), num_frames) for row in frames])

    def _row(self, frame: Tensor, num_frames: int) -> Tensor:
        key = (frame.detach().cpu().float().contiguous().numpy().tobytes(), num_frames)
        if key not in self._cache:
            if len(self._cache) >= CACHED_CONTINUATIONS:
                self._cache.pop(next(iter(self._cache)))
            assert self._continuation is not None
            with torch.no_grad():
                self._cache[key] = self._continuation(frame, num_frames)
        return self._cache[key].to(frame)
