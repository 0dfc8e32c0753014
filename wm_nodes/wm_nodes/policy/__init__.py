"""Image policies and their action distribution. A policy knows no environment, no wire and no world model."""

from wm_nodes.policy.action_tokens import ActionTokenizer
from wm_nodes.policy.gaussian import DiagonalGaussian
from wm_nodes.policy.image_policy import ImageEncoder, ImagePolicy, PolicyOutput

__all__ = ["ActionTokenizer", "DiagonalGaussian", "ImageEncoder", "ImagePolicy", "PolicyOutput"]
