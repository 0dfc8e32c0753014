"""A policy of one robot beside another robot that has as many values: it says what differs, and serves nothing."""

from pathlib import Path

import numpy as np
import pytest
from graph.harness import Graph, Probe, wait_until
from model_folders import make_model_folder

from wm_msgs.action import Evaluate
from wm_msgs.msg import ActionBatch, ErrorCode
from wm_msgs.srv import InferAction
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.ros import convert
from wm_nodes.training.weights import save_weights

pytestmark = [pytest.mark.graph, pytest.mark.slow]
DIFFERENT = ("action_names ('vx', 'vy', 'vz'), the policy needs", "control_period_s 0.02", "it is another robot")


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return make_model_folder(tmp_path / "model")


@pytest.mark.parametrize("mode", ["asynchronous", "lockstep"])
def test_a_policy_neither_acts_on_another_robot_nor_answers_for_it(
    graph: Graph, probe: Probe, model: Path, mode: str
) -> None:
    actions, transitions, specs = (probe.listen(name) for name in ("action", "env/transition", "env/spec"))
    graph.start("policy", model_dir=model, mode=mode)
    graph.start_environment("toy:make_other_robot", num_envs=1, mode=mode)
    wait_until("the refusal", lambda: probe.value("/wm/policy", "refused_specs") == "1")
    wait_until("its text", lambda: probe.seen_errors["/wm/policy"])
    assert all(words in probe.seen_errors["/wm/policy"][0] for words in DIFFERENT)
    spec = convert.spec_from_msg(wait_until("the spec", lambda: specs)[0])
    request = InferAction.Request(tile=convert.tile_msg(spec), deterministic=True)
    request.state = convert.to_field(np.zeros(spec.state_dim, np.float32))
    request.observation = convert.mosaic_msg(np.zeros((1, spec.height, spec.width, 3), np.uint8), 0, spec)
    response = probe.call(InferAction, "policy/infer", request)
    assert response.error_code == ErrorCode.SPEC_MISMATCH and all(words in response.message for words in DIFFERENT)
    if mode == "asynchronous":
        wait_until("steps", lambda: len(transitions) > 20)
    assert all(message.mode == ActionBatch.MODE_HOLD for message in actions)


def test_a_policy_does_not_act_for_another_robot_that_comes_in_the_place_of_its_own(
    graph: Graph, probe: Probe, model: Path
) -> None:
    actions, transitions = probe.listen("action"), probe.listen("env/transition")
    graph.start("policy", model_dir=model, mode="asynchronous")
    graph.start_environment("toy:make_own_robot", num_envs=1, mode="asynchronous")
    wait_until("actions", lambda: sum(message.mode == ActionBatch.MODE_POLICY for message in actions) > 3)
    graph.kill("/wm/environment")
    own = transitions[-1].session
    graph.start_environment("toy:make_other_robot", num_envs=1, mode="asynchronous")
    wait_until("the refusal", lambda: probe.value("/wm/policy", "refused_specs") == "1")
    wait_until("the other robot's steps", lambda: sum(message.session != own for message in transitions) > 5)
    actions.clear()
    count = len(transitions)
    wait_until("more of them", lambda: len(transitions) > count + 20)
    assert not [message for message in actions if message.mode == ActionBatch.MODE_POLICY]


def test_a_policy_is_not_evaluated_on_another_robot(graph: Graph, probe: Probe, model: Path) -> None:
    save_weights(make_policy(graph.config, model), graph.folder / "start.safetensors")
    graph.start_environment("toy:make_other_robot", namespace="/wm/sim", num_envs=1)
    graph.start("evaluation", model_dir=model)
    goal = Evaluate.Goal(policy_uri="start.safetensors", episodes=1, seed=1000)
    result = probe.finish(probe.send(probe.action(Evaluate, "evaluate"), goal))
    assert result.termination_reason == Evaluate.Result.FAILED
    assert all(words in result.message for words in DIFFERENT)
