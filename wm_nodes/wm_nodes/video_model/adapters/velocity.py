"""What all public models share: given frames, text and its absence, and the adapter that can be switched off.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid, L text tokens of E values.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.video_model.adapters.packages import package
from wm_nodes.video_model.conditions import Condition


class PublicVelocity(nn.Module):
    """A VelocityModel around the transformer of a public model; see VelocityModel for the call.

    Args:
        transformer: a diffusers module; it keeps its own parameter names.
        null_text: embedded negative prompt (L, E), what a dropped row sees. None: dropping a row is refused.
    """

    def __init__(self, transformer: nn.Module, null_text: Tensor | None) -> None:
        super().__init__()
        self.transformer: Any = transformer
        self.null_text: Tensor | None
        self.register_buffer("null_text", null_text, persistent=False)

    def project_text(self, text: Tensor) -> Tensor:
        """Return the text as a Condition should keep it, (B, L, E)."""
        return text

    def enable_gradient_checkpointing(self) -> None:
        """Trade a second forward pass for the activations' memory; same gradients."""
        self.transformer.enable_gradient_checkpointing()

    @contextmanager
    def disable_adapter(self) -> Iterator[None]:
        """The base model, for a while: what kl.anchor lora_off compares with."""
        layers = tuner_layers(self)
        if not layers:
            raise ValueError("this model has no LoRA adapter; call add_lora, or take kl.anchor frozen")
        for layer in layers:
            layer.enable_adapters(False)
        try:
            yield
        finally:
            for layer in layers:
                layer.enable_adapters(True)

    # for subclasses

    def _text(self, condition: Condition, drop: Tensor | None, dtype: torch.dtype) -> Tensor:
        """Text of every row, the null text where it is dropped, (B, L, E)."""
        text = condition.text.to(dtype)
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
                f"embed both with the same TextEncoder, public models attend to the padding too"
            )
        return torch.where(drop.to(text.device).view(-1, 1, 1), self.null_text.to(text), text)

    def _frame_times(self, t: Tensor, x: Tensor, num_conditioning: int, clean: float) -> Tensor:
        """t on generated frames and `clean` on given ones, float64 (B, F)."""
        times_BF = t.to(x.device, torch.float64).view(-1, 1).repeat(1, x.shape[2])
        times_BF[:, :num_conditioning] = clean
        return times_BF

    def _check_grid(self, x: Tensor, patch: tuple[int, int, int], channels: int) -> None:
        if x.shape[1] != channels or any(size % side for size, side in zip(x.shape[2:], patch)):
            raise ValueError(
                f"this model takes {channels} latent channels on a grid of multiples of {tuple(patch)} (frames, "
                f"height, width), got {tuple(x.shape[1:])}"
            )


def tuner_layers(model: nn.Module) -> list[Any]:
    """The layers of `model` that carry a LoRA; none without the peft package."""
    if not any("lora_" in name for name, _ in model.named_parameters()):
        return []
    base = package("peft.tuners.tuners_utils").BaseTunerLayer
    return [module for module in model.modules() if isinstance(module, base)]
