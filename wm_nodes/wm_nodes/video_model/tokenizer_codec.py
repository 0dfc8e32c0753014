"""A world model's frozen tokenizer as the codec of a video model: few cells, and pictures that its decoder keeps clean.

Shapes: B clips, F frames, H W 3 image, C values per token, h w token grid.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from wm_nodes.config.schema import TokenizerConfig
from wm_nodes.world_model import Tokenizer, load_model_folder

BATCH = 256


class TokenizerCodec(nn.Module):
    """uint8 frames (B, F, H, W, 3) <-> latents float32 (B, C, F, h, w), of about unit variance.

    Pictures of another size than the tokenizer was trained on, of the same cameras, go through the same convolutions
    with the background stretched to them; what that costs is in docs/results/video_rl.md.

    Raises:
        ValueError: a tokenizer of discrete tokens, which flow matching cannot move through.
    """

    def __init__(self, config: TokenizerConfig, height: int, width: int) -> None:
        super().__init__()
        if config.kind != "continuous":
            raise ValueError(f"a video model needs a world model of tokenizer.kind continuous, not {config.kind}")
        self.config = config
        self.tokenizer = Tokenizer(config, height, width).requires_grad_(False)
        self.channels, self.patch = config.latent_dim, config.patch_px

    def settings(self) -> dict[str, Any]:
        """Return the kind and the arguments of __init__, as JSON."""
        size = {"height": self.tokenizer.height, "width": self.tokenizer.width}
        return {"kind": "tokenizer", "config": self.config.model_dump(), **size}

    def encode(self, frames: Tensor) -> Tensor:
        """Return latents (B, C, F, h, w) of uint8 frames (B, F, H, W, 3).

        Raises:
            ValueError: not uint8, or a size that the patch does not divide.
        """
        B, count, H, W = frames.shape[:4]
        tokenizer = self._resize(H, W)
        parts = torch.split(frames.flatten(0, 1), BATCH)  # type: ignore[no-untyped-call]
        tokens = torch.cat([tokenizer.encode(part) for part in parts])
        grid = tokens.view(B, count, *tokenizer.grid, self.channels)
        return grid.permute(0, 4, 1, 2, 3).clone(memory_format=torch.contiguous_format)  # out of inference mode

    def decode(self, latents: Tensor) -> Tensor:
        """Return uint8 frames (B, F, H, W, 3) of latents (B, C, F, h, w).

        Raises:
            ValueError: another number of channels.
        """
        B, channels, count, h, w = latents.shape
        if channels != self.channels:
            raise ValueError(f"this codec has {self.channels} channels, got latents of {channels}")
        tokenizer = self._resize(h * self.patch, w * self.patch)
        cells = latents.to(tokenizer.device).float().permute(0, 2, 3, 4, 1)
        tokens = tokenizer.normalise(cells.reshape(B * count, h * w, channels))
        parts = torch.split(tokens, BATCH)  # type: ignore[no-untyped-call]
        frames = torch.cat([tokenizer.decode(part) for part in parts])
        return frames.view(B, count, *frames.shape[1:]).clone()

    def _resize(self, height: int, width: int) -> Tokenizer:
        """Return the tokenizer for pictures of this size; where it is not its own, one that shares the convolutions."""
        own = self.tokenizer
        if (height, width) == (own.height, own.width):
            return own
        with torch.device("meta"):
            other = Tokenizer(self.config, height, width)
        other.encoder, other.decoder = own.encoder, own.decoder
        other.background = interpolate(own.background[None], (height, width), mode="bilinear", antialias=True)[0]
        return other


def codec_of_world_model(folder: Path) -> TokenizerCodec:
    """Return the tokenizer of a world-model folder as a codec, with the decoder that it was trained with, on the CPU.
    Raises ModelFolderError."""
    models = load_model_folder(folder, rollout_decoder=False)
    config = TokenizerConfig.model_validate(models.manifest["tokenizer"])
    codec = TokenizerCodec(config, models.tokenizer.height, models.tokenizer.width)
    codec.tokenizer.load_state_dict(models.tokenizer.state_dict())
    return codec.eval()
