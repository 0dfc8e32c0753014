"""What imagined_ppo.py and imagined_sb3.py share: their command line, and the success of their policy in the simulator.
"""
import argparse
from collections.abc import Callable
from typing import Any

import gymnasium

from wm_nodes.core.statistics import wilson_interval
from wm_nodes.core.types import FloatArray
from wm_nodes.policy_rl.gym import ModelObservation

FIRST_SEED = 1_500_000
"""Of the real episodes: no model was trained with these."""


def counts(words: list[str] | None) -> tuple[int, int]:
    """The two numbers of the command line, updates and real episodes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("updates", type=int, nargs="?", default=40, help="of 64 x 16 imagined steps")
    parser.add_argument("episodes", type=int, nargs="?", default=100, help="in the simulator, after training")
    chosen = parser.parse_args(words)
    return chosen.updates, chosen.episodes


def real_success(
    act: Callable[[dict[str, Any]], FloatArray], episodes: int, task: str, observations: tuple[str, ...]
) -> str:
    """Play the episodes of reset seeds from FIRST_SEED on; return the result in words. act: observations -> action."""
    if not episodes:
        return "real success not measured"
    env = ModelObservation(gymnasium.make(f"wm_nodes.environments.gym:wm/{task}-v0"), observations, task=task)
    successes = 0
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        (shown, _), over = env.reset(seed=seed), False
        while not over:
            shown, _, success, truncated, _ = env.step(act(shown))
            over = success or truncated
        successes += success
    env.close()
    low, high = wilson_interval(successes, episodes)
    return f"real success {successes} of {episodes} (95 %: {low:.0%} to {high:.0%})"
