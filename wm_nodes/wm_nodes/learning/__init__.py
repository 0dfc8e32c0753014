"""Learners, rollouts, evaluation, weights and checkpoints. Import from the submodules; nothing is loaded here."""
