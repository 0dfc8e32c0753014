"""The evaluation node against an environment in namespace sim, and several nodes in one process."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from deadlines import within
from graph import toy
from graph.harness import Graph, Probe, wait_until
from model_folders import make_model_folder, make_stepped_folder, write_starts
from safetensors.numpy import load_file, save_file

from wm_msgs.action import Evaluate, Rollout, Train
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.nodes.compose import make_nodes
from wm_nodes.policy_rl.factories import (
    make_endogenous_reward,
    make_imagined_environment,
    make_policy,
    make_video_environment,
)
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.policy_rl.validation.evaluation import evaluate
from wm_nodes.policy_rl.validation.exploit_meter import make_exploit_meter
from wm_nodes.reports.summary import plain, read_readings
from wm_nodes.training.weights import pack_weights, save_weights, unpack_weights

pytestmark = pytest.mark.graph


@pytest.mark.slow
def test_evaluation_over_dds_equals_evaluation_in_one_process(graph: Graph, probe: Probe) -> None:
    policy = toy.make_policy(graph.config)
    save_weights(policy, graph.folder / "start.safetensors")
    graph.start_environment(namespace="/wm/sim", num_envs=3)
    graph.start("evaluation", policy__factory="toy:make_policy")
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
    graph.start("evaluation", policy__factory="toy:make_policy")
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
        wait_until(f"steps of {name}", lambda: len(transitions) > 5)  # noqa: B023
        began = time.monotonic()
        assert probe.cancel(handle).termination_reason == kind.Result.CANCELED
        assert time.monotonic() - began < within(1.0), name


def start_composed(graph: Graph, params: dict[str, dict[str, Any]], *options: str, **settings: Any) -> None:
    command = [
        sys.executable, "-m", "wm_nodes.nodes.compose", *options, *params,
        "--ros-args", "-r", "__ns:=/wm", "-p", f"config_file:={graph.config_file(**settings)}",
        "-p", f"run_dir:={graph.folder}", "--params-file", str(graph.folder / "nodes.yaml"),
    ]
    content = {f"/**/{node}": {"ros__parameters": values} for node, values in params.items()}
    (graph.folder / "nodes.yaml").write_text(yaml.safe_dump(content))
    log = open(graph.log_path("composed"), "wb")  # noqa: SIM115
    graph.processes["composed"] = subprocess.Popen(command, env=graph.environment(), stdout=log, stderr=log)


@pytest.mark.slow
def test_a_composed_process_steps_by_direct_call_and_trains_to_the_same_weights(graph: Graph, probe: Probe) -> None:
    transitions = probe.listen("env/transition")
    start_composed(graph, {
        "environment": {"backend": "environment", "num_envs": 4}, "policy": {}, "learner": {},
        "reward_evaluator": {"reward": "rule"},
    }, environment__factory="toy:make_environment", policy__factory="toy:make_policy")
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=2)))
    assert (result.termination_reason, result.policy_version) == (Train.Result.FINISHED, 3)
    toy.assert_trained_in_one_process(graph.folder / "policies" / "policy_000003.safetensors", updates=2)
    assert probe.value("/wm/environment", "step_p50_ms") is None, "the step service was used"
    rollout = probe.finish(probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=3, reset=True)))
    wait_until("the topics", lambda: transitions and transitions[-1].step_id == rollout.last_step_id)


@pytest.fixture
def imagined(tmp_path: Path) -> dict[str, dict[str, Any]]:
    """Parameters of nodes that train in an untrained world model of 8 environments."""
    model = make_model_folder(tmp_path / "model")
    starts = write_starts(model / STARTS)
    params = {
        "environment": {"backend": "world_model", "starts_file": str(starts), "num_envs": 8}, "policy": {},
        "reward_evaluator": {"reward": "endogenous"}, "learner": {},
    }
    return {node: {"model_dir": str(model), **values} for node, values in params.items()}


@pytest.mark.slow
@pytest.mark.parametrize("advantage", ["gae", "group"])
def test_device_rollouts_give_the_weights_of_policy_rl_train_and_leave_the_topics_of_steps_silent(
    graph: Graph, probe: Probe, imagined: dict[str, dict[str, Any]], advantage: str
) -> None:
    settings = {"ppo.advantage": advantage, "ppo.group_size": 4}
    if advantage == "group":  # some episodes end and others follow, which do not count
        settings["reward.success_threshold"] = 0.13
    config = load_config("smoke", settings)
    (graph.folder / "config.yaml").write_text(dump_config(config))
    transitions, versions, metrics = (probe.listen(t) for t in ("env/transition", "policy/version", "learner/metrics"))
    start_composed(graph, imagined, "--device-rollouts")
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=2)))
    assert (result.termination_reason, result.policy_version) == (Train.Result.FINISHED, 3), result.message
    wait_until("versions and metrics", lambda: versions and versions[-1].version == 3 and len(metrics) == 2)
    assert not transitions

    model = Path(imagined["learner"]["model_dir"])
    policy, reward = make_policy(config, model), make_endogenous_reward(config, model)
    env = make_imagined_environment(config, model, model / STARTS, num_envs=8, seed=0)
    trained = list(train_policy(policy, env, reward, config))
    assert result.samples == sum(metrics.samples for _, metrics in trained)
    collected = sum(int(rollout.valid_TN.sum()) for rollout, _ in trained)
    assert result.samples == collected if advantage == "gae" else result.samples < collected
    found, _ = unpack_weights((graph.folder / "policies" / "policy_000003.safetensors").read_bytes())
    for name, tensor in unpack_weights(pack_weights(policy).data)[0].items():
        np.testing.assert_array_equal(found[name].numpy(), tensor.numpy(), err_msg=name)

    rollout = probe.finish(probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=3, reset=True)))
    wait_until("steps for whoever asks", lambda: transitions and transitions[-1].step_id == rollout.last_step_id)


@pytest.mark.slow
def test_a_policy_trains_in_a_video_model_to_the_weights_of_one_process(
    graph: Graph, probe: Probe, imagined: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    """Environment, policy, reward and learner in four processes; environments end at different steps. The exploit
    meter reads in a fifth, a world model that stands in for the simulator."""
    folder, model = make_stepped_folder(tmp_path / "video_model"), Path(imagined["learner"]["model_dir"])
    imagined["environment"] |= {"backend": "video_model", "video_model_dir": str(folder)}
    imagined["policy"]["await_nodes"] = ["environment", "reward_evaluator", "learner"]
    config, simulated = start_metered(graph, imagined, folder, threshold=0.1307)
    for node in ("environment", "policy", "reward_evaluator"):
        graph.start(node, **imagined[node])
    metrics = probe.listen("learner/metrics")
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=2)))
    assert (result.termination_reason, result.policy_version) == (Train.Result.FINISHED, 3), result.message

    policy, reward = make_policy(config, model), make_endogenous_reward(config, model)
    env = make_video_environment(config, folder, model / STARTS, num_envs=8, seed=0)
    simulator = make_imagined_environment(simulated, model, model / STARTS, num_envs=2, seed=0)
    meter = make_exploit_meter(config, model, model / STARTS, lambda: simulator, video_model_dir=folder)
    assert meter is not None
    rollouts = [rollout for rollout, _ in train_policy(policy, env, reward, config, meter)]
    readings = read_readings(graph.folder)
    assert readings == [plain({"step": made, **r.metrics()}) for made, r in meter.readings.items()]
    assert [reading["step"] for reading in readings] == [0, 1, 2] and 0 < readings[0]["precision"] <= 1
    wait_until("updates and readings on the topic", lambda: len(metrics) == 5)
    told = [dict(zip(m.names, m.values)) for m in metrics if "exploit_meter/precision" in m.names]
    assert [found["exploit_meter/real_success"] for found in told] == [r["real_success"] for r in readings]
    ended = rollouts[0].terminated_TN
    assert ended.any() and not ended.all(), "the reader is to end some episodes"
    found, _ = unpack_weights((graph.folder / "policies" / "policy_000003.safetensors").read_bytes())
    for name, tensor in unpack_weights(pack_weights(policy).data)[0].items():
        np.testing.assert_array_equal(found[name].numpy(), tensor.numpy(), err_msg=name)


def start_metered(
    graph: Graph, imagined: dict[str, dict[str, Any]], folder: Path, threshold: float, **changes: float
) -> tuple[RunConfig, RunConfig]:
    """Start a learner that reads the exploit meter before every update, and in namespace sim an untrained world model
    that calls success what exceeds `threshold`; return the configurations of both. folder: of the video model."""
    starts = Path(imagined["environment"]["starts_file"])
    save_file({**load_file(starts), "seeds": np.arange(5)}, starts)
    meter = {f"exploit_meter.{name}": value for name, value in {"every": 1, "episodes": 5, **changes}.items()}
    config, simulated = load_config("smoke", meter), load_config("smoke", {"reward.success_threshold": threshold})
    for name, settings in (("config.yaml", config), ("simulated.yaml", simulated)):
        (graph.folder / name).write_text(dump_config(settings))
    world = {"backend": "world_model", "num_envs": 2, "model_dir": starts.parent, "starts_file": starts}
    graph.start("environment", namespace="/wm/sim", config_file=graph.folder / "simulated.yaml", **world)
    graph.start("learner", **imagined["learner"], starts_file=starts, video_model_dir=folder)
    return config, simulated


@pytest.mark.slow
def test_a_training_that_the_exploit_meter_stops_ends_with_its_reason_and_the_policy_as_it_is(
    graph: Graph, probe: Probe, imagined: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    start_metered(graph, imagined, make_stepped_folder(tmp_path / "video_model"), threshold=1.0, stop_precision=1.0)
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=2)))
    assert (result.termination_reason, result.updates, result.policy_version) == (Train.Result.LIMIT, 0, 1)
    assert "after update 0 only" in result.message and "stop_precision is 1" in result.message, result.message


@pytest.mark.slow
def test_device_rollouts_refuse_a_reward_that_is_not_theirs_and_name_it(
    graph: Graph, probe: Probe, imagined: dict[str, dict[str, Any]]
) -> None:
    imagined["reward_evaluator"]["reward"] = "rule"
    start_composed(graph, imagined, "--device-rollouts")
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=1)))
    assert result.termination_reason == Train.Result.FAILED
    assert "--device-rollouts has the endogenous reward, and the reward evaluator's is rule" in result.message


def test_device_rollouts_need_environment_and_learner() -> None:
    with pytest.raises(ValueError, match="needs environment and learner in one process; got policy learner"):
        make_nodes(["policy", "learner"], device_rollouts=True)
