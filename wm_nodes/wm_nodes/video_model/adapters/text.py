"""Instructions to the embedded tokens that public models attend to. Shapes: B prompts, L tokens, E values."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


class TextEncoder:
    """The way of a diffusers pipeline from prompts to tokens, padded to `max_tokens`, because the models attend to
    padding.

    Args:
        pipeline: with tokenizer and text encoder.
        device: where it computes. offload: the encoder rests on the CPU and visits the device for each call.
    """

    def __init__(
        self, pipeline: Any, *, device: str | torch.device = "cpu", offload: bool = False, max_tokens: int = 512
    ) -> None:
        pipeline.text_encoder.requires_grad_(False).eval()
        self.pipeline, self.device, self.offload, self.max_tokens = pipeline, torch.device(device), offload, max_tokens

    @torch.no_grad()
    def encode(self, prompts: list[str]) -> Tensor:
        """Return (B, L, E) on the device."""
        with visiting(self.pipeline.text_encoder, self.device, self.offload):
            text: Tensor = self.pipeline.encode_prompt(
                prompts, do_classifier_free_guidance=False, max_sequence_length=self.max_tokens, device=self.device
            )[0]
        return text


@contextmanager
def visiting(module: Any, device: torch.device, offload: bool) -> Iterator[None]:
    """Have a module on a device; offload: it goes back to the CPU afterwards."""
    module.to(device)
    try:
        yield
    finally:
        if offload:
            module.to("cpu")
