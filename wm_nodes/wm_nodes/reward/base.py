"""What goes into a reward model and what comes out. Shapes: N environments, K golden frames, H W 3 image."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array

SUCCESS_NO, SUCCESS_YES, SUCCESS_UNKNOWN = 0, 1, 2


@dataclass(frozen=True)
class RewardInput:
    """One step of N environments: the images before and after it, and what is known about the image after it."""

    images: UInt8Array
    """uint8 (N, H, W, 3), before the step."""
    next_images: UInt8Array
    """uint8 (N, H, W, 3), after it."""
    success_probability: FloatArray
    """float32 (N,), done signal on next_images; NaN where unknown."""
    valid: BoolArray
    """bool (N,), False where no step was made."""
    uncertainty: FloatArray
    """float32 (N,), >= 0."""
    goals: UInt8Array | None = None
    """uint8 (N, H, W, 3), or None without goals."""
    goal_found: BoolArray | None = None
    """bool (N,); None means all found."""
    golden: UInt8Array | None = None
    """uint8 (N, K, H, W, 3), the golden trajectory from its first frame to the goal, the goal repeated at the end; only
    the progress mode reads it."""
    golden_lengths: NDArray[np.int64] | None = None
    """int (N,), frames of golden that count, 2 to K; only the progress mode reads them."""

    def __post_init__(self) -> None:
        count = len(self.images)
        if self.images.dtype != np.uint8 or self.images.ndim != 4:
            raise ValueError(f"images must be uint8 (N, H, W, 3), got {self.images.dtype} {self.images.shape}")
        for name in ("next_images", "goals"):
            array = getattr(self, name)
            if array is not None and (array.dtype != np.uint8 or array.shape != self.images.shape):
                raise ValueError(f"{name} must be uint8 {self.images.shape}, got {array.dtype} {array.shape}")
        for name in ("success_probability", "valid", "uncertainty", "goal_found", "golden_lengths"):
            array = getattr(self, name)
            if array is not None and array.shape != (count,):
                raise ValueError(f"{name} must have shape ({count},), got {array.shape}")
        if self.golden is not None:
            if self.golden_lengths is None:
                raise ValueError("golden needs golden_lengths, the number of frames that count")
            expected = (count, self.golden.shape[1], *self.images.shape[1:])
            if self.golden.dtype != np.uint8 or self.golden.shape != expected:
                raise ValueError(f"golden must be uint8 {expected}, got {self.golden.dtype} {self.golden.shape}")
            if np.any(self.golden_lengths < 2) or np.any(self.golden_lengths > self.golden.shape[1]):
                raise ValueError(f"golden_lengths must lie in 2..{self.golden.shape[1]}, got {self.golden_lengths}")


@dataclass(frozen=True)
class RewardResult:
    """The rewards of one step of N environments; all arrays (N,)."""

    total: FloatArray
    """float32, the sum of the components; NaN where valid is False."""
    dense: FloatArray
    """float32, weighted; NaN where valid is False."""
    sparse: FloatArray
    """float32, weighted; NaN where valid is False."""
    valid: BoolArray
    """bool, True where there is a reward."""
    success: NDArray[np.uint8]
    """uint8, SUCCESS_NO, SUCCESS_YES or SUCCESS_UNKNOWN."""
    invalid_reason: str = ""
    """Empty when every made step has a reward; steps not made (input valid=False) need no reason."""
    components: Mapping[str, FloatArray] = field(default_factory=dict)
    """Weighted, by name."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """By the names of the components."""


class RewardModel(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def version(self) -> int:
        """Changes with every change of weights, thresholds or models; fits uint64."""
        ...

    def evaluate(self, step: RewardInput) -> RewardResult: ...


def version_of(*parts: str) -> int:
    """Return a 63-bit number that differs when any of the texts differs."""
    return int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:8], "little") >> 1


def assemble(
    dense: FloatArray, sparse: FloatArray, step: RewardInput, success: NDArray[np.uint8],
    reasons: Mapping[str, BoolArray], weights: Mapping[str, float],
) -> RewardResult:
    """Join weighted terms into a result; a step is invalid where any of `reasons` holds or a term is not finite."""
    reasons = {**reasons, "reward is not finite": ~np.isfinite(dense) | ~np.isfinite(sparse)}
    valid = step.valid.copy()
    texts: list[str] = []
    for reason, where in reasons.items():
        hit = valid & where
        if hit.any():
            texts.append(f"{reason} (environments {np.flatnonzero(hit).tolist()})")
        valid &= ~where
    nan = np.float32(np.nan)
    dense, sparse = (np.where(valid, term, nan).astype(np.float32) for term in (dense, sparse))
    return RewardResult(
        total=dense + sparse, dense=dense, sparse=sparse, valid=valid,
        success=np.where(step.valid, success, SUCCESS_UNKNOWN).astype(np.uint8), invalid_reason="; ".join(texts),
        components={"dense": dense, "sparse": sparse}, weights=weights,
    )
