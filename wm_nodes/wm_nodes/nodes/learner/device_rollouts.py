"""Rollouts made in the learner's own process, on its device, from what an environment node beside it serves.

They do not pass the topics: env/image, env/transition and reward stay silent, and a recorder has nothing of them.
"""

from collections.abc import Callable

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.lockstep import DroppedTransitions
from wm_nodes.core.types import Environment
from wm_nodes.nodes.factories import make_reward
from wm_nodes.policy_rl.device_rollout import DeviceCollector
from wm_nodes.policy_rl.rollouts import TensorRollout
from wm_nodes.policy_rl.training_run import PolicyTraining
from wm_nodes.ros.clients import Check
from wm_nodes.world_model import DeviceEnvironment, ImaginedEnvironment


class DeviceRollouts:
    """A RolloutSource, begun for every goal; the collector stays as long as environment and policy do.

    Args:
        environment: returns what the environment node serves now.
    """

    def __init__(self, environment: Callable[[], Environment | None]) -> None:
        self._environment = environment
        self._collector: DeviceCollector | None = None
        self._made_for: tuple[object, ...] = ()
        self.left_out: list[str] = []

    def begin(self, check: Check, training: PolicyTraining, config: RunConfig, model_dir: str) -> "DeviceRollouts":
        """Be the source of a goal. check: as ReplayedRollouts's.

        Raises:
            ValueError: the environment is no world model; as DeviceCollector.
        """
        environment = self._environment()
        if not isinstance(environment, ImaginedEnvironment):
            raise ValueError("device rollouts need an environment with backend world_model in the same process")
        if self._collector is None or self._made_for != (environment, training.policy):
            reward = make_reward("endogenous", config, model_dir)
            self._collector = DeviceCollector(DeviceEnvironment.beside(environment), training.policy, reward)
            self._made_for = environment, training.policy
        self._check, self._training, self._config = check, training, config
        return self

    def next(self) -> tuple[TensorRollout, DroppedTransitions]:
        assert self._collector is not None  # begin makes it
        self._check()
        ppo, seed, version = self._config.ppo, self._config.seed, self._training.progress.version
        rollout = self._collector.collect(ppo.num_steps, seed, version, envs_per_start=ppo.envs_per_start)
        return rollout, DroppedTransitions()

    def close(self) -> None:
        return None
