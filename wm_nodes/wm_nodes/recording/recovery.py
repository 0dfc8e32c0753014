"""Bring back a recording whose process was killed: every complete message into a new, proper bag.

As a command: wm recover-bag. The original stays as it is.
"""

import json
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import apsw
from mcap.records import Channel, Message, Metadata, Schema
from rosbags.interfaces import Connection

from wm_nodes.recording import storage
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.raw import EPISODE_RECORD, EPISODE_TABLE, PARTIAL_SUFFIX, START_RECORD, RawBagWriter
from wm_nodes.recording.storage import Note


@dataclass(frozen=True)
class RecoverReport:
    """What came back."""

    source: Path
    """What was read."""
    bag: Path
    """What was written."""
    messages: int
    """How many came back."""
    topics: dict[str, int]
    """How many of each topic."""
    damaged: list[str]
    """A line per unreadable chunk or end of a file, with its offset, and per topic that cannot be copied."""

    def text(self) -> str:
        lines = [f"recovered {self.messages} messages of {self.source} into {self.bag}"]
        lines += [f"  {count:8d}  {name}" for name, count in sorted(self.topics.items())]
        return "\n".join(lines + [f"  cut off: {line}" for line in self.damaged])


def recover(path: Path, *, output: Path | None = None) -> RecoverReport:
    """Write all complete messages of an unfinished or damaged bag of any writer into a new bag, in the order of the
    files. Message definitions are copied as they are; whether they are ours is for the reader to say.

    Args:
        path: the `.partial` folder, a bag folder with damaged files, or one .mcap or .db3 file.
        output: the new bag; by default `<name>_recovered` beside it, where <name> is without `.partial`.

    Raises:
        BagError: nothing to read at `path`, no complete message in it, or `output` exists.
    """
    path = Path(path)
    listed = (file for file in path.iterdir() if file.name.endswith(storage.SUFFIXES)) if path.is_dir() else (path,)
    files = sorted(listed, key=_file_number)
    if not files or not files[0].is_file():
        raise BagError(f"no .mcap file at {path}, nor a .db3 file; give the .partial folder, a bag folder or a file")
    target = output if output is not None else _default_output(path)
    damaged: list[str] = []
    writer, rows = RawBagWriter(target, custom={"wm.recovered_from": str(path)}), list[dict[str, Any]]()
    try:
        with TemporaryDirectory(prefix="wm_bag_") as scratch:
            for file in files:
                plain = storage.unpacked(file, Path(scratch), damaged.append)
                if storage.is_sqlite3(plain):
                    _copy_rows(plain, writer, damaged.append)
                else:
                    _copy_records(plain, writer, rows, damaged.append)
        if not writer.messages:
            raise BagError(f"{path} holds no complete message; nothing to recover ({'; '.join(damaged) or 'empty'})")
    except BaseException:
        writer.abort(remove=True)
        raise
    if rows:
        table = {"columns": [*rows[0]], "rows": [[*row.values()] for row in rows]}
        writer.custom[EPISODE_TABLE] = json.dumps(table)
    writer.custom["wm.recover_report_json"] = json.dumps({"damaged": damaged})
    counts = {name: info.messages for name, info in writer.topics.items()}
    messages = writer.messages
    return RecoverReport(path, writer.close(), messages, counts, damaged)


def _copy_records(file: Path, writer: RawBagWriter, rows: list[dict[str, Any]], note: Note) -> None:
    """rows: gets those of the episodes, see raw.EPISODE_RECORD."""
    schemas: dict[int, Schema] = {}
    names: dict[int, str] = {}
    for record in storage.scan_mcap(file, note):
        if isinstance(record, Metadata) and record.name == START_RECORD:
            for key, value in record.metadata.items():
                writer.custom.setdefault(key, value)
        elif isinstance(record, Metadata) and record.name == EPISODE_RECORD:
            rows.append(json.loads(record.metadata["row"]))
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if _copy_topic(storage.mcap_connection(record, schemas.get(record.schema_id)), writer, note):
                names[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in names:
            topic, sent_ns = names[record.channel_id], record.publish_time
            for _, time_ns, data in storage.plain(file, topic, record.log_time, record.data, note):
                writer.write(topic, data, time_ns, sent_ns)


def _copy_rows(file: Path, writer: RawBagWriter, note: Note) -> None:
    try:
        with closing(storage.Sqlite3File(file)) as opened:
            names = [c.topic for c in opened.connections if _copy_topic(c, writer, note)]
            for topic, time_ns, data in opened.in_file(names, note):
                writer.write(topic, data, time_ns)
    except (apsw.Error, UnicodeDecodeError) as error:
        note(f"{file.name}: {error}")


def _copy_topic(recorded: Connection, writer: RawBagWriter, note: Note) -> bool:
    try:
        writer.copy_topic(recorded)
    except BagError as error:
        note(f"left out: {error}")
        return False
    return True


def _default_output(path: Path) -> Path:
    path = path.absolute() if path == Path() else path
    if path.name.endswith(PARTIAL_SUFFIX):
        final = path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))
        return final.with_name(f"{final.name}_recovered")
    return path.with_name(f"{path.name.partition('.')[0] if path.is_file() else path.name}_recovered")


def _file_number(file: Path) -> tuple[int, str]:
    tail = file.name.partition(".")[0].rpartition("_")[2]
    return (int(tail) if tail.isdigit() else 0), file.name
