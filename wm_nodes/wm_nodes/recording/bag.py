"""Open a bag for reading, with one clear error for each way in which it can be unusable."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from wm_nodes.config.load import ConfigError, read_yaml
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.recording import topics
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import deserialize, spec_from_json, spec_of
from wm_nodes.recording.raw import PARTIAL_SUFFIX
from wm_nodes.recording.typestore import type_hash


class Bag:
    """A complete rosbag2 folder (or one .mcap file of it), opened for reading; use as a context manager.

    Raises:
        BagError: missing, unfinished, damaged, or written with other message definitions.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        recover = "run `wm recover-bag {}` and read the bag that it writes"
        partial = self.path.with_name(self.path.name + PARTIAL_SUFFIX)
        if not self.path.exists():
            if partial.exists():
                raise BagError(f"bag {self.path} was never completed (recorder killed?); {recover.format(partial)}")
            raise BagError(f"no bag at {self.path}; give the folder that holds metadata.yaml")
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            raise BagError(f"{self.path} has no metadata.yaml (recorder killed?); {recover.format(self.path)}")
        try:
            self._reader = Reader(self.path)
            self._reader.open()
        except Exception as error:
            problem = _problem(self.path / "metadata.yaml") or " ".join(str(error).split())
            raise BagError(f"bag {self.path} is damaged: {problem}; {recover.format(self.path)}") from error
        self._recover = recover.format(self.path)

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *error: object) -> None:
        self._reader.close()

    @property
    def custom(self) -> dict[str, str]:
        """custom_data of metadata.yaml."""
        return dict(self._reader.storage.metadata.custom or {})

    @property
    def connections(self) -> list[Connection]:
        return self._reader.connections

    @property
    def start_ns(self) -> int:
        """Receive time of the first message, ns; 0 in an empty bag."""
        return self._reader.start_time if self._reader.message_count else 0

    @property
    def end_ns(self) -> int:
        """Receive time of the last message, ns; 0 in an empty bag."""
        return self._reader.end_time - 1 if self._reader.message_count else 0

    def count(self, topic: str) -> int:
        """Messages recorded on an absolute topic name."""
        return sum(connection.msgcount for connection in self.connections if connection.topic == topic)

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
                f"topics: {sorted({c.topic for c in self.connections})}"
            )
        return choice

    def messages(self, names: Sequence[str] = (), *, start_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield (absolute topic, receive time in ns, CDR bytes) in time order; all topics when `names` is empty."""
        connections = [c for c in self.connections if not names or c.topic in names]
        if not connections:
            return
        stream = self._reader.messages(connections, start=start_ns)
        while True:
            try:
                connection, time_ns, data = next(stream)
            except StopIteration:
                return
            except Exception as error:
                raise BagError(f"bag {self.path} is damaged: {error}; {self._recover}") from error
            yield connection.topic, time_ns, data

    def decode(self, data: bytes, msgtype: str) -> Any:
        try:
            return deserialize(data, msgtype)
        except Exception as error:
            raise BagError(
                f"bag {self.path} holds a {msgtype} that cannot be decoded: {error}; {self._recover}"
            ) from error

    def check_types(self) -> None:
        """Refuse a bag whose message definitions differ from ours (RIHS01 hash)."""
        for connection in self.connections:
            if connection.msgtype.startswith("wm_msgs/") and connection.digest:
                expected = type_hash(connection.msgtype)
                if connection.digest != expected:
                    raise BagError(
                        f"bag {self.path} was recorded with another {connection.msgtype} ({connection.digest}, ours is "
                        f"{expected}); read it with the wm_msgs version that wrote it"
                    )

    def spec(self, namespace: str) -> tuple[EnvironmentSpec, Tiles]:
        """The environment's spec and mosaic layout, from env/spec (with all digits where wm.spec_json says the same).

        Raises:
            BagError: no env/spec recorded, two different ones, or a spec_hash that does not fit the fields.
        """
        name = topics.absolute(namespace, topics.SPEC)
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
        """Rows of wm.episode_table_json; empty where the bag has none (live recording, recovered bag)."""
        text = self.custom.get("wm.episode_table_json")
        if not text:
            return []
        table = json.loads(text)
        return [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]


def _problem(metadata: Path) -> str:
    """Why metadata.yaml of a bag folder cannot be read, with its line; '' where it can, and for an .mcap file."""
    if metadata.exists():
        try:
            read_yaml(metadata)
        except ConfigError as error:
            return str(error).partition("; ")[0]
    return ""
