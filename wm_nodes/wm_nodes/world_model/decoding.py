"""Parallel decoding of one frame of discrete tokens (MaskGIT, RS-1e).

Shapes: B batch, S tokens, V codes, D bits per token.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from wm_nodes.world_model.quantizer import bits_to_indices, indices_to_bits

MAX_SINGLE_SOFTMAX_BITS = 10

Logits = tuple[Tensor, ...]
"""Logits (..., V_i) of the parts of a code, least significant bits first; one part up to MAX_SINGLE_SOFTMAX_BITS bits,
else two halves whose log-probabilities add up."""

PredictLogits = Callable[[Tensor, Tensor], Logits]
"""(bits (B, S, D), decided (B, S) bool) -> logits of every token; bits of undecided tokens must be ignored."""


@dataclass(frozen=True)
class DecodedFrame:
    """bits_BSD: +-1. passes_BS: the pass, from 1, in which each token was decided."""

    bits_BSD: Tensor
    passes_BS: Tensor


def code_parts(num_bits: int) -> tuple[int, ...]:
    """Bits per part of a code: (num_bits,), or two halves above MAX_SINGLE_SOFTMAX_BITS."""
    return (num_bits,) if num_bits <= MAX_SINGLE_SOFTMAX_BITS else (num_bits // 2, num_bits - num_bits // 2)


def decided_after(num_passes: int, num_tokens: int) -> list[int]:
    """Tokens decided after each of K passes: S - ceil(S cos(pi k / 2 K)), at least one more per pass while any is left,
    and all of them after the last."""
    counts = [num_tokens - math.ceil(num_tokens * math.cos(math.pi * k / (2 * num_passes)) - 1e-9)
              for k in range(1, num_passes + 1)]
    counts[-1] = num_tokens
    for k in range(len(counts)):
        counts[k] = min(num_tokens, max(counts[k], (counts[k - 1] if k else 0) + 1))
    return counts


def decode_frame(predict: PredictLogits, like_BSD: Tensor, num_passes: int) -> DecodedFrame:
    """Decide all tokens in `num_passes` passes, the most confident first; a decided token never changes.

    Args:
        like_BSD: fixes shape and device, its values are not read.
    """
    batch, num_tokens, num_bits = like_BSD.shape
    bits = torch.zeros_like(like_BSD)
    passes = torch.zeros(batch, num_tokens, dtype=torch.long, device=like_BSD.device)
    for number, count in enumerate(decided_after(num_passes, num_tokens), 1):
        decided = passes > 0
        drafts, confidence = choose_codes(predict(bits, decided), num_bits)
        ranked = confidence.masked_fill(decided, float("inf")).argsort(dim=1, descending=True, stable=True)
        rank = ranked.argsort(dim=1)
        fresh = (rank < count) & ~decided
        bits = torch.where(fresh.unsqueeze(-1), drafts, bits)
        passes = torch.where(fresh, number, passes)
    return DecodedFrame(bits, passes)


def choose_codes(logits: Logits, num_bits: int) -> tuple[Tensor, Tensor]:
    """Bits (..., D) and log-probability (...,) of the most probable code per token."""
    chosen, confidence = list[Tensor](), list[Tensor]()
    for part, part_bits in zip(logits, code_parts(num_bits), strict=True):
        log_probabilities = part.float().log_softmax(-1)
        index = log_probabilities.argmax(-1)
        chosen.append(indices_to_bits(index, part_bits))
        confidence.append(log_probabilities.gather(-1, index.unsqueeze(-1)).squeeze(-1))
    return torch.cat(chosen, -1), torch.stack(confidence).sum(0)


def code_targets(bits: Tensor) -> tuple[Tensor, ...]:
    """Indices (...,) of the parts of codes given as bits (..., D): the targets of the cross-entropies."""
    return tuple(bits_to_indices(part) for part in torch.split(bits, list(code_parts(bits.shape[-1])), -1))
