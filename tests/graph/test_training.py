"""The training path end to end: environment, policy, reward_evaluator and learner in four processes over DDS."""

import hashlib
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from deadlines import within
from graph import toy
from graph.harness import Graph, Probe, own_domain, wait_until
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from model_folders import make_model_folder

from wm_msgs.action import Replay, Train
from wm_msgs.msg import ErrorCode
from wm_msgs.srv import GetWeights, InferAction, SaveCheckpoint, StopRecording
from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.reward import RuleReward
from wm_nodes.ros import convert
from wm_nodes.training.weights import unpack_weights

pytestmark = pytest.mark.graph


def train(probe: Probe, **goal: Any) -> Train.Result:
    client = probe.action(Train, "train")
    return probe.finish(probe.send(client, Train.Goal(**goal)))


def weights_in(folder: Path) -> dict[str, str]:
    files = sorted((folder / "policies").glob("*.safetensors"))
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def test_two_updates_run_end_to_end_and_leave_versions_metrics_and_a_checkpoint(graph: Graph, probe: Probe) -> None:
    metrics, rewards = probe.listen("learner/metrics"), probe.listen("reward")
    graph.start_training_nodes()
    result = train(probe, updates=2)
    assert (result.termination_reason, result.policy_version, result.updates) == (Train.Result.FINISHED, 3, 2)
    assert list(weights_in(graph.folder)) == [f"policy_{v:06d}.safetensors" for v in (1, 2, 3)]
    wait_until("metrics", lambda: len(metrics) == 2)
    assert [m.policy_version for m in metrics] == [2, 3]
    assert rewards
    assert all(r.reward_name == "rule" for r in rewards)
    assert (graph.folder / result.checkpoint_uri).is_file()
    again = train(probe, updates=1)
    assert (again.policy_version, again.updates) == (4, 3)


@pytest.mark.slow
def test_a_late_joiner_gets_the_newest_version_inline_and_in_chunks(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    train(probe, updates=1)
    versions = probe.listen("policy/version")
    version = wait_until("the latched version", lambda: versions)[-1]
    assert version.version == 2
    data = bytes(version.inline_data)
    assert hashlib.sha256(data).hexdigest() == version.sha256
    chunks = b""
    while len(chunks) < len(data):
        request = GetWeights.Request(version=0, offset=len(chunks), max_bytes=1000)
        part = probe.call(GetWeights, "learner/get_weights", request)
        assert zlib.crc32(bytes(part.data)) == part.crc32
        chunks += bytes(part.data)
    assert chunks == data
    refused = probe.call(GetWeights, "learner/get_weights", GetWeights.Request(version=99, max_bytes=10))
    assert refused.error_code == ErrorCode.NOT_FOUND
    assert "ask for 0" in refused.message
    wait_until("the count", lambda: probe.value("/wm/learner", "refused_weights") == "1")
    saved = probe.call(SaveCheckpoint, "learner/save", SaveCheckpoint.Request(uri="mine/best.json"))
    assert saved.error_code == ErrorCode.OK
    assert (graph.folder / "mine" / "best.json").is_file()


GROUPS = {"ppo.advantage": "group", "ppo.group_size": 2, "ppo.num_steps": 12, "policy.init_log_std": 0.0}
"""GRPO, with noise so large that some episodes of a group reach and others do not."""


def _run(folder: Path, updates: int, *, forks: bool = True, settings: dict[str, Any] | None = None) -> dict[str, str]:
    with own_domain() as domain:
        graph, probe = Graph(domain, folder, load_config("smoke", settings), forks=forks), Probe(domain)
        try:
            graph.start_training_nodes()
            assert train(probe, updates=updates).termination_reason == Train.Result.FINISHED
        finally:
            probe.close()
            graph.stop()
    return weights_in(folder)


@pytest.mark.slow
def test_two_runs_with_one_seed_give_bit_equal_weights_and_a_resumed_run_the_same(tmp_path: Path) -> None:
    first, second = _run(tmp_path / "a", 3), _run(tmp_path / "b", 3, forks=False)
    assert first == second
    assert len(set(first.values())) == 4
    _run(tmp_path / "c", 1)
    assert _run(tmp_path / "c", 2) == first


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, GROUPS], ids=["gae", "group"])
def test_the_graph_gives_the_weights_of_policy_rl_train_bit_for_bit(settings: dict[str, Any], tmp_path: Path) -> None:
    graph_weights = _run(tmp_path / "graph", 2, settings=settings)
    assert len(graph_weights) == 3
    file = tmp_path / "graph" / "policies" / "policy_000003.safetensors"
    toy.assert_trained_in_one_process(file, updates=2, settings=settings)


@pytest.mark.slow
def test_a_learner_that_is_not_ppo_trains_and_resumes_over_dds_as_in_one_process(tmp_path: Path) -> None:
    for updates in (2, 1):
        _run(tmp_path, updates, settings={"learner.factory": "reinforce:make_reinforce"})
    config = load_config(
        "smoke", {"learner.factory": "graph.reinforce:make_reinforce", "ppo.num_envs": 4, "ppo.updates": 3}
    )
    policy, reward = toy.make_policy(config), RuleReward(config.reward.sparse_weight)
    assert len(list(train_policy(policy, toy.ReachToy(4, seed=0), reward, config))) == 3
    found, _ = unpack_weights((tmp_path / "policies" / "policy_000004.safetensors").read_bytes())
    for name, tensor in policy.state_dict().items():
        assert torch.equal(found[name], tensor), name


def recorded_training(graph: Graph, probe: Probe, updates: int) -> Path:
    """Train live beside a recorder; return the bag."""
    graph.start("recorder")
    graph.start_training_nodes()
    assert train(probe, updates=updates).termination_reason == Train.Result.FINISHED
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stopped.gaps == 0
    return graph.folder / stopped.bag_uri


@pytest.mark.slow
def test_training_from_the_bag_and_from_its_replay_gives_the_weights_of_the_live_training(
    graph: Graph, probe: Probe
) -> None:
    bag = recorded_training(graph, probe, updates=4)
    live = weights_in(graph.folder)
    for source in ("from_bags", "from_replay"):
        with own_domain() as domain:
            offline, other = Graph(domain, graph.folder.parent / source), Probe(domain)
            try:
                offline.start_learner(replay_rate=1e6, allowed_dirs=[str(bag)])
                if source == "from_replay":
                    offline.start("player", play_at_start=False, allowed_dirs=[str(bag)])
                result = train(other, updates=4, bag_uris=[str(bag)], **{source: True})
                assert result.termination_reason == Train.Result.FINISHED, result.message
                assert weights_in(offline.folder) == live
                result = train(other, updates=1, bag_uris=[str(bag)], **{source: True})
                assert result.termination_reason == Train.Result.FAILED
                assert "0 rollouts" in result.message
                assert "version 5" in result.message
            finally:
                other.close()
                offline.stop()


@pytest.mark.slow
def test_a_recording_or_an_environment_of_another_camera_ends_the_goal_with_both_cameras_named(
    graph: Graph, probe: Probe, tmp_path: Path
) -> None:
    bag = recorded_training(graph, probe, updates=1)
    config, model = load_config("smoke"), make_model_folder(tmp_path / "model")
    with own_domain() as domain:
        offline, other = Graph(domain, tmp_path / "offline", config), Probe(domain)
        try:
            offline.start("learner", model_dir=str(model), replay_rate=1e6, allowed_dirs=[str(bag)])
            offline.start("player", play_at_start=False, allowed_dirs=[str(bag)])
            for goal in ({"from_bags": True}, {"from_replay": True}):
                result = train(other, updates=1, bag_uris=[str(bag)], **goal)
                assert result.termination_reason == Train.Result.FAILED
                assert "cameras ('top',)" in result.message and "('side', 'wrist')" in result.message, result.message
            wait_until("the count", lambda: other.value("/wm/learner", "refused_specs") == "1")
            offline.start_environment()
            offline.start_policy()
            offline.start_reward()
            wait_until("its spec", lambda: other.value("/wm/learner", "refused_specs") == "2")
            result = train(other, updates=1)
            assert result.termination_reason == Train.Result.FAILED
            assert "cameras" in result.message and "same config_file" in result.message, result.message
        finally:
            other.close()
            offline.stop()


@pytest.mark.alone
def test_a_replay_that_starts_with_the_learner_trains_and_a_short_one_says_so(graph: Graph, probe: Probe) -> None:
    bag = recorded_training(graph, probe, updates=2)
    live = weights_in(graph.folder)
    with own_domain() as domain:
        config = graph.config.model_copy(update={"ppo": graph.config.ppo.model_copy(update={"updates": 2})})
        offline, other = Graph(domain, graph.folder.parent / "offline", config), Probe(domain)
        try:
            metrics = other.listen("learner/metrics")
            offline.start("player", play_at_start=False, allowed_dirs=[str(bag)])
            offline.start_learner(replay_rate=1e6, replay_at_start=bag)
            wait_until("two updates", lambda: len(metrics) == 2)
            assert weights_in(offline.folder) == live
        finally:
            other.close()
            offline.stop()
        short, other = Graph(domain, graph.folder.parent / "short"), Probe(domain)
        try:
            short.start("player", play_at_start=False, allowed_dirs=[str(bag)])
            short.start_learner(replay_rate=1e6, allowed_dirs=[str(bag)])
            waiting = other.send(other.action(Train, "train"), Train.Goal(updates=1, from_replay=True))
            played = Replay.Goal(bag_uri=str(bag), rate=1e6)
            assert other.finish(other.send(other.action(Replay, "replay"), played)).termination_reason == 0
            result = other.finish(waiting)
            assert (result.termination_reason, result.updates) == (Train.Result.FINISHED, 1)
            result = train(other, updates=3, from_replay=True, bag_uris=[str(bag)])
            assert (result.termination_reason, result.updates) == (Train.Result.EXHAUSTED, 2)
            assert "1 rollouts" in result.message
            assert weights_in(short.folder) == live
            missing = train(other, updates=1, from_replay=True, bag_uris=["no_such_bag"])
            assert missing.termination_reason == Train.Result.FAILED
            assert "no_such_bag" in missing.message
        finally:
            other.close()
            short.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("goal", "text"),
    [
        ({"updates": 0}, "updates is 0"),
        ({"updates": 1, "from_bags": True}, "bag_uris is empty"),
        ({"updates": 1, "from_bags": True, "from_replay": True}, "choose one"),
    ],
)
def test_a_goal_that_asks_for_nothing_is_refused(graph: Graph, probe: Probe, goal: dict[str, Any], text: str) -> None:
    graph.start_learner()
    result = train(probe, **goal)
    assert result.termination_reason == Train.Result.FAILED
    assert text in result.message


@pytest.mark.slow
@pytest.mark.kills  # torchrun answers SIGINT with a non-zero code
def test_two_ranks_under_torchrun_give_the_update_of_one(graph: Graph, probe: Probe) -> None:
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", str(29500 + graph.domain))
    graph.start_environment()
    graph.start_policy()
    graph.start_reward()
    graph.start_learner(launcher=torchrun)
    assert train(probe, updates=2).termination_reason == Train.Result.FINISHED
    file = graph.folder / "policies" / "policy_000003.safetensors"
    toy.assert_trained_in_one_process(file, updates=2, tolerance=1e-5)


@pytest.mark.alone
def test_cancel_ends_training_within_a_second_and_the_next_goal_works(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    client = probe.action(Train, "train")
    updates: list[Any] = []
    handle = probe.send(client, Train.Goal(updates=100000), updates.append)
    wait_until("the first update", lambda: updates)
    began = time.monotonic()
    assert probe.cancel(handle).termination_reason == Train.Result.CANCELED
    assert time.monotonic() - began < within(1.0)
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED


@pytest.mark.slow
def test_a_deactivated_learner_ends_its_goal_with_that_reason(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    updates: list[Any] = []
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    wait_until("the first update", lambda: updates)
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert probe.call(ChangeState, "learner/change_state", request).success
    assert probe.finish(handle).termination_reason == Train.Result.DEACTIVATED


def test_limits_and_a_second_goal(graph: Graph, probe: Probe) -> None:
    graph.start_training_nodes()
    result = train(probe, updates=1000, max_samples=1)
    assert (result.termination_reason, result.updates) == (Train.Result.LIMIT, 1)
    client = probe.action(Train, "train")
    running = probe.send(client, Train.Goal(updates=100000))
    refused = probe.finish(probe.send(client, Train.Goal(updates=1)))
    assert refused.termination_reason == Train.Result.REFUSED
    assert refused.message == "refused: another goal is running; cancel it or wait"
    assert probe.cancel(running).termination_reason == Train.Result.CANCELED


def test_an_image_of_another_size_is_refused_by_infer_with_value_and_remedy(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    graph.start_policy()
    specs = probe.listen("env/spec")
    spec = convert.spec_from_msg(wait_until("the spec", lambda: specs)[0])
    request = InferAction.Request(tile=convert.tile_msg(spec), deterministic=True)
    request.state = convert.to_field(np.zeros((4, 3), np.float32))
    images = np.zeros((4, spec.height, spec.width, 3), np.uint8)
    request.observation = convert.mosaic_msg(images, 0, spec)

    def infer() -> Any:
        response = probe.call(InferAction, "policy/infer", request)
        return response if response.error_code != ErrorCode.NOT_ACTIVE else None

    assert wait_until("an answer", infer).action.num_envs == 4
    request.observation.encoding = "bgr8"
    refused = infer()
    assert refused.error_code == ErrorCode.BAD_SHAPE
    assert "'bgr8'" in refused.message
    request.observation.encoding = "rgb8"
    request.observation.step = 1
    assert "step is 1" in infer().message
