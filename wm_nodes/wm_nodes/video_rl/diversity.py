"""How different the videos of one context are. Shapes: n videos, K frames, D features (DD-19)."""

import torch
from torch import Tensor
from torch.nn.functional import normalize


def rollout_diversity(features_nKD: Tensor) -> float:
    """Return DD-19, the mean pairwise cosine distance 1 - e_i . e_j of the videos of one context, in [0, 2].

    e_i = normalise(concat_k normalise(features_{i,k})), so e_i . e_j is the mean over frames of the frames' cosines.

    Raises:
        ValueError: fewer than two videos, or a feature that is not finite.
    """
    n = features_nKD.shape[0]
    if n < 2:
        raise ValueError(f"diversity needs at least two videos of one context, got {n}")
    if not bool(torch.isfinite(features_nKD).all()):
        raise ValueError("a feature is not finite; look at the frames of this context")
    frames = normalize(features_nKD.double(), dim=2)
    videos = normalize(frames.flatten(1), dim=1)
    similarity = videos @ videos.T
    pairs = torch.triu_indices(n, n, offset=1)
    return float((1 - similarity[pairs[0], pairs[1]]).mean())
