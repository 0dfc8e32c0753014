"""What all public models share: given frames, text and its absence, and a low-rank adapter on the attention, through
peft, that can be switched off: then it is the base model, kl.anchor lora_off.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid, L text tokens of E values.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.core.imports import optional_package
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import with_conditioning

TARGETS = ("to_q", "to_k", "to_v", "to_out.0")
"""Attention projections of Wan's and Cosmos's blocks."""

package = partial(optional_package, needed_by="public video models need", requirements="video.txt")


class PublicVelocity(nn.Module, ABC):
    """A VelocityModel around the transformer of a public model; see VelocityModel for the call.

    Args:
        transformer: a diffusers module; it keeps its own parameter names.
        null_text: embedded negative prompt (L, E), what a dropped row sees. None: dropping a row is refused.
        no_frames: why the model takes no given frames; empty: it takes them.
        clean_time: of given frames.
    """

    def __init__(self, transformer: nn.Module, null_text: Tensor | None, no_frames: str, clean_time: float) -> None:
        super().__init__()
        config: Any = transformer.config
        self.transformer: Any = transformer
        self.null_text: Tensor | None
        self.register_buffer("null_text", null_text, persistent=False)
        self.patch: tuple[int, int, int] = tuple(config.patch_size)
        self.channels = int(config.out_channels)
        self.no_frames, self.clean_time = no_frames, clean_time

    def forward(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor:
        """See VelocityModel; the result is float32.

        Raises:
            ValueError: given frames, text or latents that this model does not take.
        """
        if x.shape[1] != self.channels or any(size % side for size, side in zip(x.shape[2:], self.patch)):
            raise ValueError(
                f"this model takes {self.channels} latent channels on a grid of multiples of {self.patch} (frames, "
                f"height, width), got {tuple(x.shape[1:])}"
            )
        K, dtype = condition.num_conditioning, self.dtype
        if K and self.no_frames:
            raise ValueError(
                f"this model {self.no_frames} and takes no given frames, got {K}; give it Condition.without_frames()"
            )
        times_BF = t.to(x.device, torch.float64).view(-1, 1).repeat(1, x.shape[2])
        times_BF[:, :K] = self.clean_time
        text = self._text(condition, drop).to(dtype)
        velocity: Tensor = self.call(with_conditioning(x, condition.frames).to(dtype), times_BF, text, K)[0].float()
        return velocity

    @property
    @abstractmethod
    def dtype(self) -> torch.dtype:
        """Of the base weights; an adapter's are float32."""

    @abstractmethod
    def call(self, x: Tensor, times_BF: Tensor, text: Tensor, num_conditioning: int) -> Any:
        """Call the transformer on x (B, C, F, H, W), times float64 and text (B, L, E); return its tuple."""

    def project_text(self, text: Tensor) -> Tensor:
        """Return the text as a Condition should keep it, (B, L, E)."""
        return text

    @contextmanager
    def disable_adapter(self) -> Iterator[None]:
        """The base model, for a while: what kl.anchor lora_off compares with."""
        if not has_lora(self):
            raise ValueError("this model has no LoRA adapter; call add_lora, or take kl.anchor frozen")
        self.transformer.disable_adapters()
        try:
            yield
        finally:
            self.transformer.enable_adapters()

    def _text(self, condition: Condition, drop: Tensor | None) -> Tensor:
        """Text of every row, the null text where it is dropped, (B, L, E)."""
        text = condition.text
        if drop is None or not bool(drop.any()):
            return text
        if self.null_text is None:
            raise ValueError(
                "classifier-free guidance needs the embedded negative prompt; load the folder with its text encoder, "
                "pass null_text, or set cfg 1"
            )
        if self.null_text.shape != text.shape[1:]:
            raise ValueError(
                f"text is {tuple(text.shape[1:])} (tokens, values), the negative prompt {tuple(self.null_text.shape)}; "
                f"embed both with embed_prompts, public models attend to the padding too"
            )
        return torch.where(drop.to(text.device).view(-1, 1, 1), self.null_text.to(text), text)


def has_lora(model: nn.Module) -> bool:
    return any("lora_" in name for name, _ in model.named_parameters())


def add_lora(model: PublicVelocity, rank: int, alpha: float | None = None, *, seed: int = 0) -> None:
    """Add an adapter in place, which starts as no change; it alone trains afterwards, in float32.

    Args:
        alpha: the adapter is scaled by alpha / rank; None: 1.
        seed: of its first weights.
    """
    if rank < 1:
        raise ValueError(f"lora.rank must be >= 1, got {rank}")
    if has_lora(model):
        raise ValueError("this model has a LoRA adapter already")
    config = package("peft").LoraConfig(
        r=rank, lora_alpha=rank if alpha is None else alpha, target_modules=list(TARGETS), lora_dropout=0.0
    )
    with torch.random.fork_rng(devices=[]):  # the weights are drawn on the CPU, then moved
        torch.manual_seed(seed)
        model.transformer.add_adapter(config)
    for name, parameter in model.named_parameters():
        parameter.requires_grad_("lora_" in name)
        if "lora_" in name:
            parameter.data = parameter.data.float()


def save_lora(model: PublicVelocity, folder: Path) -> None:
    """Write the adapter as safetensors that diffusers' pipelines load too (load_lora_adapter)."""
    if not has_lora(model):
        raise ValueError("this model has no LoRA adapter to save")
    model.transformer.save_lora_adapter(folder, safe_serialization=True)
