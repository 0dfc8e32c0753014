"""Reward models: what a step is worth. Stateless, so recorded steps can be scored again with equal results."""

from wm_nodes.reward.base import SUCCESS_NO, SUCCESS_UNKNOWN, SUCCESS_YES, RewardInput, RewardModel, RewardResult
from wm_nodes.reward.distances import Distance, EncoderDistance
from wm_nodes.reward.endogenous import EndogenousReward
from wm_nodes.reward.rule import RuleReward

__all__ = [
    "SUCCESS_NO", "SUCCESS_UNKNOWN", "SUCCESS_YES", "Distance", "EncoderDistance", "EndogenousReward", "RewardInput",
    "RewardModel", "RewardResult", "RuleReward",
]
