"""Lookup-free quantisation (MAGVIT-2, RS-1b). Shapes: B batch, S tokens per frame, D bits per token.

A token is the vector of signs of D real values: sign(0) is -1, and code index z = sum_j 1[u_j > 0] 2^j. The gradient of
the sign is taken as the identity (straight-through).
"""

import torch
from torch import Tensor

MAX_EXACT_ENTROPY_BITS = 12


def quantize(values: Tensor) -> Tensor:
    """Signs of `values` in {-1, +1}, sign(0) = -1, with the straight-through gradient dq/du = I."""
    signs = torch.where(values > 0, 1.0, -1.0).to(values.dtype)
    return values + (signs - values).detach()


def bits_to_indices(bits: Tensor) -> Tensor:
    """Code index (...,) int64 of sign vectors (..., D); the first value is the least significant bit."""
    powers = 2 ** torch.arange(bits.shape[-1], device=bits.device)
    return ((bits > 0).long() * powers).sum(-1)


def indices_to_bits(indices: Tensor, num_bits: int) -> Tensor:
    """Sign vectors (..., num_bits) float32 of code indices (...,); the inverse of bits_to_indices."""
    powers = 2 ** torch.arange(num_bits, device=indices.device)
    return ((indices.unsqueeze(-1) & powers) != 0).float() * 2 - 1


def entropy_loss(values_BSD: Tensor) -> Tensor:
    """E[H(p)] - H(E[p]) of the code posterior, per bit and in nats.

    The posterior factorises: p(bit_j = 1 | u) = sigmoid(4 u_j), so the per-sample entropy is the sum of
    the bits' entropies. The entropy of the batch mean is exact up to MAX_EXACT_ENTROPY_BITS bits; above that the sum
    over bits, an upper bound, takes its place.
    """
    num_bits = values_BSD.shape[-1]
    probabilities = torch.sigmoid(4 * values_BSD.float()).reshape(-1, num_bits)
    sample_entropy = _binary_entropy(probabilities).sum(-1).mean()
    if num_bits <= MAX_EXACT_ENTROPY_BITS:
        codes = indices_to_bits(torch.arange(2**num_bits, device=values_BSD.device), num_bits)
        logs = torch.log(probabilities.clamp_min(1e-6)), torch.log((1 - probabilities).clamp_min(1e-6))
        joint = torch.exp(logs[0] @ (codes > 0).float().T + logs[1] @ (codes <= 0).float().T).mean(0)
        batch_entropy = -(joint * torch.log(joint.clamp_min(1e-9))).sum()
    else:
        batch_entropy = _binary_entropy(probabilities.mean(0)).sum()
    return (sample_entropy - batch_entropy) / num_bits


def _binary_entropy(probabilities: Tensor) -> Tensor:
    p = probabilities.clamp(1e-6, 1 - 1e-6)
    return -(p * torch.log(p) + (1 - p) * torch.log1p(-p))
