"""Plain ROS bags of a robot, without wm_nodes: python plain_bags.py FOLDER. docs/tutorial.md trains on them.

A camera looks down on a table. Two joints move a red pointer. Somebody drives it to a green square, well or badly,
and stops where it is reached. plain_bags.yaml is the contract.
"""
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TOPICS = {
    "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage", "/joint_states": "sensor_msgs/msg/JointState",
    "/servo/delta_twist_cmds": "geometry_msgs/msg/TwistStamped", "/episode": "std_msgs/msg/Bool",
    "/success": "std_msgs/msg/Bool",
}
CAMERA, JOINTS, TWIST, EPISODE, SUCCESS = TOPICS
BAGS, EPISODES, TICK_S, SPEED_M_S, NEAR_M = 3, 80, 0.02, 0.6, 0.2
EMPTY = np.zeros(0)


def message(kind: str, **values: Any) -> Any:
    return STORE.types[kind](**values)


def header(time_ns: int) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id="table")


def twist(x: float, y: float) -> Any:
    linear, angular = (message("geometry_msgs/msg/Vector3", x=a, y=b, z=0.0) for a, b in ((x, y), (0.0, 0.0)))
    return message("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def picture(pointer_m: Any, square_m: Any) -> Any:
    """96 x 96 px, JPEG, of a table from -1 to 1 m."""
    drawn = np.full((96, 96, 3), 70, np.uint8)
    (column, row), tip = ((48 + 44 * place).astype(int).tolist() for place in (square_m, pointer_m))
    cv2.rectangle(drawn, (column - 10, row - 10), (column + 10, row + 10), (40, 200, 40), -1)
    cv2.circle(drawn, tip, 6, (40, 40, 255), -1)
    return np.asarray(cv2.imencode(".jpg", drawn)[1]).reshape(-1)


def record(path: Path, seed: int) -> None:
    rng, now = np.random.default_rng(seed), (1_760_000_000 + 1000 * seed) * 10**9
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in TOPICS.items()}

        def put(topic: str, **values: Any) -> None:
            filled = message(TOPICS[topic], **values)
            bag.write(connections[topic], now + 4_000_000, STORE.serialize_cdr(filled, TOPICS[topic]))

        for _ in range(EPISODES):
            pointer, square = rng.uniform((-0.8, -0.8), (-0.4, 0.8)), rng.uniform((0.4, -0.8), (0.8, 0.8))
            drift, care, speed, near = rng.uniform(-0.8, 0.8, 2), rng.choice([1.0, 1.0, 0.3, 0.0]), np.zeros(2), 0
            put(EPISODE, data=True)
            for tick in range(150):
                if tick % 5 == 0:
                    wanted = care * 2 * (square - pointer) + (1 - care) * drift + rng.normal(0, 0.15, 2)
                    speed = np.clip(wanted * (near == 0), -SPEED_M_S, SPEED_M_S)
                    put(TWIST, header=header(now), twist=twist(*speed))
                    put(CAMERA, header=header(now), format="jpeg", data=picture(pointer, square))
                put(JOINTS, header=header(now), name=["x", "y"], position=pointer, velocity=speed, effort=EMPTY)
                pointer, now = np.clip(pointer + TICK_S * speed, -1, 1), now + int(TICK_S * 1e9)
                near += int(near > 0 or np.abs(pointer - square).max() < NEAR_M)
                if near == 15:
                    break
            put(SUCCESS, data=near == 15)
            put(EPISODE, data=False)
            now += 2 * 10**9


if __name__ == "__main__":
    for number in range(BAGS):
        record(Path(sys.argv[1]) / f"bag_{number}", number)
