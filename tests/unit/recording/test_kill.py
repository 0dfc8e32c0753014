"""Recordings that were cut off: killed writers, truncated and damaged files, a disk that is full."""

import os
import re
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest
from foreign_robot import message
from foreign_robot import write as write_foreign
from mcap.reader import make_reader
from recording_samples import assert_same_episode, make_episode, make_spec
from rosbags.rosbag2 import StoragePlugin

from wm_nodes.core.types import Episode
from wm_nodes.recording import (
    Bag,
    BagError,
    EpisodeBagWriter,
    RawBagWriter,
    RecordingError,
    read_episodes,
    read_spec,
    recover,
    topics,
)
from wm_nodes.recording import messages as m

TESTS = Path(__file__).resolve().parents[2]
TOPIC = "/wm/flow/credit"

EPISODE_WRITER = """
import sys, time
from pathlib import Path
from recording_samples import make_episode, make_spec
from wm_nodes.recording import EpisodeBagWriter
spec = make_spec()
with EpisodeBagWriter(Path(sys.argv[1]), spec, run_id="killed", custom={"wm.git_commit": "abc"}) as writer:
    for index in range(100000):
        writer.write(make_episode(spec, index))
        print(index, flush=True)
        time.sleep(0.01)
"""

RECOVER = [sys.executable, "-c", "import sys; from wm_nodes.apps.cli import main; sys.exit(main())", "recover-bag"]

MESSAGE_WRITER = """
import sys, time
from pathlib import Path
from test_kill import TOPIC, credit
from wm_nodes.recording import RawBagWriter
bag = RawBagWriter(Path(sys.argv[1]))
bag.add_topic(TOPIC, "wm_msgs/msg/Credit")
for number in range(100000):
    bag.write(TOPIC, credit(number), time.time_ns())
    print(number, time.time_ns(), flush=True)
    time.sleep(0.002)
"""


def credit(number: int) -> bytes:
    return m.serialize(
        m.message_type("wm_msgs/msg/Credit")(
            header=m.header(number, ""),
            consumer="test",
            topic="reward",
            stream_session=1,
            granted_seq=number,
            received_seq=number,
            lost_total=0,
        )
    )


def kill_while_it_writes(script: str, bag: Path, seconds: float) -> list[str]:
    """Run the script, kill -9 after its first line plus `seconds`; return its lines."""
    folders = f"{TESTS}:{TESTS / 'unit' / 'recording'}"
    environment = {**os.environ, "PYTHONPATH": f"{folders}:{os.environ.get('PYTHONPATH', '')}"}
    with subprocess.Popen(
        [sys.executable, "-c", script, str(bag)], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        assert first
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        return [first, *process.stdout.read().splitlines()]


def recovered_episodes(broken: Path) -> list[Episode]:
    """None where not even the first frame was complete; any other error is an error."""
    try:
        return list(read_episodes(recover(broken).bag))
    except BagError as error:
        if re.search("no complete message|has no images", str(error)):
            return []
        raise


def fill(writer: EpisodeBagWriter) -> None:
    for index in range(1000):
        writer.write(make_episode(writer.spec, index))


def stop_half_way(path: Path) -> None:
    spec = make_spec()
    with EpisodeBagWriter(path, spec, run_id="test") as writer:
        writer.write(make_episode(spec))
        writer.write(make_episode(spec, 1, steps=0))


def write_episodes(path: Path, count: int = 6, **options: object) -> Path:
    spec = make_spec()
    with EpisodeBagWriter(path, spec, run_id="test", **options) as writer:  # type: ignore[arg-type]
        for index in range(count):
            writer.write(make_episode(spec, index))
    return path


def test_every_episode_written_before_a_kill_is_recovered(tmp_path: Path) -> None:
    lines = kill_while_it_writes(EPISODE_WRITER, tmp_path / "bag", 0.7)
    last = int(lines[-1])
    assert not (tmp_path / "bag").exists()
    with pytest.raises(BagError, match=r"never completed.*`wm recover-bag .*bag\.partial"):
        next(read_episodes(tmp_path / "bag"))
    report = recover(tmp_path / "bag.partial")
    found = list(read_episodes(report.bag))
    assert len(found) in (last + 1, last + 2)
    for index, episode in enumerate(found):
        assert_same_episode(episode, make_episode(make_spec(), index))
    with Bag(report.bag) as bag:
        assert bag.custom["wm.run_id"] == "killed"
        assert bag.custom["wm.git_commit"] == "abc"
    assert (tmp_path / "bag.partial").exists()


@pytest.mark.slow
def test_a_kill_loses_at_most_the_last_second_of_messages(tmp_path: Path) -> None:
    lines = kill_while_it_writes(MESSAGE_WRITER, tmp_path / "bag", 2.5)
    last_number, last_time_ns = map(int, lines[-1].split())
    report = recover(tmp_path / "bag.partial", output=tmp_path / "saved")
    with Bag(report.bag) as bag:
        saved = [(time_ns, data) for _, time_ns, data in bag.messages([TOPIC])]
    assert [data for _, data in saved] == [credit(number) for number in range(len(saved))]
    assert last_number + 1 >= len(saved) > 0
    assert last_time_ns - saved[-1][0] < 1_000_000_000


def test_a_file_cut_at_any_byte_gives_back_a_prefix_of_its_episodes(tmp_path: Path) -> None:
    path = write_episodes(tmp_path / "bag", 6)
    whole = list(read_episodes(path))
    content = (path / "bag_0.mcap").read_bytes()
    counts = []
    for cut in [0, 5, 8, 40, 200, *range(1000, len(content), len(content) // 12), len(content) - 1]:
        broken = tmp_path / f"cut_{cut}"
        shutil.copytree(path, broken)
        (broken / "bag_0.mcap").write_bytes(content[:cut])
        with pytest.raises(BagError, match=r"damaged.*recover"):
            list(read_episodes(broken))
        found = recovered_episodes(broken)
        assert (broken / "bag_0.mcap").read_bytes() == content[:cut]
        for ours, theirs in zip(found, whole):
            assert ours.episode_id == theirs.episode_id
            assert (ours.images == theirs.images).all()
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == 6


def test_a_flipped_byte_is_noticed_and_costs_only_its_chunk(tmp_path: Path) -> None:
    path = write_episodes(tmp_path / "bag", 6)
    file = path / "bag_0.mcap"
    content = bytearray(file.read_bytes())
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[3]
    content[chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(BagError, match="damaged"):
        list(read_episodes(path))
    report = recover(path)
    assert len(report.damaged) == 1
    assert len(list(read_episodes(report.bag))) == 5


def test_the_working_folder_is_a_bag_like_any_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write_episodes(tmp_path / "bag", 2))
    assert len(list(read_episodes(Path(".")))) == 2
    assert recover(Path(".")).bag == tmp_path / "bag_recovered"


def test_an_unfinished_recording_blocks_its_name_until_dealt_with(tmp_path: Path) -> None:
    spec = make_spec()
    with pytest.raises(ValueError, match="no steps"):
        stop_half_way(tmp_path / "bag")
    with pytest.raises(BagError, match="unfinished recording"):
        EpisodeBagWriter(tmp_path / "bag", spec, run_id="test")
    assert len(list(read_episodes(recover(tmp_path / "bag.partial").bag))) == 1
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test", discard_partial=True) as writer:
        writer.write(make_episode(spec, 3))
    assert read_spec(tmp_path / "bag") == spec
    assert not (tmp_path / "bag.partial").exists()


def test_recover_says_why_when_there_is_nothing(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"no \.mcap file at"):
        recover(tmp_path / "nothing")
    (tmp_path / "x.mcap").write_bytes(b"not a bag at all, but long enough")
    with pytest.raises(BagError, match=r"no complete message.*invalid magic"):
        recover(tmp_path / "x.mcap")
    process = subprocess.run([*RECOVER, str(tmp_path / "x.mcap")], capture_output=True, text=True)
    assert process.returncode == 2
    assert process.stderr.startswith("error: ")
    assert "Traceback" not in process.stderr


def test_the_recover_command_writes_a_bag(tmp_path: Path) -> None:
    path = write_episodes(tmp_path / "bag", 2)
    process = subprocess.run(
        [*RECOVER, str(path), "--output", str(tmp_path / "again")], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert len(list(read_episodes(tmp_path / "again"))) == 2


def test_every_committed_message_of_a_killed_sqlite3_bag_comes_back(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    said = [(n + 1, "/say", message("std_msgs/msg/String", data=f"{n}")) for n in range(10)]
    write_foreign(tmp_path / "plain" / "bag", said, StoragePlugin.SQLITE3)
    folder = (tmp_path / "plain").rename(tmp_path / "take#2 50%")
    (file,) = (folder / "bag").glob("*.db3")
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    database.execute("UPDATE message_definitions SET encoding = ''")  # as of a definition that was not found
    database.execute("INSERT INTO messages SELECT id + 10, topic_id, timestamp + 10, data FROM messages")
    database.commit()
    shutil.copytree(folder, killed := tmp_path / "killed?")  # before the writer ends, which would empty its log
    database.close()
    report = recover(killed / "bag")
    assert (report.messages, report.damaged) == (20, [])
    for bag_folder in (folder / "bag", killed / "bag", report.bag):
        with Bag(bag_folder) as bag:
            assert [time_ns for _, time_ns, _ in bag.messages(["/say"])] == [*range(1, 21)]


def test_what_an_episode_carries_comes_back_with_it(tmp_path: Path) -> None:
    path = write_episodes(tmp_path / "bag", 3)
    (path / "metadata.yaml").unlink()
    assert [episode.extra for episode in read_episodes(recover(path).bag)] == [{"index": n} for n in range(3)]


def test_a_full_disk_is_one_clear_error_and_what_was_flushed_is_recoverable(tmp_path: Path) -> None:
    """RLIMIT_FSIZE stands in for the disk: the system call fails in the same place, with another errno."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    spec = make_spec()
    try:
        writer = EpisodeBagWriter(tmp_path / "bag", spec, run_id="test")
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))
        with pytest.raises(RecordingError, match=r"free disk space and run .*`wm recover-bag .*bag\.partial"):
            fill(writer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert writer.num_episodes > 0
    found = len(list(read_episodes(recover(tmp_path / "bag.partial").bag)))
    assert writer.num_episodes <= found <= writer.num_episodes + 1  # the refused one may be there to its last byte


def test_a_closed_or_unknown_topic_write_is_refused(tmp_path: Path) -> None:
    bag = RawBagWriter(tmp_path / "bag")
    with pytest.raises(BagError, match="not announced"):
        bag.write("/wm/reward", b"", 0)
    bag.add_topic("/wm/reward", topics.REWARD.msgtype)
    with pytest.raises(BagError, match="cannot also be"):
        bag.add_topic("/wm/reward", topics.SPEC.msgtype)
    with pytest.raises(BagError, match="unknown message type"):
        bag.add_topic("/x", "foo_msgs/msg/Bar")
    bag.close()
    with pytest.raises(BagError, match="is closed"):
        bag.write("/wm/reward", b"", 0)


def numbered(bag: RawBagWriter, count: int) -> RawBagWriter:
    bag.add_topic(TOPIC, "wm_msgs/msg/Credit")
    for number in range(count):
        bag.write(TOPIC, credit(number), 1 + number)
    return bag


def test_a_next_file_that_cannot_be_opened_ends_the_bag_and_what_was_written_is_recoverable(tmp_path: Path) -> None:
    bag = numbered(RawBagWriter(tmp_path / "bag"), 3)
    (tmp_path / "bag.partial" / "bag_1.mcap").touch()
    with pytest.raises(RecordingError, match=r"bag\.partial failed after 3 messages: File exists; .*wm recover-bag"):
        bag.split()
    with pytest.raises(RecordingError, match=r"bag is unfinished: .*bag\.partial"):
        bag.close()
    assert not (tmp_path / "bag").exists()
    assert recover(tmp_path / "bag.partial").topics == {TOPIC: 3}


def test_a_message_that_fills_a_file_whose_successor_cannot_be_opened_is_in_the_bag(tmp_path: Path) -> None:
    bag = numbered(RawBagWriter(tmp_path / "bag", chunk_bytes=100, split_bytes=10_000), 1)
    (tmp_path / "bag.partial" / "bag_1.mcap").touch()
    with pytest.raises(RecordingError, match="File exists"):
        numbered(bag, 10_000)
    assert recover(tmp_path / "bag.partial").topics == {TOPIC: bag.messages}


def test_a_bag_whose_writing_was_given_up_is_not_closed_as_if_it_were_complete(tmp_path: Path) -> None:
    bag = numbered(RawBagWriter(tmp_path / "bag"), 3)
    bag.abort()
    with pytest.raises(RecordingError, match=r"bag is unfinished: .*bag\.partial"):
        bag.close()
    done = numbered(RawBagWriter(tmp_path / "done"), 3)
    assert done.close() == done.close() == tmp_path / "done"
