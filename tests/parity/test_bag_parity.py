"""Our bags against stock tools: rosbags' readers, rosidl's hashes and texts, rclpy's serialisation, the QoS table."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from recording_samples import make_episode, make_spec
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from wm_nodes.recording import EpisodeBagWriter, topics, typestore
from wm_nodes.recording import messages as m

PREFIXES = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]


def interface_json(msgtype: str) -> dict[str, Any]:
    package, kind, name = msgtype.split("/")
    for prefix in PREFIXES:
        path = prefix / "share" / package / kind / f"{name}.json"
        if path.is_file():
            content: dict[str, Any] = json.loads(path.read_text())
            return content
    pytest.skip(f"no {msgtype}.json on AMENT_PREFIX_PATH; source ros2_ws/install/setup.bash")


def bag_of_three(path: Path) -> Path:
    spec = make_spec()
    with EpisodeBagWriter(path, spec, run_id="parity", split_bytes=6000) as writer:
        for index in range(3):
            writer.write(make_episode(spec, index))
    return path


STANDARD = (
    "sensor_msgs/msg/Image",
    "diagnostic_msgs/msg/DiagnosticArray",
    "std_msgs/msg/Bool",
    "rosgraph_msgs/msg/Clock",
)


@pytest.mark.parametrize("msgtype", [*sorted(typestore.message_texts()), *STANDARD])
def test_type_hash_equals_rosidls(msgtype: str) -> None:
    hashes = {entry["type_name"]: entry["hash_string"] for entry in interface_json(msgtype)["type_hashes"]}
    assert typestore.type_hash(msgtype) == hashes[msgtype]


def test_the_embedded_definition_is_our_file_with_its_comments() -> None:
    text = typestore.message_definition("wm_msgs/msg/TransitionBatch")
    assert "# [N, A] as executed, normalised to [-1, 1]" in text
    nested = typestore.message_definition("wm_msgs/msg/EnvSpec")
    assert "MSG: wm_msgs/TileLayout\n# How N images are tiled" in nested


@pytest.mark.parametrize("topic", topics.ALL_TOPICS, ids=lambda topic: topic.name)
def test_recorded_qos_and_type_are_those_of_the_graph(topic: topics.RecordedTopic) -> None:
    qos = pytest.importorskip("wm_nodes.ros.qos")
    row = qos.topic(topic.name)
    live = row.qos
    package, kind, name = topic.msgtype.split("/")
    assert (row.type.__module__.split(".")[:2], row.type.__name__) == ([package, kind], name)
    assert live.history.name == topic.qos.history.name
    assert live.depth == topic.qos.depth
    assert live.reliability.name == topic.qos.reliability.name
    assert live.durability.name == topic.qos.durability.name
    assert live.liveliness_lease_duration.nanoseconds == topic.qos.liveliness_lease_duration.sec * 1_000_000_000


def test_rclpy_reads_our_bytes_and_we_read_its(tmp_path: Path) -> None:
    """Compared after decoding: rclpy leaves the padding between fields undefined."""
    serialization = pytest.importorskip("rclpy.serialization")
    qos = pytest.importorskip("wm_nodes.ros.qos")
    types = {f"/wm/{name}": row.type for name, row in qos.TOPICS.items()}
    with Reader(bag_of_three(tmp_path / "bag")) as reader:
        seen = set()
        for connection, _, data in reader.messages():
            message = serialization.deserialize_message(bytes(data), types[connection.topic])
            again = serialization.serialize_message(message)
            ours = m.deserialize(data, connection.msgtype)
            theirs = m.deserialize(again, connection.msgtype)
            assert m.serialize(ours) == m.serialize(theirs)
            seen.add(connection.topic)
    assert len(seen) == 5


def test_stock_rosbags_opens_the_bag_with_the_definitions_inside_it(tmp_path: Path) -> None:
    path = bag_of_three(tmp_path / "bag")
    episode = make_episode(make_spec(), 0)
    with AnyReader([path]) as reader:
        assert {c.topic for c in reader.connections} == {
            "/wm/env/spec", "/wm/env/image", "/wm/env/transition", "/wm/reward", "/wm/episode",
        }
        assert reader.message_count == sum(connection.msgcount for connection in reader.connections)
        images = [c for c in reader.connections if c.topic == "/wm/env/image"]
        _, _, data = next(reader.messages(images))
        image = reader.deserialize(data, images[0].msgtype)
        np.testing.assert_array_equal(image.data.reshape(8, 12, 3), episode.images[0])
        times = [time_ns for _, time_ns, _ in reader.messages()]
        assert len(times) == reader.message_count
    assert times == sorted(times)


def test_each_file_of_a_split_bag_is_a_complete_indexed_mcap(tmp_path: Path) -> None:
    path = bag_of_three(tmp_path / "bag")
    files = sorted(path.glob("*.mcap"))
    assert len(files) == 3
    for file in files:
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            messages = list(reader.iter_messages())
            assert len(messages) == summary.statistics.message_count > 0
            assert reader.get_header().profile == "ros2"
            assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
            names = [metadata.name for metadata in reader.iter_metadata()]
            assert names == ["wm.start", "wm.episode", "rosbag2"]
            for channel in summary.channels.values():
                assert set(channel.metadata) == {"offered_qos_profiles", "topic_type_hash"}


@pytest.mark.skipif(shutil.which("ros2") is None, reason="ROS 2's command line tools come from apt, not from pip")
def test_ros2_bag_info_lists_every_topic_with_its_number_of_messages(tmp_path: Path) -> None:
    path = bag_of_three(tmp_path / "bag")
    shown = subprocess.run(["ros2", "bag", "info", str(path)], capture_output=True, text=True, timeout=60, check=True)
    with Reader(path) as reader:
        for connection in reader.connections:
            pattern = rf"Topic: {connection.topic} \| Type: {connection.msgtype} \| Count: {connection.msgcount} "
            assert re.search(pattern, shown.stdout), shown.stdout
