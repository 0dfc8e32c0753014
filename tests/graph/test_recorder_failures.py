"""The recorder where the disk refuses something, and across a pause: what it says is what is in the folder."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from graph.harness import Graph, Probe, wait_until
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from recording_graph import NUM_ENVS
from recording_samples import make_spec
from std_srvs.srv import Trigger

from wm_msgs.msg import ErrorCode, PolicyVersion
from wm_msgs.srv import StartRecording, StopRecording
from wm_nodes.recording import Bag, recover, topics
from wm_nodes.recording import messages as m

pytestmark = pytest.mark.graph


@pytest.fixture
def recorder(graph: Graph, probe: Probe) -> Iterator[Graph]:
    """A recorder that writes bags/live, in which the spec is."""
    process = graph.start("recorder", bag_uri="bags/live", min_free_mib=16, topics=["env/spec", "policy/version"])
    spec = probe.publisher("env/spec")
    spec.publish(m.serialize(m.spec_message(make_spec(num_envs=NUM_ENVS), 0, 7)))
    wait_until("the spec", lambda: (probe.value("/wm/recorder", "messages") or "0") != "0")
    yield graph
    assert process.poll() is None


def trigger(probe: Probe, name: str) -> Any:
    return probe.call(Trigger, f"recorder/{name}", Trigger.Request())


def stop(probe: Probe) -> Any:
    return probe.call(StopRecording, "recorder/stop", StopRecording.Request())


def fill_the_disk(probe: Probe, least_mib: int = 10**9) -> None:
    """Less is free than the recorder asks for."""
    value = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=least_mib)
    request = SetParameters.Request(parameters=[Parameter(name="min_free_mib", value=value)])
    (result,) = probe.call(SetParameters, "recorder/set_parameters", request).results
    assert result.successful, result.reason


def error(probe: Probe) -> str:
    status = probe.diagnostics["/wm/recorder"]
    return status.message if status.level == DiagnosticStatus.ERROR else ""


def test_a_next_file_that_cannot_be_opened_ends_the_recording_and_says_so(recorder: Graph, probe: Probe) -> None:
    partial = recorder.folder / "bags" / "live.partial"
    (partial / "live_1.mcap").touch()
    split = trigger(probe, "split")
    assert not split.success and "File exists" in split.message
    wait_until("the condition", lambda: "recording stopped" in error(probe))
    assert f"the bag is unfinished: {partial}" in error(probe)
    assert stop(probe).error_code == ErrorCode.NOT_ACTIVE
    assert not (recorder.folder / "bags.json").exists()
    assert recover(partial).topics["/wm/env/spec"] == 1
    again = probe.call(StartRecording, "recorder/start", StartRecording.Request(bag_uri="bags/again"))
    assert again.error_code == ErrorCode.OK, again.message
    wait_until("no condition", lambda: not error(probe))


def test_a_disk_with_too_little_left_gets_a_complete_bag(recorder: Graph, probe: Probe) -> None:
    fill_the_disk(probe)
    wait_until("the condition", lambda: "recording stopped" in error(probe))
    bag = recorder.folder / "bags" / "live"
    assert f"bag {bag} is complete up to here" in error(probe)
    assert json.loads((recorder.folder / "bags.json").read_text()) == [{"bag": "bags/live", "messages": 1, "lost": 0}]
    with Bag(bag) as found:
        assert found.count("/wm/env/spec") == 1


@pytest.mark.parametrize("stopped_by", ["the disk", "a service"])
def test_an_index_that_cannot_be_written_is_reported_and_the_node_lives_on(
    recorder: Graph, probe: Probe, stopped_by: str
) -> None:
    (recorder.folder / "bags.json").mkdir()
    if stopped_by == "the disk":
        fill_the_disk(probe)
        wait_until("the condition", lambda: "is complete up to here" in error(probe))
    else:
        stopped = stop(probe)
        assert (stopped.error_code, stopped.messages) == (ErrorCode.OK, 1)
    wait_until("the count", lambda: probe.value("/wm/recorder", "unlisted_bags") == "1")
    assert "bags.json does not list it" in recorder.log("/wm/recorder")
    with Bag(recorder.folder / "bags" / "live") as found:
        assert found.count("/wm/env/spec") == 1


def test_latched_messages_that_came_during_a_pause_are_written_when_it_ends(recorder: Graph, probe: Probe) -> None:
    versions = probe.publisher("policy/version")
    assert trigger(probe, "pause").success
    for count, version in enumerate((4, 5), start=1):
        versions.publish(PolicyVersion(session=9, seq=version, version=version))
        wait_until("it", lambda count=count: probe.value("/wm/recorder", "received policy/version") == str(count))
    assert trigger(probe, "resume").success
    assert trigger(probe, "pause").success and trigger(probe, "resume").success
    stopped = stop(probe)
    assert stopped.messages == 2
    with Bag(stopped.bag_uri) as bag:
        found = [data for _, _, data in bag.messages(["/wm/policy/version"])]
        assert [m.deserialize(data, topics.POLICY_VERSION.msgtype).version for data in found] == [5]
        assert bag.custom["wm.policy_versions"] == "[5]"
