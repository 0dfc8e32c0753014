"""Files that a peer names over DDS: what lies outside is refused without a word of what is there, nothing hangs, and
nothing is replaced or removed but what the node itself wrote."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from graph import toy
from graph.harness import Graph, Probe, wait_until

from wm_msgs.action import Evaluate, Replay, Train
from wm_msgs.msg import ErrorCode, PolicyVersion
from wm_msgs.srv import LoadPolicy, SaveCheckpoint, StartRecording, StopRecording
from wm_nodes.policy_rl.training_run import POLICY_FILES
from wm_nodes.training.weights import save_weights

pytestmark = [pytest.mark.graph, pytest.mark.alone]
OUTSIDE = "lies outside of the run folder and of allowed_dirs; copy it into the run folder, or start the graph with"
NO_NAME = "is no name of a file; give a path, absolute or relative to the run folder, without ~"
NODES = ("/wm/policy", "/wm/learner", "/wm/recorder", "/wm/player", "/wm/evaluation")


def contents(folder: Path) -> dict[str, bytes]:
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix != ".log")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths if "ros_log" not in path.parts}


def start_all(graph: Graph, probe: Probe) -> None:
    save_weights(toy.make_policy(graph.config), graph.folder / "start.safetensors")
    graph.start_policy()
    graph.start_learner()
    graph.start("recorder", record_at_start=False, min_free_mib=16)
    graph.start("player", play_at_start=False)
    graph.start("evaluation", policy__factory="toy:make_policy")
    wait_until("the nodes", lambda: all(probe.value(node, "state") == "active" for node in NODES))


def by_service(probe: Probe, kind: type[Any], name: str, field: str) -> Callable[[str], tuple[int, str]]:
    def ask(uri: str) -> tuple[int, str]:
        answer = probe.call(kind, name, kind.Request(**{field: uri}))
        return answer.error_code, answer.message

    return ask


def by_goal(probe: Probe, kind: type[Any], name: str, make: Callable[[str], Any]) -> Callable[[str], tuple[int, str]]:
    def ask(uri: str) -> tuple[int, str]:
        result = probe.finish(probe.send(probe.action(kind, name), make(uri)))
        assert result.termination_reason == kind.Result.FAILED
        return ErrorCode.OUT_OF_RANGE if OUTSIDE in result.message else ErrorCode.IO_ERROR, result.message

    return ask


def test_whoever_is_asked_refuses_a_file_outside_in_the_same_words_whether_it_exists_and_counts_it(
    graph: Graph, probe: Probe
) -> None:
    start_all(graph, probe)
    (graph.folder / "out").symlink_to("/etc")
    before = contents(graph.folder)
    asks = {
        "policy/load": ("/wm/policy", "refused_loads", by_service(probe, LoadPolicy, "policy/load", "uri")),
        "learner/save": ("/wm/learner", "refused_saves", by_service(probe, SaveCheckpoint, "learner/save", "uri")),
        "recorder/start": (
            "/wm/recorder", "refused_starts", by_service(probe, StartRecording, "recorder/start", "bag_uri")
        ),
        "train": ("/wm/learner", "failed_goals", by_goal(
            probe, Train, "train", lambda uri: Train.Goal(updates=1, from_bags=True, bag_uris=[uri])
        )),
        "replay": ("/wm/player", "failed_goals", by_goal(
            probe, Replay, "replay", lambda uri: Replay.Goal(bag_uri=uri, rate=1.0)
        )),
        "evaluate": ("/wm/evaluation", "failed_goals", by_goal(
            probe, Evaluate, "evaluate", lambda uri: Evaluate.Goal(policy_uri=uri, episodes=1)
        )),
    }
    for name, (node, counter, ask) in asks.items():
        asked = 0
        for there, missing in (("/etc/passwd", "/etc/absent"), ("../../", "../absent"), ("out/passwd", "out/no")):
            said = []
            for uri in (there, missing):
                code, message = ask(uri)
                asked += 1
                assert code == ErrorCode.OUT_OF_RANGE and OUTSIDE in message, (name, uri, message)
                assert len(message.splitlines()) == 1
                said.append(message.replace(repr(uri), ""))
            assert said[0] == said[1], name
        for uri in ("~/x", "x" * 300, "a\nb"):
            _, message = ask(uri)
            asked += 1
            assert NO_NAME in message and len(message.splitlines()) == 1 and len(message) < 400, (name, message)
        wait_until(f"the count of {name}", lambda: int(probe.value(node, counter) or 0) >= asked)  # noqa: B023
        status = probe.diagnostics[node].message
        assert NO_NAME in status, (name, status)
    assert contents(graph.folder) == before
    assert all("Traceback" not in graph.log(node) for node in graph.processes)


def test_pipes_devices_and_folders_are_refused_at_once_and_the_node_goes_on(graph: Graph, probe: Probe) -> None:
    start_all(graph, probe)
    os.mkfifo(graph.folder / "pipe")
    (graph.folder / "zero").symlink_to("/dev/zero")
    bag = graph.folder / "bag"
    bag.mkdir()
    os.mkfifo(bag / "metadata.yaml")
    load = by_service(probe, LoadPolicy, "policy/load", "uri")
    for uri, words in (("pipe", "is no regular file; name a file that holds weights"), ("policies", "no regular file"),
                       ("zero", OUTSIDE), ("absent", "No such file or directory; name a file that is in the run")):
        code, message = load(uri)
        assert words in message, message
        assert code == (ErrorCode.OUT_OF_RANGE if uri == "zero" else ErrorCode.IO_ERROR)
    assert load("start.safetensors") == (ErrorCode.OK, "")
    evaluate = by_goal(probe, Evaluate, "evaluate", lambda uri: Evaluate.Goal(policy_uri=uri, episodes=1))
    assert "is no regular file" in evaluate("pipe")[1]
    for kind, name, make in (
        (Train, "train", lambda uri: Train.Goal(updates=1, from_bags=True, bag_uris=[uri])),
        (Replay, "replay", lambda uri: Replay.Goal(bag_uri=uri, rate=1.0)),
    ):
        assert "metadata.yaml' is no regular file" in by_goal(probe, kind, name, make)("bag")[1]
    publisher = probe.publisher("policy/version")
    wait_until("matching", lambda: publisher.get_subscription_count() >= 2)
    for uri, words in (("pipe", "'pipe' is no regular file"), ("/etc/passwd", f"'/etc/passwd' {OUTSIDE}")):
        publisher.publish(PolicyVersion(version=7, sha256="0" * 64, uri=uri))
        wait_until("the refusal", lambda: words in probe.diagnostics["/wm/policy"].message)  # noqa: B023
    assert load("start.safetensors") == (ErrorCode.OK, "")


def test_saving_and_recording_replace_and_remove_nothing_that_is_there(graph: Graph, probe: Probe) -> None:
    start_all(graph, probe)
    save = by_service(probe, SaveCheckpoint, "learner/save", "uri")
    record = by_service(probe, StartRecording, "recorder/start", "bag_uri")
    for number in (5, 6):
        (graph.folder / POLICY_FILES.uri(number)).write_bytes(b"a version")
    (graph.folder / "mine.json").write_text("{}")
    before = contents(graph.folder)
    for uri, words in (("policies/policy.json", "belongs to the run itself; take checkpoints/NAME"),
                       ("config.yaml", "belongs to the run itself"), ("mine.json", "is no checkpoint of a learner"),
                       ("mine", "must end in .json"), ("bags/x.json", "belongs to the run itself")):
        code, message = save(uri)
        assert code == ErrorCode.IO_ERROR and words in message, message
    for uri, words in (("policies/policy_000027.safetensors", "belongs to the run itself; take bags/NAME"),
                       ("config.yaml", "belongs to the run itself"), ("mine.json", "exists already")):
        code, message = record(uri)
        assert code in (ErrorCode.IO_ERROR, ErrorCode.BUSY) and words in message, message
    assert contents(graph.folder) == before
    for uri in ("", "checkpoints/mine.json", "more/mine.json", "more/mine.json"):
        assert save(uri) == (ErrorCode.OK, "")
    after = contents(graph.folder)
    own = {"checkpoints/learner.json", "checkpoints/learner_000000.learner", "checkpoints/learner_000000.safetensors"}
    assert own <= set(before) <= set(after)
    assert all(after[name] == before[name] for name in set(before) - own)
    assert record("bags/mine") == (ErrorCode.OK, "")
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    assert stopped.bag_uri == str(graph.folder / "bags" / "mine")
