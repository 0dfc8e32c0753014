"""The files of a bag, whoever wrote them: MCAP or sqlite3, plain or compressed by zstd. What a file is and holds is
read from the file itself, since metadata.yaml may say less (after a re-indexing) or something else."""

import heapq
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat, Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
RECORD_LIMIT_BYTES = 2**30
DAMAGE = (McapError, struct.error, ValueError, OSError, OverflowError, MemoryError, RuntimeError, zstandard.ZstdError)
"""What reading a damaged MCAP file raises."""

_MCAP, _SQLITE3, _ZSTD = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_RECORD_HEADER_BYTES = 9
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_TOPIC = ("id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
_DEFINITION = ("topic_type", "encoding", "encoded_message_definition")

Note = Callable[[str], None]
"""Told of each damaged part, which is then left out, unless it raises."""

Stored = tuple[str, int, bytes]
"""Absolute topic, receive time in ns, CDR bytes."""


class McapFile:
    """An MCAP file, opened for reading.

    connections: its channels. start_ns, end_ns: of its messages' receive times; None without messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = path.open("rb")
        try:
            summary = SeekingReader(self._stream, record_size_limit=RECORD_LIMIT_BYTES).get_summary()
            if summary is None or summary.statistics is None or not summary.channels:
                summary = self._scan(summary.chunk_indexes if summary is not None else [])
        except BaseException:
            self.close()
            raise
        assert summary.statistics is not None
        self._chunks = sorted(summary.chunk_indexes, key=lambda index: index.message_start_time)
        self._channels, statistics = summary.channels, summary.statistics
        self.connections = [
            mcap_connection(channel, summary.schemas.get(channel.schema_id))._replace(
                msgcount=statistics.channel_message_counts.get(channel.id, 0)
            )
            for channel in self._channels.values()
        ]
        self.start_ns = statistics.message_start_time if statistics.message_count else None
        self.end_ns = statistics.message_end_time if statistics.message_count else None

    def close(self) -> None:
        self._stream.close()

    def in_time(self, topics: Collection[str], start_ns: int | None, note: Note) -> Iterator[Stored]:
        """Yield the messages of the topics from start_ns on in the order of their receive times."""
        ids, first_ns = self._ids(topics), start_ns if start_ns is not None else -1
        if not self._chunks:
            messages: Iterable[Stored] = self.in_file(topics, note)
            if goes_back([time_ns for _, time_ns, _ in self.in_file(topics, _ignore)]):
                messages = sorted(messages, key=lambda stored: stored[1])
            yield from (stored for stored in messages if stored[1] >= first_ns)
            return
        waiting = [
            index for index in reversed(self._chunks) if index.message_end_time >= first_ns and _may_hold(index, ids)
        ]
        ready: list[tuple[int, int, int, Message]] = []
        while waiting or ready:
            while waiting and (not ready or waiting[-1].message_start_time <= ready[0][0]):
                index = waiting.pop()
                for number, message in enumerate(self._messages(index, note)):
                    if message.channel_id in ids and message.log_time >= first_ns:
                        heapq.heappush(ready, (message.log_time, index.chunk_start_offset, number, message))
            if ready:
                message = heapq.heappop(ready)[-1]
                yield from plain(self.path, ids[message.channel_id], message.log_time, message.data, note)

    def in_file(self, topics: Collection[str], note: Note) -> Iterator[Stored]:
        """Yield the messages of the topics in the order of the file."""
        ids = self._ids(topics)
        for record in scan_mcap(self.path, note):
            if isinstance(record, Message) and record.channel_id in ids:
                yield from plain(self.path, ids[record.channel_id], record.log_time, record.data, note)

    def times(self, topic: str) -> list[int]:
        """The receive times of a topic, ns, in the order of the file."""
        if self._chunks and all(index.message_index_offsets for index in self._chunks):
            try:
                return self._indexed_times(self._ids([topic]))
            except DAMAGE:
                pass
        return [time_ns for _, time_ns, _ in self.in_file([topic], _ignore)]

    def _indexed_times(self, ids: Collection[int]) -> list[int]:
        times = list[int]()
        for index in sorted(self._chunks, key=lambda chunk: chunk.chunk_start_offset):
            entries = list[tuple[int, int]]()
            for offset in (at for channel, at in index.message_index_offsets.items() if channel in ids):
                self._stream.seek(offset + _RECORD_HEADER_BYTES)
                index_record = MessageIndex.read(ReadDataStream(self._stream))
                entries += [(place, time_ns) for time_ns, place in index_record.records]
            times += [time_ns for _, time_ns in sorted(entries)]
        return times

    def _ids(self, topics: Collection[str]) -> dict[int, str]:
        return {number: channel.topic for number, channel in self._channels.items() if channel.topic in topics}

    def _messages(self, index: ChunkIndex, note: Note) -> Iterator[Message]:
        """The messages of a chunk; none where it is damaged, which is noted."""
        try:
            self._stream.seek(index.chunk_start_offset + _RECORD_HEADER_BYTES)
            records = breakup_chunk(Chunk.read(ReadDataStream(self._stream)), validate_crc=True)
        except DAMAGE as error:
            note(_where(self.path, index.chunk_start_offset, error))
            return
        yield from (record for record in records if isinstance(record, Message))

    def _scan(self, chunks: list[ChunkIndex]) -> Summary:
        """The summary of a file that has none, from all of its records."""
        summary, counts, start_ns, end_ns = Summary(), Counter[int](), 2**63 - 1, 0
        summary.chunk_indexes = chunks
        for record in scan_mcap(self.path, _refuse):
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, Message):
                counts[record.channel_id] += 1
                start_ns, end_ns = min(start_ns, record.log_time), max(end_ns, record.log_time)
        summary.statistics = Statistics(
            attachment_count=0, channel_count=len(summary.channels), channel_message_counts=dict(counts),
            chunk_count=len(chunks), message_count=sum(counts.values()), message_start_time=start_ns,
            message_end_time=end_ns, metadata_count=0, schema_count=len(summary.schemas),
        )
        return summary


class Sqlite3File:
    """An sqlite3 file of rosbag2, opened for reading; as McapFile. Of whichever version: columns that it lacks are
    empty, and a definition that its recorder did not find is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        self._database = apsw.Connection(f"file:{quote(str(path))}?immutable=1", flags)
        try:
            self.connections = self._connections()
            bounds: Any = self._database.execute("SELECT MIN(timestamp), MAX(timestamp) FROM messages").fetchall()
            self.start_ns: int | None = bounds[0][0]
            self.end_ns: int | None = bounds[0][1]
        except BaseException:
            self.close()
            raise

    def _connections(self) -> list[Connection]:
        definitions = {
            name: MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
            for name, encoding, text in self._rows("message_definitions", *_DEFINITION)
        }
        counts = dict[int, int](self._database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
        return [
            Connection(
                number, topic, msgtype, definitions.get(msgtype, MessageDefinition(MessageDefinitionFormat.NONE, "")),
                digest, counts.get(number, 0), ConnectionExtRosbag2(serialization, qos_of(qos)), None,
            )
            for number, topic, msgtype, serialization, qos, digest in self._rows("topics", *_TOPIC)
        ]

    def _rows(self, table: str, *columns: str) -> Any:
        """The columns of a table in the order of its ids, "" for one that it lacks."""
        known = {row[1] for row in self._database.execute(f"PRAGMA table_info({table})")}
        if not known and table == "message_definitions":
            return ()
        chosen = ", ".join(column if column in known else "''" for column in columns)
        return self._database.execute(f"SELECT {chosen} FROM {table} ORDER BY id")

    def close(self) -> None:
        self._database.close()

    def in_time(self, topics: Collection[str], start_ns: int | None, note: Note) -> Iterator[Stored]:
        return self._select(topics, start_ns, "timestamp, id", note)

    def in_file(self, topics: Collection[str], note: Note) -> Iterator[Stored]:
        return self._select(topics, None, "id", note)

    def times(self, topic: str) -> list[int]:
        return [time_ns for _, time_ns, _ in self._select([topic], None, "id", _ignore, data="x''")]

    def _select(
        self, topics: Collection[str], start_ns: int | None, order: str, note: Note, *, data: str = "data"
    ) -> Iterator[Stored]:
        names = {connection.id: connection.topic for connection in self.connections if connection.topic in topics}
        query = (
            f"SELECT topic_id, timestamp, {data} FROM messages WHERE topic_id IN ({', '.join('?' * len(names))}) "
            f"AND timestamp >= ? ORDER BY {order}"
        )
        try:
            rows: Any = self._database.execute(query, (*names, start_ns if start_ns is not None else -1))
            for number, time_ns, content in rows:
                yield from plain(self.path, names[number], time_ns, content, note)
        except apsw.Error as error:
            note(f"{self.path.name}: {error}")


BagFile = McapFile | Sqlite3File


def open_file(path: Path, scratch: Path, note: Note) -> BagFile:
    """Open a file of a bag by what it begins with. scratch: a folder, into which a compressed one is unpacked.
    Raises what the reader of the format raises for a damaged file."""
    path = unpacked(path, scratch, note)
    if is_sqlite3(path):
        return Sqlite3File(path)
    return McapFile(path)


def unpacked(path: Path, scratch: Path, note: Note) -> Path:
    """The file itself, or what a file compressed by zstd holds, as a file in `scratch`; of an sqlite3 file whose newest
    messages its killed writer left beside it (WAL), a copy that holds them."""
    log = path.with_name(f"{path.name}-wal")
    if is_sqlite3(path) and log.is_file() and log.stat().st_size:
        copy = Path(shutil.copy(path, scratch))
        shutil.copy(log, scratch)
        with closing(apsw.Connection(str(copy))) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return copy
    if not _begins_with(path, _ZSTD):
        return path
    target = scratch / path.stem
    try:
        with path.open("rb") as packed, target.open("wb") as written:
            zstandard.ZstdDecompressor().copy_stream(packed, written)
    except zstandard.ZstdError as error:
        note(f"{path.name}: {error}")
    return target


def is_sqlite3(path: Path) -> bool:
    return _begins_with(path, _SQLITE3)


def plain(path: Path, topic: str, time_ns: int, data: bytes, note: Note) -> Iterator[Stored]:
    """The message, unpacked where its writer compressed each one (no CDR message begins like zstd); none if damaged."""
    try:
        content = zstandard.ZstdDecompressor().decompressobj().decompress(data) if data[:4] == _ZSTD else data
    except zstandard.ZstdError as error:
        note(f"{path.name}, message on {topic} at {time_ns} ns: {error}")
    else:
        yield topic, time_ns, content


def scan_mcap(path: Path, note: Note) -> Iterator[McapRecord]:
    """Yield the readable records of an MCAP file in its order, those of chunks too; complete or not."""
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=False, record_size_limit=RECORD_LIMIT_BYTES)
        records = reader.records
        while True:
            offset = stream.tell()
            try:
                record = next(records)
            except StopIteration:
                return
            except DAMAGE as error:
                note(_where(path, offset, error))
                return
            try:
                parts = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
            except DAMAGE as error:
                note(_where(path, offset, error))
                continue
            yield from parts


def mcap_connection(channel: Channel, schema: Schema | None) -> Connection:
    """A channel as rosbags describes a topic; digest: of its metadata, else of its definition."""
    encoding = schema.encoding if schema is not None else ""
    text = schema.data.decode(errors="replace") if schema is not None and encoding in _FORMATS else ""
    return Connection(
        id=channel.id, topic=channel.topic, msgtype=schema.name if schema is not None else "",
        msgdef=MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text),
        digest=channel.metadata.get("topic_type_hash", ""), msgcount=0,
        ext=ConnectionExtRosbag2(channel.message_encoding, qos_of(channel.metadata.get("offered_qos_profiles"))),
        owner=None,
    )


def qos_of(profiles: Any) -> list[Qos]:
    """Recorded QoS profiles, as YAML text or as what it says; none where they cannot be understood."""
    try:
        return parse_qos(profiles or [])
    except (ReaderError, KeyError, TypeError, AttributeError):
        return []


def goes_back(values: Sequence[int]) -> bool:
    return any(later < earlier for earlier, later in pairwise(values))


def _may_hold(index: ChunkIndex, ids: Collection[int]) -> bool:
    """Whether a chunk may hold messages of the channels; where its writer made no index, it may."""
    return not index.message_index_offsets or any(channel in ids for channel in index.message_index_offsets)


def _begins_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(magic)) == magic


def _where(path: Path, offset: int, error: BaseException) -> str:
    return f"{path.name} at byte {offset}: {error or type(error).__name__}"


def _refuse(problem: str) -> None:
    raise ValueError(problem)


def _ignore(problem: str) -> None:
    """Damage is noted where the messages are read."""
