"""What an algorithm that trains a policy is to everything else: three calls. PPO is one (ppo.PpoLearner)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.rollouts import TensorRollout


class Learner(Protocol):
    """Trains one policy in place, a rollout at a time."""

    def update(self, rollout: Rollout | TensorRollout, *, should_stop: Callable[[], bool] | None = None) -> Any:
        """Train on a rollout of the policy's newest weights; return metrics, a mapping or a dataclass of numbers.

        A Rollout came over topics, from a bag or from collect_rollout; a TensorRollout never left the policy's device.
        rollouts.tensors_of makes of either the tensors to compute with.

        Raises:
            rollouts.Canceled: should_stop, asked now and then, returned True.
            FloatingPointError: a loss, gradient or weight is not finite.
            ValueError: the rollout cannot be trained on.
            After any of them the weights are as they were before.
        """
        ...

    def save(self, path: Path) -> None:
        """Write what an exact continuation needs beside the policy's weights (optimiser, counters, random streams), in
        one file, atomically."""
        ...

    def load(self, path: Path) -> None:
        """Continue exactly from save(). Raises ValueError: the file is of another architecture, algorithm or seed."""
        ...
