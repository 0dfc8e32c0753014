"""Reinforcement-learning mathematics: functions of tensors and floats, no models, no storage."""

from wm_nodes.rl.advantages import explained_variance, gae, masked_normalise
from wm_nodes.rl.losses import approximate_kl, clip_fraction, clipped_policy_loss, value_loss

__all__ = [
    "approximate_kl",
    "clip_fraction",
    "clipped_policy_loss",
    "explained_variance",
    "gae",
    "masked_normalise",
    "value_loss",
]
