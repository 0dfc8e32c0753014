"""Bad input is refused, counted in diagnostics with one text that names value and remedy, and does not end training."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from graph.harness import Graph, Probe, wait_until
from graph.test_environment import Client
from graph.test_training import train
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from wm_msgs.action import Train
from wm_msgs.msg import ErrorCode, PolicyVersion, RewardBatch, TransitionBatch
from wm_msgs.srv import EvaluateReward, InferAction, LoadPolicy
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.policy_rl.training_run import POLICY_FILES
from wm_nodes.ros import convert

pytestmark = pytest.mark.graph

LEARNER, EVALUATOR, POLICY = "/wm/learner", "/wm/reward_evaluator", "/wm/policy"


def mosaic(spec: EnvironmentSpec, **changes: Any) -> Any:
    """A black env/image of stamp 0, with some of its fields changed."""
    message = convert.mosaic_msg(np.zeros((spec.num_envs, spec.height, spec.width, 3), np.uint8), 0, spec)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def wait_for_count(probe: Probe, node: str, counter: str, texts: tuple[str, ...], send: Callable[[], Any]) -> None:
    """Send until the counter of a node has grown, with the texts in its status message."""
    before = int(probe.value(node, counter) or 0)

    def counted() -> bool:
        send()
        status = probe.diagnostics.get(node)
        return int(probe.value(node, counter) or 0) > before and all(text in status.message for text in texts)  # type: ignore[union-attr]

    wait_until(f"{counter} of {node} with {texts}", counted)


BAD_MESSAGES: list[tuple[str, Callable[[EnvironmentSpec, int], Any], tuple[str, ...], str, tuple[str, ...]]] = [
    ("env/image", lambda spec, session: mosaic(spec, encoding="bgr8"), (LEARNER, EVALUATOR), "dropped env/image",
     ("encoding is 'bgr8', not 'rgb8'", "send 4 tiles of 16 x 16 px")),
    ("env/image", lambda spec, session: mosaic(replace(spec, height=8)), (LEARNER, EVALUATOR), "dropped env/image",
     ("height is 16, not 32", "send 4 tiles of 16 x 16 px")),
    ("env/image", lambda spec, session: mosaic(spec, step=1), (LEARNER, EVALUATOR), "dropped env/image",
     ("step is 1, not 96", "send 4 tiles of 16 x 16 px")),
    ("env/transition", lambda spec, session: TransitionBatch(session=session, num_envs=3), (LEARNER, EVALUATOR),
     "dropped env/transition", ("transition of 3 environments", "env/spec says 4; send a row for each")),
    ("reward", lambda spec, session: RewardBatch(transition_session=session, num_envs=4), (LEARNER,),
     "dropped reward", ("total has 0 values, expected (4,)", "compare with env/spec")),
]
"""Topic, message, who reads it, their counter, and what their status says."""


@pytest.mark.slow
def test_a_bad_message_is_counted_by_every_reader_and_training_goes_on(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    client = Client(probe)
    updates: list[Any] = []
    running = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    for name, make, nodes, counter, texts in BAD_MESSAGES:
        publisher, message = probe.publisher(name), make(client.spec, client.session)
        wait_until("matching", lambda: publisher.get_subscription_count() >= len(nodes))  # noqa: B023
        for node in nodes:
            wait_for_count(probe, node, counter, texts, lambda: publisher.publish(message))  # noqa: B023
        count = len(updates)
        wait_until("another update", lambda: len(updates) > count)  # noqa: B023
    assert probe.cancel(running).termination_reason == Train.Result.CANCELED
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED


def infer(client: Client, bad: bool) -> tuple[Any, str, Any]:
    observation = mosaic(client.spec, **({"step": 1} if bad else {}))
    request = InferAction.Request(observation=observation, tile=convert.tile_msg(client.spec), deterministic=True)
    request.state = convert.to_field(np.zeros((4, 3), np.float32))
    return InferAction, "policy/infer", request


def load(client: Client, bad: bool) -> tuple[Any, str, Any]:
    return LoadPolicy, "policy/load", LoadPolicy.Request(uri="nowhere.safetensors" if bad else POLICY_FILES.uri(1))


def evaluate(client: Client, bad: bool) -> tuple[Any, str, Any]:
    image = mosaic(client.spec)
    transitions = client.probe.messages["env/transition"]
    step = wait_until("a step", lambda: [step for step in transitions if step.header.stamp != step.next_stamp])[0]
    goal = mosaic(client.spec, encoding="mono8") if bad else mosaic(client.spec)
    request = EvaluateReward.Request(observation=image, next_observation=image, goal=goal, transition=step)
    return EvaluateReward, "reward/evaluate", request


BAD_REQUESTS: list[tuple[Callable[[Client, bool], tuple[Any, str, Any]], str, str, int, tuple[str, ...]]] = [
    (infer, POLICY, "refused_infer", ErrorCode.BAD_SHAPE, ("step is 1, not 96", "send 4 tiles of 16 x 16 px")),
    (load, POLICY, "refused_loads", ErrorCode.IO_ERROR, ("cannot read weights", "nowhere.safetensors")),
    (evaluate, EVALUATOR, "refused_evaluations", ErrorCode.BAD_SHAPE,
     ("encoding is 'mono8', not 'rgb8'", "send 4 tiles of 16 x 16 px")),
]


@pytest.mark.slow
def test_a_bad_request_is_answered_and_counted_a_good_one_served_and_training_goes_on(
    graph: Graph, probe: Probe
) -> None:
    probe.listen("env/transition")
    graph.start_training_nodes()
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED
    client = Client(probe)
    for call, node, counter, code, texts in BAD_REQUESTS:
        served = probe.call(*call(client, False))
        assert (served.error_code, served.message) == (ErrorCode.OK, "")
        assert probe.value(node, counter) is None
        refused = probe.call(*call(client, True))
        assert refused.error_code == code
        assert all(text in refused.message for text in texts), refused.message
        wait_until("the count", lambda: probe.value(node, counter) == "1")  # noqa: B023
        status = probe.diagnostics[node]
        assert all(text in status.message for text in texts), status.message
        assert train(probe, updates=1).termination_reason == Train.Result.FINISHED


BAD_CHANGES: list[tuple[str, Any, str]] = [
    ("peer_timeout_s", 0.1, "peer_timeout_s must be at least 1 s; got 0.1"),
    ("max_action_age_s", float("nan"), "max_action_age_s must be a number; got nan"),
    ("service_introspection", "all", "service_introspection must be one of off, metadata, contents; got 'all'"),
    ("num_envs", 8, "num_envs stays 4 while the node runs; start it again with num_envs:=8"),
    ("peer_timeout", 2.0, "unknown parameter 'peer_timeout'; did you mean 'peer_timeout_s'?"),
]


def test_a_version_of_another_architecture_is_refused_and_the_old_weights_go_on_acting(
    graph: Graph, probe: Probe
) -> None:
    graph.start_policy()
    publisher = probe.publisher("policy/version")
    wait_until("the policy", lambda: probe.value(POLICY, "state") == "active")
    wait_until("matching", publisher.get_subscription_count)
    publisher.publish(PolicyVersion(version=7, sha256="0" * 64, arch_hash="ab" * 32))
    wait_until("the count", lambda: probe.value(POLICY, "refused_versions") == "1")
    assert "policy version 7 has architecture abababababab" in probe.diagnostics[POLICY].message
    assert "start both with the same config_file and model_dir" in probe.diagnostics[POLICY].message
    assert probe.value(POLICY, "policy_version") == "0"


def test_a_refused_parameter_change_names_value_and_remedy_and_is_counted(graph: Graph, probe: Probe) -> None:
    graph.start_environment()

    def change(name: str, value: Any) -> Any:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return probe.call(SetParameters, "environment/set_parameters", request).results[0]

    for name, value, words in BAD_CHANGES:
        refused = change(name, value)
        assert (refused.successful, refused.reason) == (False, words)
    assert change("peer_timeout_s", 4.0).successful
    wait_until("the count", lambda: probe.value("/wm/environment", "refused_parameters") == str(len(BAD_CHANGES)))
    assert BAD_CHANGES[-1][2] in probe.diagnostics["/wm/environment"].message
