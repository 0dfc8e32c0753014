"""Reinforcement learning of a robot policy inside an environment, imagined or real (loop 1). Start with train.py."""
