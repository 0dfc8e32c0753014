"""Open a bag for reading, with one clear error for each way in which it can be unusable."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from itertools import chain, dropwhile, pairwise
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from wm_nodes.config.load import read_yaml
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.recording import storage, topics
from wm_nodes.recording.cdr import session_and_seq
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import deserialize, spec_from_json, spec_of
from wm_nodes.recording.raw import EPISODE_TABLE, PARTIAL_SUFFIX
from wm_nodes.recording.typestore import other_type

METADATA = "metadata.yaml"
KNOWN_VERSION = 9
"""The newest version of metadata.yaml that is known; a later one is read all the same while it has what is needed."""

SEQUENCED_TYPES = {topic.msgtype for topic in (*topics.ALL_TOPICS, *topics.VIDEO_TOPICS) if topic.sequenced}


def is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 folder, or one file of it, by its names."""
    if not path.is_dir():
        return path.name.endswith(storage.SUFFIXES)
    return (path / METADATA).exists() or any(file.name.endswith(storage.SUFFIXES) for file in path.iterdir())


class Bag:
    """A complete rosbag2 folder (or one file of it) of any writer, opened for reading; use as a context manager.

    Raises:
        BagError: missing, unfinished, damaged, or written with other message definitions.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        recover = "run `wm recover-bag {}` and read the bag that it writes"
        if not self.path.exists():
            partial = self.path.with_name(self.path.name + PARTIAL_SUFFIX)
            if partial.exists():
                raise BagError(f"bag {self.path} was never completed (recorder killed?); {recover.format(partial)}")
            raise BagError(f"no bag at {self.path}; give the folder that holds {METADATA}")
        if self.path.is_dir() and not (self.path / METADATA).exists():
            raise BagError(f"{self.path} has no {METADATA} (recorder killed?); {recover.format(self.path)}")
        self._recover = recover.format(self.path)
        self._information: dict[str, Any] = {}
        with ExitStack() as stack:
            try:
                self._information.update(_information(self.path))
                scratch = Path(stack.enter_context(TemporaryDirectory(prefix="wm_bag_")))
                self._files = list[storage.BagFile]()
                for file in _files(self.path, self._information):
                    self._files.append(storage.open_file(file, scratch, self._refuse))
                    stack.callback(self._files[-1].close)
                self.connections = _connections(self._information, self._files)
            except BagError:
                raise
            except Exception as error:
                problem = " ".join(str(error).split()).partition("; ")[0]
                raise self._later_version(problem) or self._damaged(problem) from error
            self._close = stack.pop_all().close

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    @property
    def custom(self) -> dict[str, str]:
        """custom_data of metadata.yaml."""
        custom = self._information.get("custom_data")
        return dict(custom) if isinstance(custom, Mapping) else {}

    @property
    def start_ns(self) -> int:
        """Receive time of the first message, ns; 0 in an empty bag."""
        return min((file.start_ns for file in self._files if file.start_ns is not None), default=0)

    @property
    def end_ns(self) -> int:
        """Receive time of the last message, ns; 0 in an empty bag."""
        return max((file.end_ns for file in self._files if file.end_ns is not None), default=0)

    def count(self, topic: str) -> int:
        """Messages recorded on an absolute topic name."""
        return sum(connection.msgcount for connection in self.connections if connection.topic == topic)

    def serialization(self, topic: str) -> str:
        """Of the messages of a topic; cdr in a bag of ROS 2, empty without the topic."""
        exts = [c.ext for c in self.connections if c.topic == topic]
        return next((ext.serialization_format for ext in exts if isinstance(ext, ConnectionExtRosbag2)), "")

    def set_back_ns(self, topic: str) -> int:
        """By how much the clock of its recorder was set back at most, as the receive times of a topic show, ns."""
        falls = (earlier - later for file in self._files for earlier, later in pairwise(file.times(topic)))
        return max(falls, default=0)

    def namespace(self, wanted: str | None) -> str:
        """The namespace of the environment to read: `wanted`, or the only one; among several the one that the others
        lie below (/wm before /wm/sim), else /wm."""
        suffix = f"/{topics.TRANSITION.name}"
        names = sorted({c.topic.removesuffix(suffix) for c in self.connections if c.topic.endswith(suffix)})
        is_root = bool(names) and all(name.startswith(f"{names[0]}/") for name in names[1:])
        choice = wanted if wanted is not None else names[0] if is_root else topics.DEFAULT_NAMESPACE
        if choice not in names:
            raise BagError(
                f"bag {self.path} has no {choice}{suffix}; environments recorded: {names or 'none'}; "
                f"topics: {sorted({c.topic for c in self.connections})}; plain bags of a robot: wm import rosbag"
            )
        return choice

    def messages(
        self, names: Collection[str] = (), *, start_ns: int | None = None, damaged: list[str] | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (absolute topic, receive time in ns, CDR bytes) in time order, or in the file's (see in_file_order).

        Args:
            names: absolute topics; empty takes all.
            start_ns: begin with the first message that was received then or later.
            damaged: given, parts that cannot be read are left out and named there; else they raise.
        """
        wanted = {c.topic for c in self.connections if not names or c.topic in names}
        note = self._refuse if damaged is None else damaged.append
        try:
            if self.in_file_order:
                stored = chain.from_iterable(file.in_file(wanted, note) for file in self._files)
                yield from dropwhile(lambda each: start_ns is not None and each[1] < start_ns, stored)
            else:
                yield from chain.from_iterable(file.in_time(wanted, start_ns, note) for file in self._files)
        except BagError:
            raise
        except Exception as error:
            raise self._damaged(str(error) or type(error).__name__) from error

    @cached_property
    def in_file_order(self) -> bool:
        """Whether messages come in the order of the file, not of time: the clock of its recorder was set back, and
        sequence numbers rise in the file's order, or fall less often there."""
        falls_in_file = falls_in_time = 0
        for file in self._files:
            for topic in {c.topic for c in file.connections if c.msgtype in SEQUENCED_TYPES}:
                if storage.goes_back(file.times(topic)):
                    falls_in_file += _falls(data for *_, data in file.in_file([topic], lambda problem: None))
                    falls_in_time += _falls(data for *_, data in file.in_time([topic], None, lambda problem: None))
        return falls_in_file < falls_in_time

    def _later_version(self, problem: str) -> BagError | None:
        version = self._information.get("version")
        if not isinstance(version, int) or version <= KNOWN_VERSION:
            return None
        return BagError(
            f"{self.path / METADATA} has version {version}, and {KNOWN_VERSION} is the newest known here: {problem}; "
            f"name one of the bag's files instead of the folder, or {self._recover}"
        )

    def _damaged(self, problem: str) -> BagError:
        return BagError(f"bag {self.path} is damaged: {problem}; {self._recover}")

    def _refuse(self, problem: str) -> None:
        raise self._damaged(problem)

    def decode(self, data: bytes, msgtype: str) -> Any:
        try:
            return deserialize(data, msgtype)
        except Exception as error:
            raise BagError(
                f"bag {self.path} holds a {msgtype} that cannot be decoded: {error}; {self._recover}"
            ) from error

    def check_types(self, names: Collection[str]) -> None:
        """Refuse a bag in which one of the topics has another message definition than ours (RIHS01 hash)."""
        for connection in self.connections:
            if connection.topic in names and (difference := other_type(connection)):
                raise BagError(
                    f"bag {self.path} was recorded with {difference} on {connection.topic}; read it with the version "
                    f"of {connection.msgtype.partition('/')[0]} that wrote it"
                )

    def spec(self, namespace: str) -> tuple[EnvironmentSpec, Tiles]:
        """The environment's spec and mosaic layout, from env/spec (with all digits where wm.spec_json says the same).

        Raises:
            BagError: no env/spec recorded, two different ones, or a spec_hash that does not fit the fields.
        """
        name = topics.absolute(namespace, topics.SPEC)
        self.check_types([name])
        first: tuple[EnvironmentSpec, Tiles, str] | None = None
        for _, _, data in self.messages([name]) if self.count(name) else ():
            message = self.decode(data, topics.SPEC.msgtype)
            if first is None:
                first = (*spec_of(message), message.spec_hash)
            elif first[2] != message.spec_hash:
                raise BagError(f"bag {self.path} holds two environments on {name}; record each in its own bag")
        if first is None:
            raise BagError(f"bag {self.path} has no message on {name}; start the recorder with that topic")
        spec, tiles, recorded_hash = first
        if spec.spec_hash == recorded_hash:
            exact = self._exact_spec()
            return (exact if exact is not None and exact.spec_hash == recorded_hash else spec), tiles
        raise BagError(
            f"env/spec in {self.path} says spec_hash {recorded_hash[:12]} but its fields give {spec.spec_hash[:12]}; "
            "the bag was written by another version of wm_nodes"
        )

    def _exact_spec(self) -> EnvironmentSpec | None:
        text = self.custom.get("wm.spec_json")
        return spec_from_json(text) if text else None

    def episode_table(self) -> list[dict[str, Any]]:
        """Rows of EPISODE_TABLE; empty where the bag has none (live recording)."""
        text = self.custom.get(EPISODE_TABLE)
        if not text:
            return []
        table = json.loads(text)
        return [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]


def _information(path: Path) -> Mapping[str, Any]:
    """What metadata.yaml of a bag folder says; empty for one file of a bag."""
    if not path.is_dir():
        return {}
    information = read_yaml(path / METADATA).get("rosbag2_bagfile_information")
    if not isinstance(information, Mapping):
        raise ValueError(f"{path / METADATA} has no rosbag2_bagfile_information")
    return information


def _files(path: Path, information: Mapping[str, Any]) -> list[Path]:
    if not path.is_dir():
        return [path]
    if not isinstance(names := information.get("relative_file_paths"), list):
        raise ValueError(f"{path / METADATA} has no relative_file_paths")
    files = [path / PurePath(name).name for name in names]
    if missing := [file.name for file in files if not file.is_file()]:
        raise FileNotFoundError(f"{METADATA} names {', '.join(missing)}, missing in the folder")
    return files


def _connections(information: Mapping[str, Any], files: Sequence[storage.BagFile]) -> list[Connection]:
    """The topics of a bag: named as in metadata.yaml and its files, with the messages that the files hold."""
    connections: dict[tuple[str, str], Connection] = {}
    rows = [row["topic_metadata"] for row in information.get("topics_with_message_count") or ()]
    announced = (
        Connection(
            0, row["name"], row["type"], MessageDefinition(MessageDefinitionFormat.NONE, ""),
            row.get("type_description_hash") or "", 0,
            ConnectionExtRosbag2(row["serialization_format"], storage.qos_of(row.get("offered_qos_profiles"))), None,
        )
        for row in rows
    )
    for connection in chain(announced, *(file.connections for file in files)):
        known = connections.setdefault((connection.topic, connection.msgtype), connection)
        if known is not connection:
            assert isinstance(known.ext, ConnectionExtRosbag2)
            connections[connection.topic, connection.msgtype] = known._replace(
                msgcount=known.msgcount + connection.msgcount, digest=known.digest or connection.digest,
                msgdef=connection.msgdef if known.msgdef.format is MessageDefinitionFormat.NONE else known.msgdef,
                ext=known.ext if known.ext.offered_qos_profiles else connection.ext,
            )
    return list(connections.values())


def _falls(sequenced: Iterator[bytes]) -> int:
    """How often the sequence number of a session is lower than the one before."""
    falls, newest = 0, dict[int, int]()
    for data in sequenced:
        try:
            session, seq = session_and_seq(data)
        except ValueError:
            continue
        falls += seq < newest.get(session, 0)
        newest[session] = seq
    return falls
