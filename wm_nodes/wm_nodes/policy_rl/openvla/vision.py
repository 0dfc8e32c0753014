"""The vision transformers of a Prismatic model, with the parameter names of its checkpoints (timm's, where LayerScale
calls its factor scale_factor). Shapes: B batch, H W 3 image, P patches, D width.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, scaled_dot_product_attention

EPSILON = 1e-6
"""Of the layer norms."""


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class _Attention(nn.Module):
    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x_BPD: Tensor) -> Tensor:
        split = self.qkv(x_BPD).unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = scaled_dot_product_attention(split[0], split[1], split[2])
        out: Tensor = self.proj(mixed.transpose(1, 2).flatten(2))
        return out


class _Mlp(nn.Module):
    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.fc2(gelu(self.fc1(x)))
        return out


class _Block(nn.Module):
    def __init__(self, width: int, hidden: int, num_heads: int, scaled: bool) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width, EPSILON), nn.LayerNorm(width, EPSILON)
        self.attn, self.mlp = _Attention(width, num_heads), _Mlp(width, hidden)
        self.ls1, self.ls2 = (_Scale(width) if scaled else nn.Identity() for _ in range(2))

    def forward(self, x_BPD: Tensor) -> Tensor:
        x_BPD = x_BPD + self.ls1(self.attn(self.norm1(x_BPD)))
        out: Tensor = x_BPD + self.ls2(self.mlp(self.norm2(x_BPD)))
        return out


class VisionTransformer(nn.Module):
    """Patches' features before the last block. The last block, the final norm and the pooling of a checkpoint are not
    used by a Prismatic model, and not kept.

    Args:
        tensors: of the checkpoint, by timm's names; sizes are read off their shapes, and they are loaded.
        num_heads: which shapes do not tell.

    Raises:
        KeyError: names a tensor that is missing.
    """

    cls_token: Tensor | None
    reg_token: Tensor | None

    def __init__(self, tensors: Mapping[str, Tensor], num_heads: int) -> None:
        super().__init__()
        width, _, side, _ = tensors["patch_embed.proj.weight"].shape
        hidden, scaled = len(tensors["blocks.0.mlp.fc1.bias"]), "blocks.0.ls1.scale_factor" in tensors
        depth = 1 + max(int(name.split(".")[1]) for name in tensors if name.startswith("blocks."))
        self.width, self.num_patches = width, tensors["pos_embed"].shape[1]
        self.side_px = side * round(self.num_patches**0.5)
        self.patch_embed = nn.Sequential()
        self.patch_embed.add_module("proj", nn.Conv2d(3, width, side, stride=side))
        self.pos_embed = nn.Parameter(torch.zeros(1, self.num_patches, width))
        for name in ("cls_token", "reg_token"):
            count = tensors[name].shape[1] if name in tensors else 0
            self.register_parameter(name, nn.Parameter(torch.zeros(1, count, width)) if count else None)
        self.blocks = nn.ModuleList(_Block(width, hidden, num_heads, scaled) for _ in range(depth - 1))
        self.load_state_dict({name: tensors[name] for name in self.state_dict()})

    def forward(self, images_BCHW: Tensor) -> Tensor:
        """Features (B, P, D) of normalised images (B, 3, side_px, side_px)."""
        x = self.patch_embed(images_BCHW).flatten(2).transpose(1, 2) + self.pos_embed
        first = [token.expand(len(x), -1, -1) for token in (self.cls_token, self.reg_token) if token is not None]
        x = torch.cat([*first, x], 1)
        for block in self.blocks:
            x = block(x)
        features: Tensor = x[:, -self.num_patches :]
        return features
