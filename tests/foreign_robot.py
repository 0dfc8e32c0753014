"""Plain bags of a robot that the product has never heard of: a dot driven by velocity commands, seen by two cameras,
with joints, a gripper and the operator's buttons, as rosbags' writer records them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from wm_nodes.recording.imported import __file__ as package

STORE = get_typestore(Stores.ROS2_JAZZY)
BEGIN_NS = 1_700_000_000 * 10**9
MS = 10**6
FRONT, WRIST, JOINTS = "/front/image_raw/compressed", "/wrist/image_raw", "/joint_states"
WIDTH, TWIST, GRIPPER, POSE = "/gripper/width", "/servo/delta_twist_cmds", "/gripper/command", "/cup/pose"
EXAMPLE = Path(package).with_name("example.yaml")

Message = tuple[int, str, Any]
"""Receive time in ns, topic, message."""


def message(msgtype: str, **values: Any) -> Any:
    return STORE.types[msgtype](**values)


def header(time_ns: int) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id="base")


def image(time_ns: int, picture: Any, encoding: str = "rgb8", padding: int = 0) -> Any:
    """sensor_msgs/Image of (H, W, C), with `padding` bytes behind each row."""
    rows = np.pad(picture.reshape(len(picture), -1), ((0, 0), (0, padding)), constant_values=7)
    return message(
        "sensor_msgs/msg/Image", header=header(time_ns), height=len(picture), width=picture.shape[1], encoding=encoding,
        is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1).view(np.uint8),
    )


def compressed(time_ns: int, picture: Any, kind: str = "jpeg") -> Any:
    data = np.asarray(cv2.imencode(f".{kind}", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]).reshape(-1)
    kind = f"rgb8; {kind} compressed bgr8"
    return message("sensor_msgs/msg/CompressedImage", header=header(time_ns), format=kind, data=data)


def joint_state(time_ns: int, **positions: float) -> Any:
    empty = np.zeros(0)
    return message("sensor_msgs/msg/JointState", header=header(time_ns), name=list(positions),
                   position=np.array(list(positions.values())), velocity=empty, effort=empty)


def twist(time_ns: int, x: float, y: float) -> Any:
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    parts = message("geometry_msgs/msg/Twist", linear=vector(x=x, y=y, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    return message("geometry_msgs/msg/TwistStamped", header=header(time_ns), twist=parts)


def pose(time_ns: int, x: float, y: float) -> Any:
    position = message("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    orientation = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    one = message("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    return message("geometry_msgs/msg/PoseStamped", header=header(time_ns), pose=one)


def numbers(*values: float) -> Any:
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return message("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(values))


def flag(value: bool) -> Any:
    return message("std_msgs/msg/Bool", data=value)


def seen(x: float, y: float, height: int = 96, width: int = 128) -> Any:
    """A white square of 16 px at x, y in [-1, 1], on grey."""
    picture = np.full((height, width, 3), 60, np.uint8)
    row, column = int((y + 1) / 2 * (height - 16)), int((x + 1) / 2 * (width - 16))
    picture[row : row + 16, column : column + 16] = 255
    return picture


@dataclass
class Run:
    """A recorded run: episodes of `seconds`, two seconds apart, every second one a success."""

    episodes: int = 2
    seconds: float = 2.0
    latency_ms: int = 5
    """Between stamp and reception."""
    seed: int = 0
    camera_hz: float = 20.0
    change: Callable[[list[Message]], list[Message]] = field(default=lambda messages: messages)
    """What is done to the messages before they are written."""

    def messages(self) -> list[Message]:
        rng, listed = np.random.default_rng(self.seed), list[Message]()

        def add(time_ns: int, topic: str, one: Any) -> None:
            listed.append((time_ns + self.latency_ms * MS, topic, one))

        now = BEGIN_NS
        add(now, GRIPPER, numbers(0.04))
        for episode in range(self.episodes):
            place, velocity = rng.uniform(-0.5, 0.5, 2), np.zeros(2)
            now += 2000 * MS
            end = now + int(self.seconds * 1e9)
            add(now, "/episode", flag(True))
            for step, time_ns in enumerate(range(now - 100 * MS, end, 10 * MS)):
                if time_ns >= now and step % 4 == 0:
                    velocity = rng.uniform(-0.1, 0.1, 2)
                    add(time_ns, TWIST, twist(time_ns, *velocity.tolist()))
                place = np.clip(place + 0.05 * velocity, -1, 1)
                if step % 2 == 0:
                    add(time_ns, JOINTS, joint_state(time_ns, j2=float(place[1]), j1=float(place[0]), other=9.0))
                    add(time_ns, POSE, pose(time_ns, *place.tolist()))
                if step % round(100 / self.camera_hz) == 0:
                    add(time_ns, FRONT, compressed(time_ns, seen(*place)))
                    add(time_ns, WRIST, image(time_ns, seen(*-place, 64, 64)[..., ::-1], "bgr8", padding=5))
                if step % 50 == 0:
                    add(time_ns, WIDTH, numbers(0.03))
            add(end, "/episode", flag(False))
            add(end + 300 * MS, "/success", flag(episode % 2 == 0))
            now = end
        return listed

    def write(
        self, path: Path, plugin: StoragePlugin = StoragePlugin.MCAP, mode: CompressionMode = CompressionMode.NONE
    ) -> Path:
        write(path, self.change(self.messages()), plugin, mode)
        return path


def write(
    path: Path, messages: list[Message], plugin: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE, *, as_listed: bool = False,
) -> None:
    """A bag of the messages, as rosbags writes it. as_listed: in their order, not in that of time."""
    writer, connections = Writer(path, version=9, storage_plugin=plugin), dict[str, Any]()
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for time_ns, topic, one in messages if as_listed else sorted(messages, key=lambda each: each[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, one.__msgtype__, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_cdr(one, one.__msgtype__))


def contract_file(path: Path, **changes: Any) -> Path:
    """The example contract with other values. changes: names with __ for dots, episodes__min_steps; None: left out."""
    values = yaml.safe_load(EXAMPLE.read_text(encoding="utf-8"))
    for dotted, value in changes.items():
        *parents, last = [int(name) if name.isdigit() else name for name in dotted.split("__")]
        section = values
        for name in parents:
            section = section[name]
        if value is None:
            del section[last]
        else:
            section[last] = value
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path
