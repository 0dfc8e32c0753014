"""Bags that others wrote: rosbags' own writers, re-indexed metadata, other clocks, other types."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from recording_graph import NUM_ENVS, Graph, assert_same_rollout, write
from recording_samples import add, assert_same_episode, foreign_copy, make_episode, make_spec
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from wm_nodes.recording import Bag, BagError, BagReport, EpisodeBagWriter, RawBagWriter, read_episodes, recover
from wm_nodes.recording import messages as m
from wm_nodes.recording.bag import is_bag
from wm_nodes.recording.rollouts import read_rollouts
from wm_nodes.recording.typestore import message_definition

FORMATS = [
    (plugin, mode) for plugin in StoragePlugin for mode in CompressionMode
    if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)
]
GRIP = "own_msgs/msg/Grip"


def own_bag(path: Path, count: int = 4) -> Path:
    spec = make_spec()
    with EpisodeBagWriter(path, spec, run_id="test") as writer:
        for index in range(count):
            writer.write(make_episode(spec, index))
    return path


def timed_copy(source: Path, path: Path, time_of: Callable[[int, int], int]) -> Path:
    """The bag with other receive times: time_of(number in the file, its time)."""
    with Bag(source) as bag, RawBagWriter(path, chunk_bytes=4096) as writer:
        for connection in bag.connections:
            writer.copy_topic(connection)
        for number, (topic, time_ns, data) in enumerate(bag.messages()):
            writer.write(topic, data, time_of(number, time_ns))
    return path


def assert_same_episodes(path: Path, source: Path) -> None:
    for ours, theirs in zip(read_episodes(path), read_episodes(source), strict=True):
        assert_same_episode(replace(ours, extra={}), replace(theirs, extra={}))


@pytest.mark.parametrize(("plugin", "mode"), FORMATS)
def test_a_bag_of_rosbags_writer_reads_and_recovers_like_ours(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    own = own_bag(tmp_path / "own")
    path = foreign_copy(own, tmp_path / "foreign", plugin, mode)
    assert is_bag(path) and is_bag(own) and not is_bag(tmp_path)
    assert_same_episodes(path, own)
    report = recover(path)
    assert not report.damaged
    assert_same_episodes(report.bag, own)
    (path / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="wm recover-bag"):
        Bag(path)
    assert is_bag(path)
    assert_same_episodes(recover(path, output=tmp_path / "again").bag, own)


def no_storage(information: dict[str, Any]) -> None:
    information["storage_identifier"] = ""


def no_qos(information: dict[str, Any]) -> None:
    for topic in information["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = []


def no_counts(information: dict[str, Any]) -> None:
    information["message_count"] = 0
    for topic in information["topics_with_message_count"]:
        topic["message_count"] = 0


def later_version(information: dict[str, Any]) -> None:
    information["version"] = 10


def change_metadata(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = yaml.safe_load((path / "metadata.yaml").read_text())
    change(content["rosbag2_bagfile_information"])
    (path / "metadata.yaml").write_text(yaml.safe_dump(content))


@pytest.mark.parametrize("change", [no_storage, no_qos, no_counts, later_version])
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_what_metadata_yaml_leaves_out_is_read_from_the_files(
    tmp_path: Path, plugin: StoragePlugin, change: Callable[[dict[str, Any]], None]
) -> None:
    graph = Graph(make_spec(num_envs=NUM_ENVS))
    graph.rollout(1, 6)
    path = foreign_copy(write(tmp_path / "own", graph), tmp_path / "bag", plugin)
    change_metadata(path, change)
    (found,) = read_rollouts(path)
    assert_same_rollout(found, graph.rollouts[0])
    with Bag(path) as bag:
        assert sum(c.msgcount for c in bag.connections) == len(list(bag.messages())) == len(graph.published)
        assert all(c.ext.offered_qos_profiles for c in bag.connections)


def test_a_later_version_without_what_is_needed_is_not_called_damaged(tmp_path: Path) -> None:
    def change(information: dict[str, Any]) -> None:
        information["version"] = 11
        information["files_of_the_bag"] = information.pop("relative_file_paths")

    path = own_bag(tmp_path / "bag")
    change_metadata(path, change)
    with pytest.raises(BagError, match=r"metadata\.yaml has version 11, and 9 is the newest known here") as caught:
        Bag(path)
    assert "damaged" not in str(caught.value)
    assert len(list(read_episodes(path / "bag_0.mcap"))) == 4


SHIFTS: dict[str, Callable[[int, int], int]] = {
    "back": lambda number, time_ns: time_ns - 3 * 10**9 * (number > 50),
    "back by hours, twice": lambda number, time_ns: time_ns - 3600 * 10**9 * (number // 40),
    "back by less than a step": lambda number, time_ns: time_ns - 5 * 10**7 * (number > 51),
    "forward": lambda number, time_ns: time_ns + 10**18 * (number > 50),
    "forward and back": lambda number, time_ns: time_ns + 10**10 * (30 < number < 60),
    "from before it was set": lambda number, time_ns: time_ns if number else 0,
}


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_recorder_whose_clock_was_set_lost_nothing(tmp_path: Path, plugin: StoragePlugin, shift: str) -> None:
    own = own_bag(tmp_path / "own", 6)
    path = foreign_copy(timed_copy(own, tmp_path / "set", SHIFTS[shift]), tmp_path / "bag", plugin)
    report = BagReport()
    found = list(read_episodes(path, report=report))
    for ours, theirs in zip(found, read_episodes(own), strict=True):
        assert_same_episode(replace(ours, extra={}), replace(theirs, extra={}))
    assert report == BagReport(yielded=6)


def test_a_file_that_is_not_in_the_order_of_time_is_read_in_it_where_sequence_numbers_agree(tmp_path: Path) -> None:
    own = own_bag(tmp_path / "own")
    with Bag(own) as bag:
        connections, messages = list(bag.connections), list(bag.messages())
    for name, number_of in (("by topic", lambda i: messages[i][0]), ("shuffled", lambda i: i * 37 % len(messages))):
        with RawBagWriter(tmp_path / name, chunk_bytes=4096) as writer:
            for connection in connections:
                writer.copy_topic(connection)
            for number in sorted(range(len(messages)), key=number_of):
                topic, time_ns, data = messages[number]
                writer.write(topic, data, time_ns)
        assert_same_episodes(tmp_path / name, own)


@pytest.mark.slow
@pytest.mark.parametrize(("plugin", "mode"), FORMATS)
def test_a_bag_with_a_damaged_byte_is_a_bag_error_or_gives_a_part_of_its_messages(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    path = foreign_copy(own_bag(tmp_path / "own"), tmp_path / "bag", plugin, mode)
    with Bag(path) as bag:
        whole = list(bag.messages())
    (file,) = (each for each in path.iterdir() if each.suffix != ".yaml")
    content, refused, lost = file.read_bytes(), list[str](), list[str]()
    for at in range(10, len(content), len(content) // 15):
        file.write_bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
        for damaged in (None, list[str]()):
            try:
                with Bag(path) as bag:
                    found = list(bag.messages(damaged=damaged))
                assert len(found) <= len(whole)
            except BagError as error:
                refused.append(str(error))
        try:
            assert recover(path, output=tmp_path / f"again_{at}").messages <= len(whole)
        except BagError as error:
            lost.append(str(error))
    assert all("wm recover-bag" in text for text in refused)
    assert all("no complete message" in text for text in lost)


def test_a_bag_with_an_unknown_type_beside_is_read_and_recovered_whole(tmp_path: Path) -> None:
    own = own_bag(tmp_path / "own")
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float32 x\n", GRIP))
    grip = store.serialize_cdr(store.types[GRIP](x=1.0), GRIP)
    with Bag(own) as bag, Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {c.topic: add(writer, c.topic, c.msgtype) for c in bag.connections}
        topics["/grip"] = writer.add_connection("/grip", GRIP, typestore=store)
        for topic, time_ns, data in bag.messages():
            writer.write(topics[topic], time_ns, data)
            writer.write(topics["/grip"], time_ns, grip)
    assert_same_episodes(tmp_path / "bag", own)
    report = recover(tmp_path / "bag")
    assert not report.damaged
    assert_same_episodes(report.bag, own)
    with Reader(report.bag) as reader:
        (again,) = (c for c in reader.connections if c.topic == "/grip")
        assert again.digest == store.hash_rihs01(GRIP)
        assert again.msgdef.data == store.generate_msgdef(GRIP, ros_version=2)[0]
        assert {bytes(data) for _, _, data in reader.messages([again])} == {bytes(grip)}


@pytest.mark.parametrize("told", ["folder", "file", "recovered"])
def test_another_definition_of_a_type_is_refused_by_its_hash_or_its_fields(tmp_path: Path, told: str) -> None:
    own, name = own_bag(tmp_path / "own"), "wm_msgs/msg/TransitionBatch"
    text = message_definition(name).replace("float32[] log_prob", "float64[] log_prob", 1)
    other = get_typestore(Stores.ROS2_JAZZY)
    other.register(get_types_from_msg(text, name))
    with Bag(own) as bag, Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            c.topic: writer.add_connection(c.topic, name, msgdef=text, rihs01=other.hash_rihs01(name))
            if c.msgtype == name else add(writer, c.topic, c.msgtype) for c in bag.connections
        }
        for topic, time_ns, data in bag.messages():
            writer.write(topics[topic], time_ns, data)
    path = tmp_path / "bag"
    path = {"folder": path, "file": path / "bag.mcap", "recovered": recover(path).bag}[told]
    with pytest.raises(BagError, match=r"recorded with another wm_msgs/msg/TransitionBatch \(RIHS01_\w+, ours is"):
        list(read_episodes(path))


def test_a_recovered_bag_of_ours_keeps_our_comments_and_hashes(tmp_path: Path) -> None:
    own = own_bag(tmp_path / "own")
    with Bag(own) as bag, Bag(recover(own).bag) as again:
        for ours, theirs in zip(bag.connections, again.connections, strict=True):
            assert (ours.topic, ours.msgtype, ours.digest, ours.msgdef, ours.msgcount, ours.ext) == (
                theirs.topic, theirs.msgtype, theirs.digest, theirs.msgdef, theirs.msgcount, theirs.ext
            )


def test_an_mcap_file_without_chunks_or_index_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    texts = [m.serialize(m.message_type("std_msgs/msg/String")(data=str(number))) for number in range(5)]
    without = {"use_chunking": False}, {"index_types": IndexType.NONE}, {"use_statistics": False}
    for number, options in enumerate(without):
        path = tmp_path / f"{number}.mcap"
        with path.open("wb") as stream:
            writer = McapWriter(stream, **options)  # type: ignore[arg-type]
            writer.start(profile="")
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            channel = writer.register_channel("/chatter", "cdr", schema)
            for time_ns in (3, 1, 4, 0, 2):
                writer.add_message(channel, time_ns, texts[time_ns], time_ns)
            writer.finish()
        with Bag(path) as bag:
            assert (bag.count("/chatter"), bag.start_ns, bag.end_ns) == (5, 0, 4)
            assert list(bag.messages(start_ns=1)) == [("/chatter", time_ns, texts[time_ns]) for time_ns in range(1, 5)]


def test_an_empty_bag_has_topics_and_no_messages(tmp_path: Path) -> None:
    with RawBagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/chatter", "std_msgs/msg/String")
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag_0.mcap"):
        with Bag(path) as bag:
            assert [c.topic for c in bag.connections] == ["/chatter"]
            assert (list(bag.messages()), bag.start_ns, bag.end_ns) == ([], 0, 0)
            assert bag.count("/chatter") == 0
