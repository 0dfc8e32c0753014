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

CLEAN_TIME = 1e-4
"""Of given frames: the pipeline's conditional_frame_timestep."""


class CosmosVelocity(PublicVelocity):
    """CosmosTransformer3DModel. Our rollout.cfg is 1 + the guidance scale of its card: v_c + scale (v_c - v_u)."""

    def __init__(self, transformer: nn.Module, null_text: Tensor | None = None) -> None:
        config: Any = transformer.config
        self.has_mask = int(config.in_channels) == int(config.out_channels) + 1
        super().__init__(transformer, null_text, "" if self.has_mask else "has no mask channel", CLEAN_TIME)
        if config.img_context_dim_in:
            raise ValueError("this Cosmos model wants image context (Transfer2.5), which is not supported")
        values = self.patch[0] * self.patch[1] * self.patch[2]
        self.has_padding = self.transformer.patch_embed.proj.in_features == (config.in_channels + 1) * values
        # The padding channel is zero for whole frames; given beside the mask it needs no torchvision.
        self.transformer.register_to_config(concat_padding_mask=False)
        if config.use_crossattn_projection:
            self.transformer.crossattn_proj = _ProjectOnce(*self.transformer.crossattn_proj)

    @property
    def dtype(self) -> torch.dtype:
        return self.transformer.patch_embed.proj.weight.dtype  # type: ignore[no-any-return]

    def call(self, x: Tensor, times_BF: Tensor, text: Tensor, num_conditioning: int) -> Any:
        """text may be as encoded, or projected by project_text."""
        channels = None
        if self.has_mask or self.has_padding:  # mask of the given frames, and padding: none
            channels = x.new_zeros((x.shape[0], self.has_mask + self.has_padding, *x.shape[2:]))
            channels[:, : self.has_mask, :num_conditioning] = 1
        return self.transformer(
            hidden_states=x, timestep=times_BF.float()[:, None, :, None, None], encoder_hidden_states=text,
            condition_mask=channels, fps=None, return_dict=False,
        )

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


class _ProjectOnce(nn.Sequential):
    """The text projection; what has its output's size already passes."""

    def forward(self, text: Tensor) -> Tensor:
        linear: Any = self[0]
        if text.shape[-1] == linear.out_features != linear.in_features:
            return text
        projected: Tensor = super().forward(text)  # type: ignore[no-untyped-call]
        return projected
