"""Several nodes in one process on one executor: `python -m wm_nodes.nodes.compose environment policy --ros-args ...`.

A policy beside an environment steps it by a direct call instead of env/step (about 30 times less overhead per step);
all topics and services stay. With `--device-rollouts` among the names the learner makes its rollouts itself, by the
model that the environment beside it serves and with the endogenous reward, and they never leave the device: the fast
path on a GPU. Of training, topics then show policy/version, learner/metrics and diagnostics alone.

Parameters of one node come from a file (`--params-file`) under the key `/**/environment:`; `-p` sets a parameter of all
nodes.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from wm_nodes.core.types import Environment
from wm_nodes.nodes.environment_node import EnvironmentNode
from wm_nodes.nodes.policy_node import PolicyNode
from wm_nodes.ros.spin import run_nodes

CLASSES = {
    "environment": "EnvironmentNode",
    "policy": "PolicyNode",
    "reward_evaluator": "RewardEvaluatorNode",
    "learner": "LearnerNode",
    "recorder": "RecorderNode",
    "evaluation": "EvaluationNode",
}


DEVICE_ROLLOUTS = "--device-rollouts"


def make_nodes(names: Sequence[str], *, device_rollouts: bool = False) -> list[Any]:
    """Create the named nodes, the environment first; a policy beside it gets the direct call.

    Raises:
        ValueError: an unknown or repeated name, or none; device rollouts without environment and learner.
    """
    if device_rollouts and not {"environment", "learner"} <= set(names):
        raise ValueError(f"{DEVICE_ROLLOUTS} needs environment and learner in one process; got {' '.join(names)}")
    unknown = [name for name in names if name not in CLASSES]
    if unknown or not names or len(set(names)) != len(names):
        raise ValueError(f"compose takes different nodes of {', '.join(CLASSES)}; got {' '.join(names) or 'none'}")
    nodes: list[Any] = []
    environment: EnvironmentNode | None = None
    for name in sorted(names, key=list(CLASSES).index):
        if name == "environment":
            environment = EnvironmentNode()
            nodes.append(environment)
        elif name == "policy":
            nodes.append(PolicyNode(local_environment=_served_by(environment)))
        elif name == "learner" and device_rollouts:
            from wm_nodes.nodes.learner_node import LearnerNode

            nodes.append(LearnerNode(local_environment=_rewarded(nodes)))
        else:
            module = import_module(f"wm_nodes.nodes.{name}_node")
            nodes.append(getattr(module, CLASSES[name])())
    return nodes


def _served_by(environment: EnvironmentNode | None) -> Callable[[], Any] | None:
    return None if environment is None else lambda: environment.served


def _rewarded(nodes: Sequence[Any]) -> Callable[[], Environment | None]:
    """What gives the served environment, once a reward evaluator among the nodes is known to give its reward."""

    def environment() -> Environment | None:
        for node in nodes:
            if isinstance(node, EnvironmentNode):
                served = node.served
            elif node.get_name() == "reward_evaluator" and (
                node.param("reward") != "endogenous" or node.run_config().reward.factory
            ):
                reward = node.run_config().reward.factory or node.param("reward")
                raise ValueError(f"{DEVICE_ROLLOUTS} has the endogenous reward, and the reward evaluator's is {reward}")
        return None if served is None else served.environment

    return environment


def main() -> int:
    split = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    names = [name for name in sys.argv[1:split] if name != DEVICE_ROLLOUTS]
    device_rollouts = DEVICE_ROLLOUTS in sys.argv[1:split]
    return run_nodes(lambda: make_nodes(names, device_rollouts=device_rollouts), args=sys.argv[:1] + sys.argv[split:])


if __name__ == "__main__":
    sys.exit(main())
