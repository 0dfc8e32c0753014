"""metadata.yaml of a rosbag2 folder, version 9 (Jazzy), as rosbag2 and rosbags read it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

VERSION = 9
ROS_DISTRO = "jazzy"


@dataclass
class TopicInfo:
    """One recorded topic and its number of messages."""

    name: str
    """Absolute."""
    msgtype: str
    """E.g. wm_msgs/msg/EnvSpec."""
    type_hash: str
    """RIHS01."""
    qos: tuple[Qos, ...]
    """Of its publishers."""
    messages: int = 0
    """How many there are."""


@dataclass
class FileInfo:
    """One .mcap file of a bag."""

    name: str
    """Within the folder."""
    start_ns: int = 2**63 - 1
    """Receive time of the first message; later than end_ns while there is none."""
    end_ns: int = 0
    """Receive time of the last message."""
    messages: int = 0
    """How many there are."""
    topic_messages: dict[str, int] = field(default_factory=dict)
    """How many of each topic."""

    def count(self, topic: str, time_ns: int) -> None:
        self.start_ns = min(self.start_ns, time_ns)
        self.end_ns = max(self.end_ns, time_ns)
        self.messages += 1
        self.topic_messages[topic] = self.topic_messages.get(topic, 0) + 1

    @property
    def duration_ns(self) -> int:
        return max(0, self.end_ns - self.start_ns)


def qos_text(qos: Sequence[Qos]) -> str:
    """QoS profiles as the YAML list that MCAP channels carry in `offered_qos_profiles`."""
    return str(yaml.safe_dump(dump_qos_v9(list(qos)), sort_keys=False)) if qos else ""


def metadata_text(
    topics: Sequence[TopicInfo], files: Sequence[FileInfo], custom: Mapping[str, str], *, nested: bool = True
) -> str:
    """Return metadata.yaml, or with nested=False the inner mapping that an MCAP `rosbag2` metadata record carries."""
    used = [info for info in files if info.messages]
    start = min((info.start_ns for info in used), default=0)
    end = max((info.end_ns for info in used), default=0)
    information: dict[str, Any] = {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(info.messages for info in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": dump_qos_v9(list(topic.qos)),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.messages,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [info.name for info in files],
        "files": [
            {
                "path": info.name,
                "starting_time": {"nanoseconds_since_epoch": info.start_ns if info.messages else 0},
                "duration": {"nanoseconds": info.duration_ns},
                "message_count": info.messages,
            }
            for info in files
        ],
        "custom_data": dict(custom) or None,
        "ros_distro": ROS_DISTRO,
    }
    content = {"rosbag2_bagfile_information": information} if nested else information
    return str(yaml.safe_dump(content, sort_keys=False, width=2**31 - 1, allow_unicode=True))
