"""Several nodes in one process on one executor: `python -m wm_nodes.nodes.compose environment policy --ros-args ...`.

A policy beside an environment steps it by a direct call instead of env/step (about 30 times less overhead per step);
all topics and services stay. Parameters of one node come from a file (`--params-file`) under the key
`/**/environment:`; `-p` sets a parameter of all nodes.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

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


def make_nodes(names: Sequence[str]) -> list[Any]:
    """Create the named nodes, the environment first; a policy beside it gets the direct call.

    Raises:
        ValueError: an unknown or repeated name, or none.
    """
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
        else:
            module = import_module(f"wm_nodes.nodes.{name}_node")
            nodes.append(getattr(module, CLASSES[name])())
    return nodes


def _served_by(environment: EnvironmentNode | None) -> Callable[[], Any] | None:
    return None if environment is None else lambda: environment.served


def main() -> int:
    split = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    names = sys.argv[1:split]
    return run_nodes(lambda: make_nodes(names), args=sys.argv[:1] + sys.argv[split:])


if __name__ == "__main__":
    sys.exit(main())
