"""OpenVLA as a policy: pictures and an instruction in, action tokens out, trained by LoRA."""

from wm_nodes.policy_rl.openvla.policy import OpenVlaPolicy, make_policy

__all__ = ["OpenVlaPolicy", "make_policy"]
