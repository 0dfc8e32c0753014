"""A killed recorder, player, simulator and evaluation node can be started again; two nodes of one name cannot."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import yaml
from deadlines import within
from graph import toy
from graph.harness import Graph, Probe, wait_until
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from recording_graph import NUM_ENVS, write
from recording_graph import Graph as Recorded
from recording_samples import make_spec

from wm_msgs.action import Evaluate, Replay, Train
from wm_nodes.launching.graph_client import GraphClient
from wm_nodes.launching.scenarios import ENVIRONMENT_TOPICS, GRAPH_TOPICS
from wm_nodes.recording import BagReport, read_episodes, read_rollouts, recover
from wm_nodes.ros.wire import PeerLost
from wm_nodes.training.weights import save_weights

pytestmark = [pytest.mark.graph, pytest.mark.alone]

RECORDED = [*GRAPH_TOPICS, *(f"sim/{name}" for name in ENVIRONMENT_TOPICS)]


def start_recorder(graph: Graph) -> Any:
    topics = "[" + ",".join(RECORDED) + "]"
    return graph.start("recorder", bag_uri="bags/run", topics=topics, min_free_mib=16)


def active(probe: Probe, *names: str) -> None:
    wait_until(f"active {names}", lambda: all(probe.value(name, "state") == "active" for name in names))


def slow_replay() -> SetParameters.Request:
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.01)
    return SetParameters.Request(parameters=[Parameter(name="replay_rate", value=value)])


def evaluate(probe: Probe, episodes: int, timeout_s: float = 60.0) -> Any:
    goal = Evaluate.Goal(policy_uri="start.safetensors", episodes=episodes, seed=1000, deterministic=True)
    return probe.finish(probe.send(probe.action(Evaluate, "evaluate"), goal), timeout_s)


@pytest.mark.kills
def test_a_killed_recorder_records_again_beside_what_it_left(graph: Graph, probe: Probe) -> None:
    book = probe.links()
    start_recorder(graph)
    graph.start_training_nodes()
    client = probe.action(Train, "train")
    assert probe.finish(probe.send(client, Train.Goal(updates=1))).termination_reason == Train.Result.FINISHED
    time.sleep(2.0)  # a kill may cost the recorder's last second
    graph.kill("/wm/recorder")
    probe.wait_for_loss("/wm/learner", "/wm/recorder")
    probe.diagnostics.pop("/wm/recorder", None)
    graph.restart(lambda: start_recorder(graph), book, "/wm/recorder", "/wm/learner", "/wm/policy", "/wm/environment")
    active(probe, "/wm/recorder")
    assert (probe.value("/wm/recorder", "bag") or "").endswith("bags/run_1")
    assert probe.finish(probe.send(client, Train.Goal(updates=1))).termination_reason == Train.Result.FINISHED
    assert graph.stop()["/wm/recorder"] == 0
    assert len(list(read_rollouts(graph.folder / "bags" / "run_1"))) == 1
    assert len(list(read_rollouts(recover(graph.folder / "bags" / "run.partial").bag, report=BagReport()))) == 1


@pytest.mark.kills
def test_evaluation_episodes_are_recorded_and_a_killed_simulator_or_evaluation_node_comes_back(
    graph: Graph, probe: Probe
) -> None:
    save_weights(toy.make_policy(graph.config), graph.folder / "start.safetensors")
    start_recorder(graph)
    nodes: dict[str, Any] = {
        "/wm/sim/environment": lambda: graph.start_environment(namespace="/wm/sim", num_envs=3),
        "/wm/evaluation": lambda: graph.start("evaluation", policy__factory="toy:make_policy"),
    }
    for start in nodes.values():
        start()
    active(probe, "/wm/recorder", *nodes)
    steps = probe.listen("env/transition", at="sim/env/transition")
    first = evaluate(probe, 7)
    assert first.termination_reason == Evaluate.Result.FINISHED, first.message
    assert first.mean_return == pytest.approx(graph.config.reward.sparse_weight * first.success_rate)
    for name, start in nodes.items():
        goal = Evaluate.Goal(policy_uri="start.safetensors", episodes=1_000_000, seed=1000, deterministic=True)
        running, count = probe.send(probe.action(Evaluate, "evaluate"), goal), len(steps)
        wait_until("its steps", lambda c=count: len(steps) > c + 5)
        graph.kill(name)
        if name == "/wm/sim/environment":
            probe.wait_for_loss("/wm/evaluation", "/wm/sim/environment")
            lost = probe.finish(running, within(8.0))  # before its step_timeout_s: it hears /wm/sim's heartbeats
            assert lost.termination_reason == Evaluate.Result.PEER_LOST and "environment" in lost.message
            lost = evaluate(probe, 1)
            assert lost.termination_reason == Evaluate.Result.PEER_LOST and "sim/env/get_spec" in lost.message
        else:
            probe.wait_for_loss("/wm/recorder", "/wm/evaluation")
        probe.diagnostics.pop(name, None)
        start()
        active(probe, name)
        again = evaluate(probe, 7)
        assert again.termination_reason == Evaluate.Result.FINISHED, again.message
        assert list(again.success) == list(first.success) and list(again.length) == list(first.length)
    assert graph.stop()["/wm/recorder"] == 0
    found = list(read_episodes(graph.folder / "bags" / "run", namespace="/wm/sim", report=BagReport()))
    assert len(found) >= 7
    assert [episode.seed for episode in sorted(found[:7], key=lambda e: e.seed)] == list(range(1000, 1007))
    assert {len(e.actions) for e in found[:7]} == set(map(int, first.length))


@pytest.mark.kills
def test_a_killed_player_plays_again(graph: Graph, probe: Probe) -> None:
    recorded = Recorded(make_spec(num_envs=NUM_ENVS))
    recorded.rollout(1, 20)
    write(graph.folder / "bag", recorded)
    graph.start_environment()
    graph.start("player")
    client = probe.action(Replay, "replay")
    active(probe, "/wm/player", "/wm/environment")
    time.sleep(1.0)  # two heartbeats
    probe.send(client, Replay.Goal(bag_uri="bag", rate=0.01))
    graph.kill("/wm/player")
    probe.wait_for_loss("/wm/environment", "/wm/player")
    graph.start("player")
    probe.diagnostics.pop("/wm/player", None)
    active(probe, "/wm/player")
    result = probe.finish(probe.send(client, Replay.Goal(bag_uri="bag", rate=1000.0)))
    assert result.termination_reason == Replay.Result.FINISHED, result.message


@pytest.mark.kills
def test_a_training_from_a_player_that_is_killed_ends_with_its_name(graph: Graph, probe: Probe) -> None:
    recorded = Recorded(make_spec(num_envs=NUM_ENVS))
    recorded.rollout(1, 20)
    write(graph.folder / "bag", recorded)
    graph.start_learner()
    graph.start("player", start_paused=False)
    active(probe, "/wm/player", "/wm/learner")
    time.sleep(1.0)  # two heartbeats
    graph_goal = Train.Goal(updates=1, from_replay=True, bag_uris=["bag"])
    probe.call(SetParameters, "learner/set_parameters", slow_replay())
    handle = probe.send(probe.action(Train, "train"), graph_goal)
    time.sleep(2.0)
    graph.kill("/wm/player")
    result = probe.finish(handle, within(15.0))
    assert result.termination_reason == Train.Result.PEER_LOST and "/wm/player is silent" in result.message


@pytest.mark.kills
def test_a_client_of_a_killed_learner_gets_an_error(
    graph: Graph, probe: Probe, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph.start_training_nodes()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    updates = list[Any]()
    with GraphClient() as client, ThreadPoolExecutor(1) as pool:
        training = pool.submit(client.train, 100000, updates.append)
        wait_until("an update", lambda: updates)
        graph.kill("/wm/learner")
        with pytest.raises(PeerLost, match=r"/wm/learner (is silent|was stopped or restarted)"):
            training.result(within(15.0))


@pytest.mark.parametrize("learner", [{}, {"learner__factory": "toy:make_stuck_learner"}])
def test_a_learner_that_is_told_to_end_answers_its_goals_client_also_where_it_is_stuck(
    graph: Graph, probe: Probe, learner: dict[str, str]
) -> None:
    graph.start_training_nodes(**learner)
    updates = list[Any]()
    handle = probe.send(probe.action(Train, "train"), Train.Goal(updates=100000), updates.append)
    wait_until("work", lambda: updates or "stuck" in graph.log("/wm/learner"))
    graph.processes["/wm/learner"].terminate()
    result = probe.finish(handle, within(6.0))
    assert (result.termination_reason, result.message) == (Train.Result.DEACTIVATED, "shut down")


@pytest.mark.kills
def test_a_second_node_of_one_name_ends_with_one_line_and_the_first_goes_on(graph: Graph, probe: Probe) -> None:
    graph.start_environment()
    active(probe, "/wm/environment")
    first = graph.processes["/wm/environment"]
    second = graph.start_environment()
    assert second.wait(60) == 1
    log = graph.log("/wm/environment")
    assert f"another /wm/environment is there already (process {first.pid} on" in log and "Traceback" not in log
    assert first.poll() is None
    graph.processes["first"] = first


def test_a_directly_started_node_stays_on_this_host(graph: Graph) -> None:
    code = (
        "import os\n"
        "from wm_nodes.ros.lifecycle import ManagedNode\n"
        "from wm_nodes.ros.spin import run_node\n"
        "class Probe(ManagedNode):\n"
        "    def activate(self):\n"
        "        print(os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'], os.environ.get('FASTRTPS_DEFAULT_PROFILES_FILE'))\n"
        "        self.failed = True\n"
        "run_node(lambda: Probe('alone'))\n"
    )
    hidden = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    env = {name: value for name, value in graph.environment().items() if name not in hidden}
    for given, words in (({}, ["LOCALHOST"]), ({hidden[0]: "OFF", hidden[1]: ""}, ["OFF", "None"])):
        done = subprocess.run([sys.executable, "-c", code], env={**env, **given}, capture_output=True, text=True)
        assert done.stdout.split()[: len(words)] == words, done.stderr


def test_a_parameter_file_wins_over_values_on_the_command_line(graph: Graph) -> None:
    file = graph.folder / "more.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"peer_timeout_s": 9.0}}}))
    command = [
        sys.executable, "-c",
        "from wm_nodes.ros.lifecycle import ManagedNode\nfrom wm_nodes.ros.spin import run_node\n"
        "def show(node): print(node.param('peer_timeout_s')); node.failed = True\n"
        "class N(ManagedNode):\n    activate = show\nrun_node(lambda: N('n'))\n",
        "--ros-args", "-r", "__ns:=/wm", "-r", "__node:=n", "-p", "peer_timeout_s:=5.0", "--params-file", str(file),
    ]
    done = subprocess.run(command, env={**os.environ, **graph.environment()}, capture_output=True, text=True)
    assert done.stdout.strip() == "9.0", done.stderr
