"""What all public models share: given frames, text and its absence, actions, and the adapter that can be switched off.

Shapes: B batch, C channels, F latent frames, K given frames, H W latent grid, A action values, L text tokens of E
values.
"""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.video_model.adapters.packages import package
from wm_nodes.video_model.conditions import Condition

CfgConvention = Literal["unconditional", "conditional"]


def normalised_cfg(guidance_scale: float, convention: CfgConvention) -> float:
    """Return our g of v_u + g (v_c - v_u) for a model card's scale.

    convention: what the scaled difference is added to. `unconditional`: v_u + scale (v_c - v_u), off at 1 (Wan,
    Cosmos text2world). `conditional`: v_c + scale (v_c - v_u), off at 0 (Cosmos-Predict2 and 2.5 in diffusers, which
    also switch it off at any scale <= 1).
    """
    return guidance_scale if convention == "unconditional" else 1 + guidance_scale


class PublicVelocity(nn.Module):
    """A VelocityModel around the transformer of a public model; see VelocityModel for the call.

    Args:
        transformer: a diffusers module; it keeps its own parameter names.
        null_text: embedded negative prompt (L, E), what a dropped row sees. None: dropping a row is refused.
        action_dim: 0: actions are ignored, public models were trained without. Otherwise a projection of A values per
            latent frame, zero at the start, is added to the time embedding of its frame; it is new and must be trained
            (supervised) before it means anything. A frame also sees the sum of the actions up to it.
        action_width: values of that time embedding.
        autocast: dtype of the network's arithmetic where its weights are kept in another; None: the weights' own.
            Weights of bfloat16 lose updates as small as GRPO's: train float32 weights with autocast, or a LoRA.
    """

    cfg_convention: ClassVar[CfgConvention]

    def __init__(
        self, transformer: nn.Module, null_text: Tensor | None, *, action_dim: int, action_width: int,
        autocast: torch.dtype | None,
    ) -> None:
        super().__init__()
        self.transformer: Any = transformer
        self.null_text: Tensor | None
        self.register_buffer("null_text", null_text, persistent=False)
        self.action_dim, self.autocast = action_dim, autocast
        self.actions = nn.Linear(2 * action_dim, action_width) if action_dim else None
        if self.actions is not None:
            nn.init.zeros_(self.actions.weight)
            nn.init.zeros_(self.actions.bias)

    def normalised_cfg(self, guidance_scale: float) -> float:
        """Return RolloutConfig.cfg for the scale that this model's card gives."""
        return normalised_cfg(guidance_scale, self.cfg_convention)

    def transformers(self) -> list[Any]:
        """Every network that samples, in order of falling noise."""
        return [self.transformer]

    def project_text(self, text: Tensor) -> Tensor:
        """Return the text as a Condition should keep it, (B, L, E)."""
        return text

    def enable_gradient_checkpointing(self) -> None:
        """Trade a second forward pass for the activations' memory; same gradients."""
        for transformer in self.transformers():
            transformer.enable_gradient_checkpointing()

    def save(self, folder: Path) -> None:
        """Write the transformer(s) into a diffusers folder, as safetensors.

        Raises:
            ValueError: there is a LoRA adapter, which save_lora writes.
        """
        if tuner_layers(self):
            raise ValueError("this model has a LoRA adapter; write it with save_lora")
        for index, transformer in enumerate(self.transformers()):
            name = "transformer" if index == 0 else f"transformer_{index + 1}"
            transformer.save_pretrained(folder / name, safe_serialization=True)

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

    def _precision(self, device: torch.device) -> AbstractContextManager[Any]:
        return nullcontext() if self.autocast is None else torch.autocast(device.type, self.autocast)

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

    @contextmanager
    def _steer(
        self, embedder: nn.Module, condition: Condition, drop: Tensor | None, cells: int, x: Tensor
    ) -> Iterator[None]:
        """Add the actions to what `embedder` returns, rows of (batch, frame, cell) in that order, for one call."""
        if self.actions is None:
            yield
            return
        if condition.actions.shape[1:] != (x.shape[2] - 1, self.action_dim):
            raise ValueError(
                f"this model takes {x.shape[2] - 1} actions of {self.action_dim} values for {x.shape[2]} latent frames "
                f"(the actions of a latent frame's camera frames together), got {tuple(condition.actions.shape[1:])}"
            )
        actions = F.pad(condition.actions.to(x.device, self.actions.weight.dtype), (0, 0, 1, 0))
        added = self.actions(torch.cat([actions, actions.cumsum(1) / 4], 2))
        if drop is not None:
            added = added * (~drop).to(added).view(-1, 1, 1)
        added = added.repeat_interleave(cells, 1)
        handle = embedder.register_forward_hook(lambda _module, _inputs, out: out + added.to(out.dtype).view(out.shape))
        try:
            yield
        finally:
            handle.remove()

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


def num_cells(x: Tensor, patch: tuple[int, int, int]) -> int:
    """Tokens of one latent frame."""
    return math.prod(size // side for size, side in zip(x.shape[3:], patch[1:]))
