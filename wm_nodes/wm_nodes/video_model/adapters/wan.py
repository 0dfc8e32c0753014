"""Wan 2.1 text to video and Wan 2.2 TI2V-5B behind VelocityModel.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid.

Wan's path is x = (1 - sigma) x_0 + sigma eps and its network returns eps - x_0, so sigma is our t and its output our v;
it is told TIME_SCALE t.
Schedulers that round the time they tell to an integer (UniPC in diffusers) differ from this by that rounding.
"""

from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.video_model.adapters.velocity import PublicVelocity

TIME_SCALE = 1000
"""num_train_timesteps of the published schedulers."""


class WanVelocity(PublicVelocity):
    """WanTransformer3DModel, or any module with its call. The guidance scale of its card is our rollout.cfg.

    Args:
        fused: first frames are given as clean latents in place, whose tokens are told time 0 (Wan 2.2 TI2V-5B; it also
            takes none). Else they are not given: text to video.

    Raises:
        ValueError: a transformer with further inputs for the given frames (Wan's I2V models).
    """

    def __init__(self, transformer: nn.Module, null_text: Tensor | None = None, *, fused: bool = False) -> None:
        super().__init__(transformer, null_text, "" if fused else "makes video from text alone", clean_time=0.0)
        self.fused = fused
        config = self.transformer.config
        if getattr(config, "image_dim", None) is not None or config.in_channels != config.out_channels:
            raise ValueError(
                "this Wan model also wants CLIP embeddings or further channels of the first frame (I2V), which are not "
                "supported; take Wan 2.2 TI2V-5B"
            )

    @property
    def dtype(self) -> torch.dtype:
        return self.transformer.patch_embedding.weight.dtype  # type: ignore[no-any-return]

    def call(self, x: Tensor, times_BF: Tensor, text: Tensor, num_conditioning: int) -> Any:
        tokens = (x.shape[3] // self.patch[1]) * (x.shape[4] // self.patch[2])  # of a latent frame
        times = times_BF.repeat_interleave(tokens, 1) if self.fused else times_BF[:, 0]
        return self.transformer(
            hidden_states=x, timestep=(times * TIME_SCALE).float(), encoder_hidden_states=text, return_dict=False
        )
