"""Messages of the wire as rosbags objects, from and to our types. No rclpy. Shapes: N environments, A action, S state,
P ground truth."""

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import EnvironmentSpec, as_sent, spec_of_values, spec_values
from wm_nodes.core.types import UInt8Array
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.typestore import typestore

NS_PER_S = 1_000_000_000
BASE_FRAME = "wm_base"

KIND_START, KIND_END = 0, 1
OUTCOME_UNKNOWN, OUTCOME_SUCCESS, OUTCOME_FAILURE = 0, 1, 2
REASON_NONE, REASON_TERMINAL, REASON_TIME_LIMIT, REASON_UNCERTAINTY, REASON_RESET = 0, 1, 2, 3, 4


def message_type(name: str) -> Any:
    """The rosbags class of a message type, e.g. wm_msgs/msg/TransitionBatch."""
    return typestore().types[name]


def stamp(time_ns: int) -> Any:
    return message_type("builtin_interfaces/msg/Time")(sec=time_ns // NS_PER_S, nanosec=time_ns % NS_PER_S)


def stamp_ns(time: Any) -> int:
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def header(time_ns: int, frame_id: str) -> Any:
    return message_type("std_msgs/msg/Header")(stamp=stamp(time_ns), frame_id=frame_id)


def serialize(message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def deserialize(data: bytes | memoryview, msgtype: str) -> Any:
    return typestore().deserialize_cdr(data, msgtype)


def image_message(mosaic: UInt8Array, time_ns: int, *, encoding: str = "rgb8") -> Any:
    """sensor_msgs/Image of an uint8 (H, W, 3) mosaic."""
    height, width, channels = mosaic.shape
    return message_type("sensor_msgs/msg/Image")(
        header=header(time_ns, BASE_FRAME), height=height, width=width, encoding=encoding, is_bigendian=0,
        step=width * channels, data=np.ascontiguousarray(mosaic).reshape(-1),
    )


def mosaic_of(message: Any, spec: EnvironmentSpec, tiles: Tiles, *, where: str) -> UInt8Array:
    """uint8 (H, W, 3) view of a sensor_msgs/Image after checking its encoding, size and step against the spec."""
    height, width = tiles.mosaic_shape
    expected = {"encoding": spec.encoding, "height": height, "width": width, "step": width * spec.channels}
    given = {name: getattr(message, name) for name in expected}
    if given != expected:
        wrong = ", ".join(f"{k} {given[k]!r} instead of {expected[k]!r}" for k in expected if given[k] != expected[k])
        raise BagError(
            f"image at stamp {stamp_ns(message.header.stamp)} in {where} has {wrong}; the bag's env/spec describes "
            "another camera or layout, so record spec and images from the same environment"
        )
    if len(message.data) != height * width * spec.channels:
        raise BagError(f"image in {where} has {len(message.data)} bytes instead of {height * width * spec.channels}")
    return np.asarray(message.data, np.uint8).reshape(height, width, spec.channels)


def spec_fields(spec: EnvironmentSpec) -> dict[str, Any]:
    """The fields of wm_msgs/EnvSpec but header, session, seq and tile; numbers per action or state as arrays."""
    values = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(spec).items()}
    del values["control_period_s"]
    ones = np.ones(spec.action_dim, np.float32)
    return values | {
        "action_dim": spec.action_dim, "action_low": -ones, "action_high": ones,
        "action_scale": np.asarray(spec.action_scale, np.float32), "state_dim": spec.state_dim,
        "state_low": np.asarray(spec.state_low, np.float32), "state_high": np.asarray(spec.state_high, np.float32),
        "control_period": float(np.float32(spec.control_period_s)), "spec_hash": spec.spec_hash,
    }


def spec_message(spec: EnvironmentSpec, time_ns: int, session: int) -> Any:
    """wm_msgs/EnvSpec of a spec."""
    layout = message_type("wm_msgs/msg/TileLayout")(**asdict(Tiles.of(spec.num_envs, spec.height, spec.width)))
    return message_type("wm_msgs/msg/EnvSpec")(
        header=header(time_ns, BASE_FRAME), session=session, seq=0, tile=layout, **spec_fields(spec)
    )


def spec_of(message: Any) -> tuple[EnvironmentSpec, Tiles]:
    """Rebuild the spec from wm_msgs/EnvSpec. float32 numbers take their shortest decimal (0.1, not 0.10000000149)."""
    spec = EnvironmentSpec(
        env_id=message.env_id, task=message.task, instruction=message.instruction, source=int(message.source),
        num_envs=int(message.num_envs), height=int(message.height), width=int(message.width),
        cameras=tuple(message.cameras), action_names=tuple(message.action_names),
        action_units=tuple(message.action_units), action_scale=tuple(as_sent(value) for value in message.action_scale),
        state_names=tuple(message.state_names), state_units=tuple(message.state_units),
        state_low=tuple(as_sent(value) for value in message.state_low),
        state_high=tuple(as_sent(value) for value in message.state_high),
        ground_truth_names=tuple(message.ground_truth_names), control_period_s=as_sent(message.control_period),
        max_episode_steps=int(message.max_episode_steps), world_model_sha256=message.world_model_sha256,
        channels=int(message.channels), encoding=message.encoding,
    )
    tile = message.tile
    tiles = Tiles(int(tile.rows), int(tile.cols), int(tile.tile_height), int(tile.tile_width))
    return spec, tiles


def spec_to_json(spec: EnvironmentSpec) -> str:
    return json.dumps(spec_values(spec), sort_keys=True)


def spec_from_json(text: str) -> EnvironmentSpec:
    try:
        return spec_of_values(json.loads(text))
    except ValueError as error:
        raise BagError(f"wm.spec_json: {error}; read the bag with the version that wrote it") from None


def single(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The spec of one environment slot of `spec`, as EpisodeBagWriter records it."""
    return replace(spec, num_envs=1)


def floats(values: Any) -> NDArray[np.float32]:
    return np.asarray(values, np.float32).reshape(-1)
