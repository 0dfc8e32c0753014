"""Bring back a recording whose process was killed: every complete message into a new, proper bag.

As a command: wm recover-bag. The original stays as it is.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.rosbag2.metadata import parse_qos
from zstandard import ZstdError

from wm_nodes.recording.errors import BagError
from wm_nodes.recording.raw import PARTIAL_SUFFIX, START_RECORD, RawBagWriter
from wm_nodes.recording.typestore import message_definition

RECORD_LIMIT_BYTES = 2**30


@dataclass(frozen=True)
class RecoverReport:
    """What came back. damaged: one line per unreadable chunk or end of a file, with its offset."""

    source: Path
    bag: Path
    messages: int
    topics: dict[str, int]
    damaged: list[str]

    def text(self) -> str:
        lines = [f"recovered {self.messages} messages of {self.source} into {self.bag}"]
        lines += [f"  {count:8d}  {name}" for name, count in sorted(self.topics.items())]
        return "\n".join(lines + [f"  cut off: {line}" for line in self.damaged])


def recover(path: Path, *, output: Path | None = None) -> RecoverReport:
    """Write all complete messages of an unfinished or damaged bag into a new bag, in the order of the files.

    Args:
        path: the `.partial` folder, a bag folder with damaged files, or one .mcap file.
        output: the new bag; by default the final name the recorder would have used, else `<name>_recovered`.

    Raises:
        BagError: nothing to read at `path`, no complete message in it, or `output` exists.
    """
    path = Path(path)
    files = sorted(path.glob("*.mcap"), key=_file_number) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise BagError(f"no .mcap file at {path}; give the .partial folder, a bag folder or an .mcap file")
    target = output if output is not None else _default_output(path)
    damaged: list[str] = []
    scans = [_Scan(file, damaged) for file in files]
    writer = RawBagWriter(target, custom={"wm.recovered_from": str(path)})
    try:
        for scan in scans:
            _copy(scan, writer)
        if not writer.messages:
            raise BagError(f"{path} holds no complete message; nothing to recover ({'; '.join(damaged) or 'empty'})")
    except BaseException:
        writer.abort(remove=True)
        raise
    writer.custom["wm.recover_report_json"] = json.dumps({"damaged": damaged})
    counts = {name: info.messages for name, info in writer.topics.items()}
    messages = writer.messages
    return RecoverReport(path, writer.close(), messages, counts, damaged)


class _Scan:
    """The readable records of one file, in order; notes where and why it ends early."""

    def __init__(self, file: Path, damaged: list[str]) -> None:
        self.file, self._damaged = file, damaged

    def __iter__(self) -> Iterator[McapRecord]:
        with self.file.open("rb") as stream:
            reader = StreamReader(stream, emit_chunks=True, validate_crcs=False, record_size_limit=RECORD_LIMIT_BYTES)
            records = reader.records
            while True:
                offset = stream.tell()
                try:
                    record = next(records)
                except StopIteration:
                    return
                except (McapError, struct.error, ValueError, OSError) as error:
                    self._note(offset, error)
                    return
                try:
                    parts = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
                except (McapError, struct.error, ValueError, ZstdError) as error:
                    self._note(offset, error)
                    continue
                yield from parts

    def _note(self, offset: int, error: Exception) -> None:
        self._damaged.append(f"{self.file.name} at byte {offset}: {error or type(error).__name__}")


def _copy(scan: _Scan, writer: RawBagWriter) -> None:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in scan:
        if isinstance(record, Metadata) and record.name == START_RECORD:
            for key, value in record.metadata.items():
                writer.custom.setdefault(key, value)
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
            _add_topic(writer, record, schemas, scan.file)
        elif isinstance(record, Message) and record.channel_id in channels:
            writer.write(channels[record.channel_id].topic, record.data, record.log_time, record.publish_time)


def _add_topic(writer: RawBagWriter, channel: Channel, schemas: dict[int, Schema], file: Path) -> None:
    if channel.topic in writer.topics:
        return
    schema = schemas.get(channel.schema_id)
    if schema is None:
        raise BagError(f"{file}: topic {channel.topic} has no message definition; the file is not one of ours")
    if schema.name.startswith("wm_msgs/") and schema.data.decode() != message_definition(schema.name):
        raise BagError(
            f"{file} was recorded with another version of {schema.name}; recover it with the wm_msgs that wrote it"
        )
    qos: Any = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
    writer.add_topic(channel.topic, schema.name, qos)


def _default_output(path: Path) -> Path:
    if path.name.endswith(PARTIAL_SUFFIX):
        final = path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))
        return final.with_name(f"{final.name}_recovered")
    return path.with_name(f"{path.stem if path.is_file() else path.name}_recovered")


def _file_number(file: Path) -> tuple[int, str]:
    tail = file.stem.rpartition("_")[2]
    return (int(tail) if tail.isdigit() else 0), file.name
