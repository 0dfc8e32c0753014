"""Cosmos-Predict2.5 (base models) behind VelocityModel.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid, E text values.

It is trained on x = (1 - t) x_0 + t eps, is told t itself (no factor 1000) and returns eps - x_0: our v. Its sampler
starts at t = 0.995, ours at 1.
Given frames are clean latents in place, marked in a mask channel and given a time near 0 (CLEAN_TIME).
"""

from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.video_model.adapters.velocity import PublicVelocity
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import with_conditioning

CLEAN_TIME = 1e-4
"""Of given frames: the pipeline's conditional_frame_timestep."""


class CosmosVelocity(PublicVelocity):
    """CosmosTransformer3DModel. Our rollout.cfg is 1 + the guidance scale of its card: v_c + scale (v_c - v_u)."""

    def __init__(self, transformer: nn.Module, null_text: Tensor | None = None) -> None:
        config: Any = transformer.config
        super().__init__(transformer, null_text)
        if config.img_context_dim_in:
            raise ValueError("this Cosmos model wants image context (Transfer2.5), which is not supported")
        self.patch: tuple[int, int, int] = tuple(config.patch_size)
        self.channels = int(config.out_channels)
        self.has_mask = int(config.in_channels) == self.channels + 1
        values = self.patch[0] * self.patch[1] * self.patch[2]
        self.has_padding = self.transformer.patch_embed.proj.in_features == (config.in_channels + 1) * values
        # The padding channel is zero for whole frames; given beside the mask it needs no torchvision.
        self.transformer.register_to_config(concat_padding_mask=False)
        if config.use_crossattn_projection:
            self.transformer.crossattn_proj = _ProjectOnce(*self.transformer.crossattn_proj)

    def forward(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor:
        """See VelocityModel; the result is float32. Text may be as encoded, or projected by project_text.

        Raises:
            ValueError: given frames, text or latents that this model does not take.
        """
        self._check_grid(x, self.patch, self.channels)
        K, dtype = condition.num_conditioning, self.transformer.patch_embed.proj.weight.dtype
        if K and not self.has_mask:
            raise ValueError(f"this Cosmos model has no mask channel and takes no given frames, got {K}")
        times = self._frame_times(t, x, K, CLEAN_TIME)
        text = self._text(condition, drop, dtype)
        out = self.transformer(
            hidden_states=with_conditioning(x, condition.frames).to(dtype),
            timestep=times.float()[:, None, :, None, None], encoder_hidden_states=text,
            condition_mask=self._extra_channels(x, K, dtype), fps=None, return_dict=False,
        )[0]
        velocity: Tensor = out.float()
        return velocity

    @torch.no_grad()
    def project_text(self, text: Tensor) -> Tensor:
        """Return what the frozen first layer makes of the text, (B, L, 1024) of (B, L, 100352) for Predict2.5.

        A hundredth of the memory in every Condition and rollout buffer; the null text is projected with it.
        """
        if not isinstance(getattr(self.transformer, "crossattn_proj", None), _ProjectOnce):
            return text
        projection = self.transformer.crossattn_proj
        if self.null_text is not None:
            self.null_text = projection(self.null_text.to(projection[0].weight)).detach()
        projected: Tensor = projection(text.to(projection[0].weight))
        return projected

    def _extra_channels(self, x: Tensor, num_conditioning: int, dtype: torch.dtype) -> Tensor | None:
        """Mask of the given frames, and padding (none), as far as the network has inputs for them."""
        if not self.has_mask and not self.has_padding:
            return None
        channels = x.new_zeros((x.shape[0], self.has_mask + self.has_padding, *x.shape[2:]), dtype=dtype)
        if self.has_mask:
            channels[:, 0, :num_conditioning] = 1
        return channels


class _ProjectOnce(nn.Sequential):
    """The text projection; what has its output's size already passes."""

    def forward(self, text: Tensor) -> Tensor:
        linear: Any = self[0]
        if text.shape[-1] == linear.out_features != linear.in_features:
            return text
        projected: Tensor = super().forward(text)  # type: ignore[no-untyped-call]
        return projected
