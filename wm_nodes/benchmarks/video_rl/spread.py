"""How far the videos of one context spread. Shapes: n videos, K frames, D features (DD-19)."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from wm_nodes.video_model import RolloutBuffer


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


def centred_pixels(videos: Tensor) -> Tensor:
    """Features of generated frames, (n, F - 1, C H W): pixels less their frame's mean, so that motion shows."""
    frames = videos[:, :, 1:].transpose(1, 2)
    return (frames - frames.mean((3, 4), keepdim=True)).flatten(2)


def group_spread(buffer: RolloutBuffer, group_size: int) -> dict[str, float]:
    """How far the videos of a scene spread, mean over the buffer's scenes.

    rollout_diversity: DD-19 of centred pixels. rollout_reward_std: of the training reward.
    """
    latents = buffer.rollout.latents
    groups = latents.view(-1, group_size, *latents.shape[1:])
    diversity = sum(rollout_diversity(centred_pixels(videos)) for videos in groups) / len(groups)
    return {"rollout_diversity": diversity, "rollout_reward_std": reward_spread(buffer)}


def reward_spread(buffer: RolloutBuffer) -> float:
    """Standard deviation of the training reward within a group, mean over the groups; of the valid videos."""
    groups = sorted(set(buffer.group_ids[buffer.valid].tolist()))
    rewards = (buffer.rewards["total"][buffer.valid & (buffer.group_ids == group)] for group in groups)
    return sum(float(values.std(correction=0)) for values in rewards) / max(1, len(groups))
