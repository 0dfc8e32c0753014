"""Playing a bag: loops, gaps, clocks that were set, latched topics before the start, damage."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from deadlines import within
from mcap.reader import make_reader
from recording_samples import make_episode, make_spec

from wm_nodes.recording import Bag, BagError, EpisodeBagWriter, RawBagWriter, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.playback import Playback

STRING, TRANSFORMS = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
NOW_NS = 1_750_000_000 * m.NS_PER_S


class Cancelled(Exception):
    pass


def text(value: object) -> bytes:
    return m.serialize(m.message_type(STRING)(data=str(value)))


def chatter(path: Path, times: list[int], **options: int) -> Path:
    """Message n of /chatter says n and is received at times[n]."""
    with RawBagWriter(path, **options) as writer:
        writer.add_topic("/chatter", STRING)
        for number, time_ns in enumerate(times):
            writer.write("/chatter", text(number), time_ns)
    return path


def played(playback: Playback, during: Callable[[], None] = lambda: None) -> tuple[list[tuple[str, bytes]], list[str]]:
    """What was published and what was said."""
    published: list[tuple[str, bytes]] = []
    said: list[str] = []
    playback.run(lambda name, data: published.append((name, data)), lambda time_ns: None, during, said.append)
    return published, said


def cancel() -> None:
    raise Cancelled


def test_a_loop_over_topics_without_messages_is_refused_and_one_pass_over_them_ends(tmp_path: Path) -> None:
    path = chatter(tmp_path / "bag", [NOW_NS])
    with RawBagWriter(tmp_path / "quiet") as writer:
        writer.add_topic("/quiet", STRING)
    for names in (["/quiet"], []):
        with pytest.raises(BagError, match="no message on /quiet to play in a loop"):
            Playback(tmp_path / "quiet", names=names, loop=True)
    assert played(Playback(tmp_path / "quiet")) == ([], [])
    with pytest.raises(Cancelled):
        played(Playback(path, loop=True), cancel)


def test_a_loop_over_a_single_moment_neither_floods_nor_holds_on_to_a_stop(tmp_path: Path) -> None:
    playback = Playback(chatter(tmp_path / "bag", [NOW_NS, NOW_NS]), loop=True)
    threading.Timer(2.0, playback.stop).start()
    published, _ = played(playback)
    assert 2 <= len(published) <= 2 * 81


@pytest.mark.parametrize("names", [[], ["/chatter"]])
def test_a_gap_in_which_the_clock_was_set_is_said_and_not_waited_for(tmp_path: Path, names: list[str]) -> None:
    path = chatter(tmp_path / "bag", [0, NOW_NS, NOW_NS + 10**8])
    began = time.monotonic()
    published, said = played(Playback(path, names=names))
    assert [data for _, data in published] == [text(number) for number in range(3)]
    assert 0.1 <= time.monotonic() - began < within(5)
    assert said == ["the bag's time goes on by 1750000000 s here, which is not waited for"]


def test_a_long_wait_is_said_once_and_ends_by_a_seek(tmp_path: Path) -> None:
    playback = Playback(chatter(tmp_path / "bag", [NOW_NS, NOW_NS + 600 * 10**9, NOW_NS + 601 * 10**9]), rate=2.0)
    threading.Timer(2.0, playback.seek, (601.0,)).start()
    published, said = played(playback)
    assert [data for _, data in published] == [text(0), text(2)]
    assert said == ["the next message is at 600.000 s of the bag, due in 300 s; seek to go on now"]


def test_what_begins_is_called_before_each_pass_and_after_each_seek(tmp_path: Path) -> None:
    playback = Playback(chatter(tmp_path / "bag", [NOW_NS, NOW_NS + 1]), loop=True)
    order = list[bytes]()

    def publish(name: str, data: bytes) -> None:
        order.append(data)
        if len(order) == 5:
            playback.seek(0.0)

    def check() -> None:
        if order.count(b"begins") == 4:
            raise Cancelled

    with pytest.raises(Cancelled):
        playback.run(publish, lambda time_ns: None, check, begin=lambda: order.append(b"begins"))
    assert order == [b"begins", text(0), text(1), b"begins", text(0), b"begins", text(0), text(1), b"begins"]


def test_single_messages_are_answered_as_soon_as_one_is_held_back_which_is_counted_once(tmp_path: Path) -> None:
    playback = Playback(chatter(tmp_path / "bag", [NOW_NS + number for number in range(10)]), paused=True)
    published, granted = list[bytes](), threading.Semaphore(3)

    def publish(name: str, data: bytes) -> None:
        if not granted.acquire(blocking=False):
            with playback.held_back():
                granted.acquire()
        published.append(data)

    thread = threading.Thread(target=playback.run, args=(publish, lambda time_ns: None))
    thread.start()
    began = time.monotonic()
    assert [playback.play_next(8), playback.play_next(8)] == [4, 0]
    assert time.monotonic() - began < within(1)
    granted.release(100)
    while len(published) < 4:
        time.sleep(0.01)
    assert playback.play_next(4) == 4
    playback.stop()
    thread.join()
    assert published == [text(number) for number in range(8)]


def test_a_recording_whose_clock_was_set_back_is_played_in_the_order_it_was_made(tmp_path: Path) -> None:
    spec = make_spec()
    with EpisodeBagWriter(tmp_path / "own", spec, run_id="test", start_ns=NOW_NS) as episodes:
        for index in range(4):
            episodes.write(make_episode(spec, index))
    with Bag(tmp_path / "own") as bag, RawBagWriter(tmp_path / "bag", chunk_bytes=4096) as writer:
        messages = list(bag.messages())
        for connection in bag.connections:
            writer.copy_topic(connection)
        for number, (name, time_ns, data) in enumerate(messages):
            writer.write(name, data, time_ns - 3600 * 10**9 * (number > 40))
    began = time.monotonic()
    published, said = played(Playback(tmp_path / "bag", rate=10.0))
    assert published == [(name, data) for name, _, data in messages]
    assert len(said) == 1 and "goes back by 3600 s" in said[0]
    assert time.monotonic() - began < within(10)
    assert played(Playback(tmp_path / "bag", rate=1e6, start_offset_s=1.0))[0] == published


LATCHED, KEPT, VOLATILE = topics.LATCHED, topics.LATCHED._replace(depth=2), topics.METRICS


def latched_bag(path: Path) -> Path:
    """Second n has a message n of every topic; the static transforms have two recorded publishers."""
    with RawBagWriter(path) as writer:
        for name, qos in (("/spec", [LATCHED]), ("/version", [KEPT]), ("/chatter", [VOLATILE])):
            writer.add_topic(name, STRING, qos)
        writer.add_topic("/tf_static", TRANSFORMS, [LATCHED, LATCHED])
        for number in range(6):
            for name in ("/spec", "/version", "/chatter"):
                writer.write(name, text(number), NOW_NS + number * 10**9)
            if number < 3:
                none = m.serialize(m.message_type(TRANSFORMS)(transforms=[]))
                writer.write("/tf_static", none, NOW_NS + number * 10**9)
    return path


def test_a_start_within_a_bag_gives_the_latched_messages_of_before_it_first(tmp_path: Path) -> None:
    path = latched_bag(tmp_path / "bag")
    playback = Playback(path, rate=100.0, start_offset_s=3.5)
    published, _ = played(playback)
    before, after = published[:6], published[6:]
    assert [name for name, _ in before] == [
        "/tf_static", "/tf_static", "/version", "/tf_static", "/spec", "/version"
    ]
    assert [data for name, data in before if name == "/version"] == [text(2), text(3)]
    assert ("/spec", text(3)) in before
    assert after == [(name, text(number)) for number in (4, 5) for name in ("/spec", "/version", "/chatter")]
    assert playback.messages == len(after)
    only, _ = played(Playback(path, names=["/chatter"], rate=100.0, start_offset_s=3.5))
    assert only == [("/chatter", text(4)), ("/chatter", text(5))]
    from_start, _ = played(Playback(path, rate=100.0))
    assert len(from_start) == 3 * 6 + 3


def test_a_seek_gives_them_too(tmp_path: Path) -> None:
    playback = Playback(latched_bag(tmp_path / "bag"), names=["/spec"], rate=1e-3)

    def seek() -> None:
        if playback.messages == 1 and playback.position_s < 4:
            playback.seek(4.5)
            playback.set_rate(1e3)

    published, _ = played(playback, seek)
    assert published == [("/spec", text(0)), ("/spec", text(4)), ("/spec", text(5))]


@pytest.mark.parametrize("loop", [False, True])
def test_what_lies_behind_a_damaged_part_is_played_and_the_part_is_named(tmp_path: Path, loop: bool) -> None:
    path = tmp_path / "bag"
    with RawBagWriter(path) as writer:
        writer.add_topic("/chatter", STRING)
        for number in range(9):
            writer.write("/chatter", text(number) + bytes(100), NOW_NS + number * 10**6)
            if number % 3 == 2:
                writer.flush()
    file = path / "bag_0.mcap"
    content = bytearray(file.read_bytes())
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 3
    chunk = summary.chunk_indexes[1]
    content[chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size // 2] ^= 0xFF
    file.write_bytes(content)
    playback = Playback(path, loop=loop)
    threading.Timer(2.0, playback.stop).start()
    published, said = played(playback)
    assert [data[:10] for _, data in published[:6]] == [text(number)[:10] for number in (0, 1, 2, 6, 7, 8)]
    assert (len(published) > 6) == loop
    assert len(playback.damaged) == len(said) == 1, "said once, however often it is met"
    assert f"bag_0.mcap at byte {chunk.chunk_start_offset}" in said[0]
