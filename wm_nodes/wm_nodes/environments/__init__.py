"""Environments behind one interface: ManiSkill, and recording of episodes in any of them."""
