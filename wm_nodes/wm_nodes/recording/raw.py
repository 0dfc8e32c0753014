"""RawBagWriter: serialised messages, as they came, into a rosbag2 folder of MCAP files that survives a kill."""

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from io import BufferedWriter
from pathlib import Path

from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat, Qos

from wm_nodes.recording.errors import BagError, RecordingError
from wm_nodes.recording.metadata import FileInfo, TopicInfo, metadata_text, qos_text
from wm_nodes.recording.typestore import is_known, message_definition, recorded_hash, type_hash

PARTIAL_SUFFIX = ".partial"
FLUSH_S = 0.5
"""Age at which a chunk is closed."""
START_RECORD = "wm.start"
"""MCAP metadata record at the start of every file: the custom data known then, so that a kill does not lose them."""
EPISODE_RECORD = "wm.episode"
"""MCAP metadata record before the messages of an episode: its row of EPISODE_TABLE, which a kill then does not lose."""
EPISODE_TABLE = "wm.episode_table_json"
"""Custom data of a bag of whole episodes: `columns` and `rows`."""


class RawBagWriter:
    """Writes CDR bytes into `path`, a rosbag2 folder. While open it is `<path>.partial`; close() completes and renames.

    A chunk is closed when it holds `chunk_bytes`, or when `flush()` finds it older than FLUSH_S: a kill loses at most
    what came after that, and wm_nodes.recording.recover brings back the rest. A new file starts at `split_bytes`, and
    after `split_s` seconds (0: never). discard_partial: throw away what a killed process left under this name.

    Raises:
        BagError: the bag, or an unfinished one of its name, exists already.
        RecordingError: the file system refuses a write; the bag so far stays in the partial folder.
    """

    def __init__(
        self, path: Path, *, custom: Mapping[str, str] | None = None, chunk_bytes: int = 2**20,
        split_bytes: int = 2**28, split_s: float = 0.0, discard_partial: bool = False,
    ) -> None:
        self.path = Path(path)
        self.partial_path = self.path.with_name(self.path.name + PARTIAL_SUFFIX)
        if self.path.exists():
            raise BagError(f"bag {self.path} exists already; choose another name or remove it")
        if self.partial_path.exists() and discard_partial:
            shutil.rmtree(self.partial_path)
        if self.partial_path.exists():
            raise BagError(
                f"{self.partial_path} holds an unfinished recording; recover it with "
                f"`wm recover-bag {self.partial_path}`, or remove it"
            )
        self.custom: dict[str, str] = dict(custom or {})
        self.files: list[FileInfo] = []
        self._topics: dict[str, TopicInfo] = {}
        self._channels: dict[str, int] = {}
        self._definitions: dict[str, tuple[str, str]] = {}  # by type: encoding and text
        self._chunk_bytes = chunk_bytes
        self._split_bytes, self._split_s = split_bytes, split_s
        self._writer: Writer | None = None
        self._stream: BufferedWriter | None = None
        self._aborted = False
        self._file_started = self._last_flush = time.monotonic()
        self._unflushed = 0
        try:
            self.partial_path.mkdir(parents=True)
            self._open_file()
        except OSError as error:
            raise RecordingError(f"cannot create bag {self.path}: {error}") from error

    @property
    def messages(self) -> int:
        return sum(info.messages for info in self.files)

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        return self._topics

    @property
    def bytes_in_file(self) -> int:
        """Bytes of the current file that are on their way to the disk."""
        return self._stream.tell() if self._stream is not None and not self._stream.closed else 0

    def add_topic(self, name: str, msgtype: str, qos: Sequence[Qos] = ()) -> None:
        """Announce a topic (absolute name) of a type that we know; again with the same type does nothing."""
        if self._is_new(name, msgtype):
            text = message_definition(msgtype)
            self._announce(TopicInfo(name, msgtype, type_hash(msgtype), tuple(qos)), "ros2msg", text)

    def copy_topic(self, recorded: Connection) -> None:
        """Announce a topic of another bag, of whichever type, with its definition as it is there."""
        if not self._is_new(recorded.topic, recorded.msgtype):
            return
        assert isinstance(recorded.ext, ConnectionExtRosbag2)
        if recorded.ext.serialization_format != "cdr":
            raise BagError(
                f"topic {recorded.topic} holds {recorded.ext.serialization_format} messages; rosbag2 bags hold cdr"
            )
        qos, definition = tuple(recorded.ext.offered_qos_profiles), recorded.msgdef
        if definition.format is MessageDefinitionFormat.NONE and is_known(recorded.msgtype):
            self.add_topic(recorded.topic, recorded.msgtype, qos)
            return
        encoding = {MessageDefinitionFormat.IDL: "ros2idl", MessageDefinitionFormat.MSG: "ros2msg"}
        self._announce(
            TopicInfo(recorded.topic, recorded.msgtype, recorded_hash(recorded), qos),
            encoding.get(definition.format, ""), definition.data,
        )

    def _is_new(self, name: str, msgtype: str) -> bool:
        known = self._topics.get(name)
        if known is not None and known.msgtype != msgtype:
            raise BagError(f"topic {name} is recorded as {known.msgtype}; it cannot also be {msgtype}")
        return known is None

    def _announce(self, topic: TopicInfo, encoding: str, definition: str) -> None:
        self._definitions.setdefault(topic.msgtype, (encoding, definition))
        self._topics[topic.name] = topic
        self._register(topic)

    def write(self, topic: str, data: bytes | memoryview, time_ns: int, publish_ns: int | None = None) -> None:
        """Write one serialised message. time_ns: when it was received; publish_ns: when sent, if known."""
        writer = self._open_writer()
        if topic not in self._channels:
            raise BagError(f"topic {topic} was not announced; call add_topic first")
        try:
            writer.add_message(
                self._channels[topic],
                time_ns,
                data,
                time_ns if publish_ns is None else publish_ns,  # type: ignore[arg-type]
            )
        except OSError as error:
            raise self._abort_with(error) from error
        self._unflushed += 1
        self._topics[topic].messages += 1
        self.files[-1].count(topic, time_ns)
        self.flush(only_if_due=True)
        if 0 < self._split_bytes <= self.bytes_in_file or 0 < self._split_s <= time.monotonic() - self._file_started:
            self.split()

    def add_record(self, name: str, values: Mapping[str, str]) -> None:
        """Write an MCAP metadata record where the file is now."""
        try:
            self._open_writer().add_metadata(name, dict(values))
        except OSError as error:
            raise self._abort_with(error) from error

    def flush(self, *, only_if_due: bool = False) -> None:
        """Hand everything written so far to the operating system; with only_if_due, at most every FLUSH_S.

        A recorder calls it from a timer too, so that the last messages before a silence survive a kill.
        """
        now = time.monotonic()
        if only_if_due and now - self._last_flush < FLUSH_S:
            return
        self._last_flush = now
        if self._unflushed:
            try:
                self._open_writer().flush()
            except OSError as error:
                raise self._abort_with(error) from error
            self._unflushed = 0

    def split(self) -> None:
        """Complete the current file and start the next one; nothing to do while it is empty."""
        self._open_writer()
        if not self.files[-1].messages:
            return
        self._finish_file()
        try:
            self._open_file()
        except OSError as error:
            raise self._abort_with(error) from error

    def close(self) -> Path:
        """Complete the bag, write metadata.yaml and rename the folder to its final name, which is returned.

        Raises:
            RecordingError: the disk refuses it now, or refused a write before, or abort() was called: the bag is
                unfinished, and there is only the partial folder.
        """
        if self._aborted:
            raise RecordingError(f"bag {self.path} is unfinished: what was written of it is in {self.partial_path}")
        if self._writer is None:
            return self.path
        self._finish_file()
        try:
            text = metadata_text(list(self._topics.values()), self.files, self.custom)
            with (self.partial_path / "metadata.yaml").open("w", encoding="utf8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            self.partial_path.rename(self.path)
            _sync_folder(self.path.parent)
        except OSError as error:
            raise self._abort_with(error) from error
        return self.path

    def abort(self, *, remove: bool = False) -> None:
        """Stop without completing the bag; it stays in the partial folder for recovery unless `remove`."""
        self._aborted = True
        stream, self._stream, self._writer = self._stream, None, None
        if stream is not None:
            try:
                stream.close()
            except OSError:
                stream.raw.close()
        if remove:
            shutil.rmtree(self.partial_path, ignore_errors=True)

    def __enter__(self) -> "RawBagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self._abort_flushed()

    def _abort_flushed(self) -> None:
        try:
            if self._writer is not None:
                self.flush()
        except RecordingError:
            pass
        self.abort()

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise BagError(f"bag {self.path} is closed; open another one to go on recording")
        return self._writer

    def _open_file(self) -> None:
        name = f"{self.path.name}_{len(self.files)}.mcap"
        self._stream = (self.partial_path / name).open("xb")
        self._writer = Writer(self._stream, chunk_size=self._chunk_bytes, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="wm_nodes.recording")
        self._writer.add_metadata(START_RECORD, self.custom)
        self._stream.flush()
        self.files.append(FileInfo(name))
        self._file_started = self._last_flush = time.monotonic()
        self._channels = {}
        self._schemas: dict[str, int] = {}
        for topic in self._topics.values():
            self._register(topic)

    def _register(self, topic: TopicInfo) -> None:
        writer = self._open_writer()
        if topic.msgtype not in self._schemas:
            encoding, text = self._definitions[topic.msgtype]
            self._schemas[topic.msgtype] = writer.register_schema(topic.msgtype, encoding, text.encode())
        metadata = {"offered_qos_profiles": qos_text(topic.qos), "topic_type_hash": topic.type_hash}
        self._channels[topic.name] = writer.register_channel(topic.name, "cdr", self._schemas[topic.msgtype], metadata)

    def _finish_file(self) -> None:
        writer, stream = self._open_writer(), self._stream
        assert stream is not None
        try:
            topics = [
                TopicInfo(t.name, t.msgtype, t.type_hash, t.qos, self.files[-1].topic_messages.get(t.name, 0))
                for t in self._topics.values()
            ]
            inner = metadata_text(topics, self.files[-1:], self.custom, nested=False)
            writer.add_metadata("rosbag2", {"serialized_metadata": inner})
            writer.finish()
            stream.flush()
            os.fsync(stream.fileno())
            stream.close()
        except OSError as error:
            raise self._abort_with(error) from error
        self._writer = self._stream = None
        self._unflushed = 0

    def _abort_with(self, error: OSError) -> RecordingError:
        self.abort()
        return RecordingError(
            error.errno,
            f"writing to {self.partial_path} failed after {self.messages} messages: {error.strerror or error}; "
            f"free disk space and run `wm recover-bag {self.partial_path}` to keep what is there",
        )


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
