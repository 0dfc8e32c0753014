"""Messages of the wire to our types, live (rclpy) or recorded (rosbags) ones, and our types to recorded ones. No rclpy.
Shapes: N environments, A action, S state, P ground truth, R reward components, H W 3 image.

What is decoded is a view of the message's bytes, no copy. WireError refuses what does not fit the spec.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep, Rewards
from wm_nodes.core.specs import EnvironmentSpec, as_sent, spec_of_values, spec_values
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.typestore import typestore

NS_PER_S = 1_000_000_000
BASE_FRAME = "wm_base"

KIND_START, KIND_END = 0, 1
OUTCOME_UNKNOWN, OUTCOME_SUCCESS, OUTCOME_FAILURE = 0, 1, 2
REASON_NONE, REASON_TERMINAL, REASON_TIME_LIMIT, REASON_UNCERTAINTY, REASON_RESET = 0, 1, 2, 3, 4

BAD_SHAPE, OUT_OF_RANGE = 2, 14
"""Of wm_msgs/ErrorCode."""

LOCKSTEP_ARRAYS: dict[str, tuple[str, DTypeLike]] = {
    "action": ("actions", np.float32), "state": ("states", np.float32), "next_state": ("next_states", np.float32),
    "log_prob": ("logprobs", np.float32), "value": ("values", np.float32), "terminated": ("terminated", np.bool_),
    "truncated": ("truncated", np.bool_), "valid": ("valid", np.bool_), "episode_id": ("episode_ids", np.uint64),
    "episode_step": ("episode_steps", np.uint32), "policy_version": ("policy_versions", np.uint64),
    "success_probability": ("success_probability", np.float32), "model_uncertainty": ("uncertainty", np.float32),
    "ground_truth": ("ground_truth", np.float32),
}
"""Array fields of wm_msgs/TransitionBatch: the LockStep's field and its type."""


def message_type(name: str) -> Any:
    """The rosbags class of a message type, e.g. wm_msgs/msg/TransitionBatch."""
    return typestore().types[name]


def stamp(time_ns: int) -> Any:
    return message_type("builtin_interfaces/msg/Time")(sec=time_ns // NS_PER_S, nanosec=time_ns % NS_PER_S)


def stamp_ns(time: Any) -> int:
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def time_ns(time: Any) -> int:
    """A message's stamp in ns. Raises WireError(OUT_OF_RANGE) for one that no clock gives."""
    if time.sec < 0 or time.nanosec >= NS_PER_S:
        raise WireError(
            OUT_OF_RANGE, f"stamp {time.sec} s + {time.nanosec} ns is no time; send nanosec below 10^9"
        )
    return stamp_ns(time)


def header(time_ns: int, frame_id: str) -> Any:
    return message_type("std_msgs/msg/Header")(stamp=stamp(time_ns), frame_id=frame_id)


def serialize(message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def deserialize(data: bytes | memoryview, msgtype: str) -> Any:
    return typestore().deserialize_cdr(data, msgtype)


def image_message(mosaic: UInt8Array, time_ns: int) -> Any:
    """sensor_msgs/Image of an uint8 (H, W, 3) mosaic."""
    height, width, channels = mosaic.shape
    return message_type("sensor_msgs/msg/Image")(
        header=header(time_ns, BASE_FRAME), height=height, width=width, encoding="rgb8", is_bigendian=0,
        step=width * channels, data=np.ascontiguousarray(mosaic).reshape(-1),
    )


def array_of(field: Any, dtype: DTypeLike, shape: Sequence[int], name: str) -> NDArray[Any]:
    """A view of a message's array field in a shape. Raises WireError(BAD_SHAPE) where the length differs."""
    values = np.asarray(field, dtype)
    if values.size != math.prod(shape):
        raise WireError(BAD_SHAPE, f"{name} has {values.size} values, expected {tuple(shape)}; compare with env/spec")
    return values.reshape(shape)


def floats(field: Any, shape: Sequence[int], name: str) -> FloatArray:
    """As array_of, float32."""
    return array_of(field, np.float32, shape, name)


def flags(field: Any, count: int, name: str) -> BoolArray:
    """As array_of, bool (count,) of uint8 flags."""
    return np.not_equal(array_of(field, np.uint8, (count,), name), 0)


def images_of(message: Any, spec: EnvironmentSpec, tiles: Tiles | None = None) -> UInt8Array:
    """A tiled sensor_msgs/Image as uint8 (N, H, W, 3).

    Raises:
        WireError: BAD_SHAPE, naming each of encoding, height, width, step and length that differs from the spec.
    """
    tiles = tiles or tiles_of(spec)
    height, width = tiles.mosaic_shape
    step = width * spec.channels
    expected = {"encoding": spec.encoding, "height": height, "width": width, "step": step}
    wrong = [f"{key} is {getattr(message, key)!r}, not {value!r}" for key, value in expected.items()
             if getattr(message, key) != value]
    if not wrong and len(message.data) != height * step:
        wrong = [f"data has {len(message.data)} bytes, not {height * step}"]
    if wrong:
        raise WireError(
            BAD_SHAPE,
            f"image refused: {'; '.join(wrong)}; send {spec.num_envs} tiles of {spec.height} x {spec.width} px as "
            f"EnvSpec of {spec.env_id} says",
        )
    return tiles.untile(np.asarray(message.data, np.uint8).reshape(height, width, spec.channels), spec.num_envs)


def tiles_of(spec: EnvironmentSpec) -> Tiles:
    return Tiles.of(spec.num_envs, spec.height, spec.width)


def lockstep_of(message: Any, spec: EnvironmentSpec) -> LockStep:
    """Read wm_msgs/TransitionBatch. Raises WireError: BAD_SHAPE where an array does not fit the spec."""
    count, truth = spec.num_envs, message.ground_truth
    if message.num_envs != count:
        raise WireError(
            BAD_SHAPE, f"transition of {message.num_envs} environments, env/spec says {count}; send a row for each"
        )
    if not len(truth):
        truth = np.full(count * spec.ground_truth_dim, np.nan, np.float32)
    widths = {
        "action": (count, spec.action_dim), "state": (count, spec.state_dim), "next_state": (count, spec.state_dim),
        "ground_truth": (count, spec.ground_truth_dim),
    }
    fields = {name: getattr(message, name) for name in LOCKSTEP_ARRAYS} | {"ground_truth": truth}
    arrays: dict[str, Any] = {
        attribute: flags(fields[name], count, name) if dtype is np.bool_
        else array_of(fields[name], dtype, widths.get(name, (count,)), name)
        for name, (attribute, dtype) in LOCKSTEP_ARRAYS.items()
    }
    return LockStep(
        session=int(message.session), step_id=int(message.step_id), stamp_ns=time_ns(message.header.stamp),
        next_stamp_ns=time_ns(message.next_stamp), source=int(message.source), **arrays,
    )


def lockstep_arrays(step: LockStep) -> dict[str, NDArray[Any]]:
    """The array fields of wm_msgs/TransitionBatch, in our shapes."""
    return {name: getattr(step, attribute) for name, (attribute, _) in LOCKSTEP_ARRAYS.items()}


def lockstep_message(step: LockStep, seq: int) -> Any:
    """wm_msgs/TransitionBatch of a lock-step."""
    arrays = {name: values.reshape(-1) for name, values in lockstep_arrays(step).items()}
    arrays = {name: values.view(np.uint8) if values.dtype == np.bool_ else values for name, values in arrays.items()}
    return message_type("wm_msgs/msg/TransitionBatch")(
        header=header(step.stamp_ns, BASE_FRAME), session=step.session, seq=seq, next_stamp=stamp(step.next_stamp_ns),
        step_id=step.step_id, num_envs=len(step.valid), source=step.source, **arrays,
    )


def rewards_of(message: Any) -> Rewards:
    """Read wm_msgs/RewardBatch. Raises WireError: BAD_SHAPE where arrays differ in length from num_envs."""
    count, names = int(message.num_envs), tuple(message.component_names)
    return Rewards(
        session=int(message.transition_session), step_id=int(message.step_id), stamp_ns=time_ns(message.header.stamp),
        total=floats(message.total, (count,), "total"), dense=floats(message.dense, (count,), "dense"),
        sparse=floats(message.sparse, (count,), "sparse"),
        components=floats(message.components, (count, len(names)), "components"), component_names=names,
        success=array_of(message.success, np.uint8, (count,), "success"), valid=flags(message.valid, count, "valid"),
        invalid_reason=message.invalid_reason, name=message.reward_name, version=int(message.reward_version),
    )


def goals_of(message: Any, spec: EnvironmentSpec, tiles: Tiles | None = None) -> Goals:
    """Read wm_msgs/TaskGoal. Raises WireError: BAD_SHAPE where the mosaic or an array does not fit the spec."""
    return Goals(
        session=int(message.session), stamp_ns=time_ns(message.header.stamp),
        images=images_of(message.goal_image, spec, tiles) if len(message.goal_image.data) else None,
        found=flags(message.goal_found, spec.num_envs, "goal_found"),
        episode_ids=array_of(message.episode_id, np.uint64, (spec.num_envs,), "episode_id"),
    )


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
    layout = message_type("wm_msgs/msg/TileLayout")(**asdict(tiles_of(spec)))
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
