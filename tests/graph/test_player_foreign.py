"""The player with bags of others, damaged ones, and starts within a bag."""

import time
from pathlib import Path
from typing import Any

import pytest
from deadlines import within
from diagnostic_msgs.msg import DiagnosticArray
from graph.test_recorder_player import Listener, Peer, Start, peer, replay
from mcap.reader import make_reader
from recording_samples import make_episode, make_spec
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from std_msgs.msg import String

from wm_msgs.action import Replay
from wm_nodes.recording import Bag, EpisodeBagWriter, RawBagWriter
from wm_nodes.recording import messages as m

__all__ = ["peer"]
pytestmark = [pytest.mark.graph, pytest.mark.alone]

STRING = "std_msgs/msg/String"
NOW_NS = 10**18


def write_foreign(path: Path) -> None:
    """Five messages of each: a known type, one that is not installed, and one of another definition than ours."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float32 x\n", "own_msgs/msg/Grip"))
    store.register(get_types_from_msg("string consumer\n", "wm_msgs/msg/Credit"))
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for topic, kind, value in (
            ("/grip", "own_msgs/msg/Grip", {"x": 1.0}), ("/chatter", STRING, {"data": "x"}),
            ("/credit", "wm_msgs/msg/Credit", {"consumer": "x"}),
        ):
            connection = writer.add_connection(topic, kind, typestore=store)
            for number in range(5):
                writer.write(connection, NOW_NS + number, store.serialize_cdr(store.types[kind](**value), kind))


def write_damaged(path: Path) -> None:
    """Nine messages on /chatter in three chunks, the middle one damaged."""
    with RawBagWriter(path) as writer:
        writer.add_topic("/chatter", STRING)
        for number in range(9):
            data = m.serialize(m.message_type(STRING)(data=f"{number} {'x' * 100}"))
            writer.write("/chatter", data, NOW_NS + number * 10**6)
            if number % 3 == 2:
                writer.flush()
    (file,) = path.glob("*.mcap")
    content = bytearray(file.read_bytes())
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    content[chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size // 2] ^= 0xFF
    file.write_bytes(content)


def ended(player: Peer, **goal: Any) -> Any:
    _, done = replay(player, [], rate=1.0, **goal)
    player.wait(done.done, "result", 60)
    return done.result().result


def test_topics_that_cannot_be_played_are_left_out_named_and_counted(domain: int, tmp_path: Path, peer: Start) -> None:
    write_foreign(tmp_path / "bag")
    player = peer(domain, "player_node", tmp_path)
    counts, heard = player.counts(), list[str]()
    player.node.create_subscription(String, "/chatter", lambda message: heard.append(message.data), 10)
    result = ended(player, bag_uri="bag")
    assert (result.termination_reason, result.messages) == (Replay.Result.FINISHED, 5), result.message
    player.wait(lambda: heard == ["x"] * 5, "five messages")
    player.wait(lambda: counts.get("left_out_topics") == "2", "count")
    for topic, words in (("/grip", "own_msgs/msg/Grip is not installed"), ("/credit", "another wm_msgs/msg/Credit")):
        result = ended(player, bag_uri="bag", topics=[topic])
        assert result.termination_reason == Replay.Result.FAILED
        assert f"{topic}: " in result.message and words in result.message and "`topics`" in result.message
    assert ended(player, bag_uri="bag", topics=["/chatter"]).messages == 5


def test_the_error_of_a_bag_played_at_start_ends_when_another_is_played(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    write_damaged(tmp_path / "bag")
    write_foreign(tmp_path / "next")
    player = peer(domain, "player_node", tmp_path, bag_uri="bag")
    said = [""]
    player.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda message: said.append(message.status[0].message), 10
    )
    player.wait(lambda: "bag bag is damaged" in said[-1], "the error")
    assert ended(player, bag_uri="next", topics=["/chatter"]).messages == 5
    player.wait(lambda: said[-1] == "ok", "no error")


def test_a_bag_damaged_in_the_middle_is_played_up_to_its_end_and_the_goal_names_the_part(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    write_damaged(tmp_path / "bag")
    player = peer(domain, "player_node", tmp_path)
    counts, heard = player.counts(), list[str]()
    player.node.create_subscription(String, "/chatter", lambda message: heard.append(message.data[0]), 10)
    result = ended(player, bag_uri="bag")
    assert result.termination_reason == Replay.Result.FAILED
    assert "bag is damaged: bag_0.mcap at byte" in result.message
    assert "all else was played, 6 messages" in result.message
    player.wait(lambda: heard == list("012678"), "what can be read")
    player.wait(lambda: counts.get("playback_warnings") == counts.get("failed_goals") == "1", "counts")
    with RawBagWriter(tmp_path / "next") as writer:  # the player is free, and another type takes the topic's place
        writer.add_topic("/chatter", "std_msgs/msg/Int32")
        writer.write("/chatter", m.serialize(m.message_type("std_msgs/msg/Int32")(data=1)), NOW_NS)
    assert ended(player, bag_uri="next").messages == 1


def test_a_start_within_a_bag_brings_the_spec_and_a_jump_of_years_is_not_waited_for(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    spec = make_spec()
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test") as episodes:
        for number in range(3):
            episodes.write(make_episode(spec, number))
    with RawBagWriter(tmp_path / "years") as years:
        years.add_topic("/chatter", STRING)
        for time_ns in (0, 1_750_000_000 * m.NS_PER_S):
            years.write("/chatter", m.serialize(m.message_type(STRING)(data="x")), time_ns)
    player = peer(domain, "player_node", tmp_path)
    counts, listener = player.counts(), Listener(player, tmp_path / "bag")
    result = ended(player, bag_uri="bag", start_offset=0.75)
    assert result.termination_reason == Replay.Result.FINISHED, result.message
    player.wait(lambda: len(listener.order) > result.messages, "last message")
    with Bag(tmp_path / "bag") as bag:
        assert listener.streams["env/spec"][0].startswith(next(data for *_, data in bag.messages(["/wm/env/spec"])))
    assert listener.order[0] == "env/spec" and listener.order.count("env/spec") == 1
    began = time.monotonic()
    assert ended(player, bag_uri="years").messages == 2
    assert time.monotonic() - began < within(20)
    player.wait(lambda: counts.get("playback_warnings") == "1", "count")
