"""Instructions to the embedded tokens that public models attend to.

Shapes: B prompts, L tokens, E values.
"""

import html
import re
from typing import Any, Literal

import torch
from torch import Tensor

from wm_nodes.video_model.adapters.packages import package

TextStyle = Literal["wan", "cosmos2.5"]
MAX_TOKENS = 512


class TextEncoder:
    """Text encoder and tokenizer of a folder. Texts are padded to `max_tokens`, because the models attend to padding.

    style: wan takes the last layer of a T5, zero past the text's end; cosmos2.5 takes every layer of Qwen2.5-VL, each
    token normalised, side by side (E = layers x width; see CosmosVelocity.project_text).
    offload: the encoder rests on the CPU and visits the device for each call.
    """

    def __init__(
        self, encoder: Any, tokenizer: Any, style: TextStyle, *, device: str | torch.device = "cpu",
        offload: bool = False, max_tokens: int = MAX_TOKENS,
    ) -> None:
        self.encoder, self.tokenizer, self.style = encoder.requires_grad_(False).eval(), tokenizer, style
        self.device, self.offload, self.max_tokens = torch.device(device), offload, max_tokens
        if not offload:
            encoder.to(self.device)

    @torch.no_grad()
    def encode(self, prompts: list[str]) -> Tensor:
        """Return (B, L, E) on the device."""
        if self.offload:
            self.encoder.to(self.device)
        try:
            return self._qwen(prompts) if self.style == "cosmos2.5" else self._t5(prompts)
        finally:
            if self.offload:
                self.encoder.to("cpu")

    def _t5(self, prompts: list[str]) -> Tensor:
        tokens = self.tokenizer(
            [_clean(prompt) for prompt in prompts], padding="max_length", max_length=self.max_tokens, truncation=True,
            return_attention_mask=True, return_tensors="pt",
        )
        present = tokens.attention_mask.to(self.device)
        embedded: Tensor = self.encoder(tokens.input_ids.to(self.device), attention_mask=present).last_hidden_state
        masked: Tensor = embedded * present.unsqueeze(2).to(embedded.dtype)
        return masked

    def _qwen(self, prompts: list[str]) -> Tensor:
        ids = torch.stack([self._chat(prompt) for prompt in prompts]).to(self.device)
        layers: list[Tensor] = self.encoder(ids, output_hidden_states=True).hidden_states[1:]
        normal: Tensor = torch.cat([(h - h.mean(-1, True)) / (h.std(-1, keepdim=True) + 1e-8) for h in layers], -1)
        return normal

    def _chat(self, prompt: str) -> Tensor:
        system = "You are a helpful assistant who will provide prompts to an image generator."
        turns = [
            {"role": role, "content": [{"type": "text", "text": text}]}
            for role, text in (("system", system), ("user", prompt))
        ]
        ids = self.tokenizer.apply_chat_template(
            turns, tokenize=True, add_generation_prompt=False, add_vision_id=False, max_length=self.max_tokens,
            truncation=True, padding="max_length",
        )
        return torch.tensor(ids if isinstance(ids, list) else ids["input_ids"], dtype=torch.long)


def _clean(prompt: str) -> str:
    fixed = package("ftfy").fix_text(prompt)
    return re.sub(r"\s+", " ", html.unescape(html.unescape(fixed))).strip()
