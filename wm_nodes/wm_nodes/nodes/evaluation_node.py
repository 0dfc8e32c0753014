"""evaluation: plays episodes on fixed seeds in another environment node (the simulator) and says how many succeed."""

import sys
from typing import Any

from wm_msgs.action import Evaluate
from wm_msgs.msg import PolicyVersion
from wm_nodes.nodes.environment.remote_environment import RemoteEnvironment
from wm_nodes.nodes.factories import existing, expected_spec, make_policy, refuse_for_policy
from wm_nodes.nodes.policy.weights import PolicyHolder, read_weights
from wm_nodes.policy_rl.training_run import POLICY_FILES
from wm_nodes.policy_rl.validation.evaluation import EvaluationResult, evaluate
from wm_nodes.ros import convert
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.clients import RosEnvironmentClient
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.worker import Work

PARAMS = (
    Param("model_dir", "", "World-model folder; its tokenizer is the policy's encoder", read_only=True),
    Param("initial_policy", "", "Weights (safetensors) for goals without version and file, before any announcement",
          read_only=True),
    Param("env_namespace", "sim", "Relative namespace of the environment node to evaluate in", read_only=True),
    Param("step_timeout_s", 20.0, "Deadline of one env/step or env/reset", "s", read_only=True,
          minimum=0.1, maximum=600.0),
    Param("handshake_timeout_s", 20.0, "Deadline for the environment to answer env/get_spec", "s",
          minimum=0.1, maximum=600.0),
)

MAX_EPISODES = 1_000_000


class EvaluationNode(ManagedNode):
    """Action evaluate; follows policy/version."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("evaluation", PARAMS, **node_arguments)

    def configure(self) -> None:
        self._config, model_dir = self.run_config(), str(self.param("model_dir"))
        self._holder = PolicyHolder(make_policy(self._config, model_dir))
        self._expected_spec = expected_spec(self._config, model_dir)
        self._files = named_files(self, str(self.param("initial_policy")))
        self._newest: PolicyVersion | None = None
        self._environment = RosEnvironmentClient(
            self, str(self.param("env_namespace")), float(self.param("step_timeout_s"))
        )
        self.listen("policy/version", self._on_version, while_inactive=True)
        self._action = WorkerAction(self, Evaluate, "evaluate", self._evaluate)

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)

    def _on_version(self, message: PolicyVersion) -> None:
        self._newest = message

    def _evaluate(self, work: Work, result: Evaluate.Result) -> None:
        goal: Evaluate.Goal = work.request
        if not (1 <= goal.episodes <= MAX_EPISODES and goal.seed + goal.episodes <= 2**63):
            raise ValueError(
                f"episodes {goal.episodes} from seed {goal.seed}: ask for 1 to {MAX_EPISODES}, of seeds below 2^63"
            )
        result.policy_version = self._load(goal)
        environment = RemoteEnvironment(
            self._environment, work.check, timeout_s=float(self.param("handshake_timeout_s")),
            behaviour=goal.behaviour or "policy", policy_version=result.policy_version,
        )

        refuse_for_policy(environment.spec, self._expected_spec, self._holder.policy)

        def report(done: int, successes: int) -> None:
            work.feedback(Evaluate.Feedback(episodes_done=done, success_rate=successes / max(done, 1)))

        evaluation = evaluate(
            self._holder.policy, environment, int(goal.episodes), int(goal.seed), goal.deterministic,
            on_progress=report,
        )
        self._fill(result, evaluation, self._config.reward.sparse_weight)

    def _load(self, goal: Evaluate.Goal) -> int:
        """Load the weights the goal names; return their version (0 for a file)."""
        if goal.policy_uri:
            self._holder.load(read_weights(goal.policy_uri, self._files), 0)
            return 0
        newest = self._newest
        if goal.policy_version == 0 and newest is None:
            path = existing(str(self.param("initial_policy")), "initial_policy (or give policy_uri in the goal)")
            self._holder.load(path.read_bytes(), 0)
        elif newest is not None and goal.policy_version in (0, newest.version):
            self._holder.follow(newest, self._files)
        else:
            version = int(goal.policy_version)
            self._holder.load(read_weights(POLICY_FILES.uri(version), self._files), version)
        return self._holder.version

    @staticmethod
    def _fill(result: Evaluate.Result, evaluation: EvaluationResult, sparse_weight: float) -> None:
        """mean_return: of the rule reward, which pays sparse_weight once, at the success that ends an episode."""
        result.episodes, result.successes = evaluation.episodes, evaluation.successes
        result.success_rate, result.mean_length = evaluation.success_rate, evaluation.mean_length
        result.success_low, result.success_high = evaluation.low, evaluation.high
        result.mean_return = sparse_weight * evaluation.success_rate
        result.success = convert.to_field(evaluation.success)
        result.length = convert.to_field(evaluation.length)


def main() -> int:
    return run_node(EvaluationNode)


if __name__ == "__main__":
    sys.exit(main())
