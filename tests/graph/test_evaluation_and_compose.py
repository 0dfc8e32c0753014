"""The evaluation node against an environment in namespace sim, and several nodes in one process."""

import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
import yaml
from graph import toy
from graph.harness import Graph, Probe, wait_until

from wm_msgs.action import Evaluate, Rollout, Train
from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.evaluation import evaluate
from wm_nodes.training.weights import save_weights

pytestmark = pytest.mark.graph


def test_evaluation_over_dds_equals_evaluation_in_one_process(graph: Graph, probe: Probe) -> None:
    policy = toy.make_policy(graph.config)
    save_weights(policy, graph.folder / "start.safetensors")
    graph.start_environment(namespace="/wm/sim", num_envs=3)
    graph.start("evaluation", policy_factory="toy:make_policy")
    client = probe.action(Evaluate, "evaluate")
    goal = Evaluate.Goal(policy_uri="start.safetensors", episodes=7, seed=1000, deterministic=False)
    result = probe.finish(probe.send(client, goal))
    assert result.termination_reason == Evaluate.Result.FINISHED, result.message
    expected = evaluate(policy, toy.make_environment(load_config("smoke"), 2, 0), 7, 1000, deterministic=False)
    np.testing.assert_array_equal(np.array(result.success, bool), expected.success)
    np.testing.assert_array_equal(np.array(result.length), expected.length)
    assert result.success_low == pytest.approx(expected.low)
    assert result.success_high == pytest.approx(expected.high)
    missing = probe.finish(probe.send(client, Evaluate.Goal(policy_uri="gone.safetensors", episodes=1)))
    assert missing.termination_reason == Evaluate.Result.FAILED
    assert "gone.safetensors" in missing.message


@pytest.mark.alone
def test_cancel_ends_an_evaluation_and_a_rollout_within_a_second(graph: Graph, probe: Probe) -> None:
    save_weights(toy.make_policy(graph.config), graph.folder / "start.safetensors")
    graph.start_environment("toy:make_long_environment", namespace="/wm/sim", num_envs=3)
    graph.start("evaluation", policy_factory="toy:make_policy")
    graph.start_environment("toy:make_long_environment")
    graph.start_policy()
    goals = {
        "evaluate": (Evaluate, Evaluate.Goal(policy_uri="start.safetensors", episodes=100_000, deterministic=True)),
        "rollout": (Rollout, Rollout.Goal(steps=100_000, reset=True)),
    }
    for name, (kind, goal) in goals.items():
        transitions = probe.listen("env/transition", at="sim/env/transition" if name == "evaluate" else None)
        transitions.clear()
        handle = probe.send(probe.action(kind, name), goal)
        wait_until(f"steps of {name}", lambda: len(transitions) > 5, 30)  # noqa: B023
        began = time.monotonic()
        probe.run(handle.cancel_goal_async, 5, "cancel")
        assert probe.finish(handle, 5).termination_reason == kind.Result.CANCELED
        assert time.monotonic() - began < 1.0, name


def test_a_composed_process_steps_by_direct_call_and_trains_to_the_same_weights(graph: Graph, probe: Probe) -> None:
    transitions = probe.listen("env/transition")
    command = [
        sys.executable, "-m", "wm_nodes.nodes.compose", "environment", "policy", "reward_evaluator", "learner",
        "--ros-args", "-r", "__ns:=/wm", "-p", f"config_file:={graph.folder / 'config.yaml'}",
        "-p", f"run_dir:={graph.folder}", "--params-file", str(graph.folder / "nodes.yaml"),
    ]
    params: dict[str, dict[str, Any]] = {
        "environment": {"backend": "factory", "backend_factory": "toy:make_environment", "num_envs": 4},
        "policy": {"policy_factory": "toy:make_policy"},
        "learner": {"policy_factory": "toy:make_policy"},
        "reward_evaluator": {"reward": "rule"},
    }
    content = {f"/**/{node}": {"ros__parameters": values} for node, values in params.items()}
    (graph.folder / "nodes.yaml").write_text(yaml.safe_dump(content))
    log = open(graph.log_path("composed"), "wb")  # noqa: SIM115
    graph.processes["composed"] = subprocess.Popen(command, env=graph.environment(), stdout=log, stderr=log)
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=2)))
    assert (result.termination_reason, result.policy_version) == (Train.Result.FINISHED, 3)
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000003.safetensors", updates=2)
    assert probe.value("/wm/environment", "step_p50_ms") is None, "the step service was used"
    rollout = probe.finish(probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=3, reset=True)))
    wait_until("the topics", lambda: transitions and transitions[-1].step_id == rollout.last_step_id)
