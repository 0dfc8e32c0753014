"""What topics carry: numpy to messages and back, never through the slow uint8[] path; services are in ros.calls.
Shapes: N environments, A action, S state, P ground truth, H W 3 image, R reward components.

Assigning an ndarray to a message's array field takes 21 ms for 197 kB and fails under ROS_PYTHON_CHECK_FIELDS=1; an
array.array takes 10 us and is right in both modes. Reading back is np.frombuffer: a view, no copy.
"""

from array import array
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import DTypeLike, NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from wm_msgs.msg import (
    ActionBatch,
    EnvSpec,
    EpisodeEvent,
    ErrorCode,
    RewardBatch,
    TaskGoal,
    TileLayout,
    TransitionBatch,
)
from wm_nodes.core.named_files import OutsideFolders
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import BASE_FRAME, NS_PER_S, spec_fields, spec_of, stamp_ns
from wm_nodes.ros.wire import EpisodeNote, Goals, Rewards, TimedAction, Transition, WireError

if TYPE_CHECKING:  # a player needs no torch
    from wm_nodes.reward.base import RewardResult

_TYPECODES = {"float32": "f", "float64": "d", "uint8": "B", "uint32": "I", "uint64": "Q", "bool": "B"}


def to_field(values: NDArray[Any]) -> "array[Any]":
    """Return an array.array with the bytes of a float32, float64, uint8, bool, uint32 or uint64 ndarray, row-major."""
    if values.dtype.name not in _TYPECODES:
        raise TypeError(f"no message array holds {values.dtype}; cast to one of {', '.join(_TYPECODES)}")
    field = array(_TYPECODES[values.dtype.name])
    field.frombytes(np.ascontiguousarray(values).data.cast("B") if values.size else b"")
    return field


def bytes_field(data: bytes) -> "array[int]":
    """Return a uint8[] field."""
    return array("B", data)


def from_field(field: Any, dtype: DTypeLike) -> NDArray[Any]:
    """Return a flat view of a message's array field."""
    return np.frombuffer(field, dtype) if len(field) else np.empty(0, dtype)


def floats(field: Any, shape: Sequence[int], name: str) -> FloatArray:
    """Return a float32 view of the given shape; raise WireError(BAD_SHAPE) where the length differs."""
    return reshape_field(from_field(field, np.float32), shape, name)


def flags(field: Any, count: int, name: str) -> BoolArray:
    """Return bool (count,) from uint8 flags."""
    values: UInt8Array = reshape_field(from_field(field, np.uint8), (count,), name)
    return np.not_equal(values, 0)


def reshape_field(values: NDArray[Any], shape: Sequence[int], name: str) -> NDArray[Any]:
    """Return values in a shape; raise WireError(BAD_SHAPE) where the length differs."""
    if values.size != int(np.prod(shape)):
        raise WireError(
            ErrorCode.BAD_SHAPE, f"{name} has {values.size} values, expected {tuple(shape)}; compare with env/spec"
        )
    return values.reshape(shape)


def set_optional(message: Any, **arrays: NDArray[Any] | None) -> None:
    """Set array fields; None leaves one empty."""
    for name, values in arrays.items():
        if values is not None:
            setattr(message, name, to_field(values))


def fill_error(response: Any, error: WireError) -> Any:
    """Refuse a request in its answer."""
    response.error_code, response.message = error.code, str(error)
    return response


def file_error(error: ValueError) -> WireError:
    """What a request that names a file which is refused is answered."""
    return WireError(ErrorCode.OUT_OF_RANGE if isinstance(error, OutsideFolders) else ErrorCode.IO_ERROR, str(error))


def time_msg(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)


def time_ns(stamp: Time) -> int:
    """Return a message's stamp in ns. Raises WireError(OUT_OF_RANGE) for one that no clock gives."""
    if stamp.sec < 0 or stamp.nanosec >= NS_PER_S:
        raise WireError(
            ErrorCode.OUT_OF_RANGE, f"stamp {stamp.sec} s + {stamp.nanosec} ns is no time; send nanosec below 10^9",
        )
    return stamp_ns(stamp)


def header(stamp_ns: int, frame_id: str = BASE_FRAME) -> Header:
    return Header(stamp=time_msg(stamp_ns), frame_id=frame_id)


# Images


def image_msg(mosaic: UInt8Array, stamp_ns: int, encoding: str = "rgb8") -> Image:
    """uint8 (H, W, 3) to sensor_msgs/Image."""
    height, width, channels = mosaic.shape
    message = Image(height=height, width=width, encoding=encoding, is_bigendian=0, step=width * channels)
    message.header = header(stamp_ns)
    message.data = to_field(mosaic)
    return message


def mosaic_msg(images: UInt8Array, stamp_ns: int, spec: EnvironmentSpec) -> Image:
    """uint8 (N, H, W, 3) to one tiled image, laid out as EnvSpec.tile says."""
    return image_msg(tiles_of(spec).tile(images), stamp_ns, spec.encoding)


def images_of(message: Image, spec: EnvironmentSpec, tiles: Tiles | None = None) -> UInt8Array:
    """A tiled image to uint8 (N, H, W, 3).

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
            ErrorCode.BAD_SHAPE,
            f"image refused: {'; '.join(wrong)}; send {spec.num_envs} tiles of {spec.height} x {spec.width} px as "
            f"EnvSpec of {spec.env_id} says",
        )
    mosaic = from_field(message.data, np.uint8).reshape(height, width, spec.channels)
    return tiles.untile(mosaic, spec.num_envs)


def tiles_of(spec: EnvironmentSpec) -> Tiles:
    return Tiles.of(spec.num_envs, spec.height, spec.width)


def tile_msg(spec: EnvironmentSpec) -> TileLayout:
    return TileLayout(**asdict(tiles_of(spec)))


# EnvSpec


def spec_msg(spec: EnvironmentSpec, stamp_ns: int) -> EnvSpec:
    values = {k: to_field(v) if isinstance(v, np.ndarray) else v for k, v in spec_fields(spec).items()}
    return EnvSpec(header=header(stamp_ns), tile=tile_msg(spec), **values)


def spec_from_msg(message: EnvSpec) -> EnvironmentSpec:
    """Rebuild the spec.

    Raises:
        WireError: SPEC_MISMATCH, when the rebuilt spec has another hash: sender and receiver differ in version.
    """
    spec, _ = spec_of(message)
    if spec.spec_hash != message.spec_hash:
        raise WireError(
            ErrorCode.SPEC_MISMATCH,
            f"EnvSpec of {message.env_id} hashes to {spec.spec_hash[:12]}, the sender says {message.spec_hash[:12]}; "
            "run the same version of wm_nodes and wm_msgs on both sides",
        )
    return spec


# Transitions, goals, episodes, rewards


def transition_msg(transition: Transition) -> TransitionBatch:
    """session and seq are set by the publisher."""
    message = TransitionBatch(
        header=header(transition.stamp_ns), next_stamp=time_msg(transition.next_stamp_ns), step_id=transition.step_id,
        num_envs=len(transition.valid), source=transition.source,
    )
    set_optional(
        message, action=transition.actions, state=transition.states, next_state=transition.next_states,
        log_prob=transition.logprobs, value=transition.values, terminated=transition.terminated,
        truncated=transition.truncated, valid=transition.valid, episode_id=transition.episode_ids,
        episode_step=transition.episode_steps, policy_version=transition.policy_versions,
        success_probability=transition.success_probability, model_uncertainty=transition.uncertainty,
        ground_truth=transition.ground_truth,
    )
    return message


def transition_of(message: TransitionBatch, spec: EnvironmentSpec) -> Transition:
    """Raises WireError: BAD_SHAPE where an array does not fit the spec, NAN_INPUT where a valid row has no numbers."""
    count = spec.num_envs
    if message.num_envs != count:
        raise WireError(
            ErrorCode.BAD_SHAPE,
            f"transition of {message.num_envs} environments, env/spec says {count}; send a row for each",
        )
    truth_dim = spec.ground_truth_dim if len(message.ground_truth) else 0
    transition = Transition(
        stamp_ns=time_ns(message.header.stamp), next_stamp_ns=time_ns(message.next_stamp), step_id=message.step_id,
        actions=floats(message.action, (count, spec.action_dim), "action"),
        states=floats(message.state, (count, spec.state_dim), "state"),
        next_states=floats(message.next_state, (count, spec.state_dim), "next_state"),
        logprobs=floats(message.log_prob, (count,), "log_prob"), values=floats(message.value, (count,), "value"),
        terminated=flags(message.terminated, count, "terminated"),
        truncated=flags(message.truncated, count, "truncated"), valid=flags(message.valid, count, "valid"),
        episode_ids=reshape_field(from_field(message.episode_id, np.uint64), (count,), "episode_id"),
        episode_steps=reshape_field(from_field(message.episode_step, np.uint32), (count,), "episode_step"),
        policy_versions=reshape_field(from_field(message.policy_version, np.uint64), (count,), "policy_version"),
        success_probability=floats(message.success_probability, (count,), "success_probability"),
        uncertainty=floats(message.model_uncertainty, (count,), "model_uncertainty"),
        ground_truth=floats(message.ground_truth, (count, truth_dim), "ground_truth"), source=message.source,
        session=message.session,
    )
    for name in ("actions", "states", "next_states", "success_probability"):
        _check_finite(getattr(transition, name)[transition.valid], name, "transition")
    return transition


def action_of(message: ActionBatch, spec: EnvironmentSpec) -> TimedAction:
    """Raises WireError(BAD_SHAPE) where an array does not fit the spec, or for a chunk of several actions."""
    count = spec.num_envs
    if message.chunk_length > 1:
        raise WireError(ErrorCode.BAD_SHAPE, f"action is a chunk of {message.chunk_length}; send one at a time")
    return TimedAction(
        actions=floats(message.action, (count * spec.action_dim,), "action"), stamp_ns=time_ns(message.header.stamp),
        policy_version=message.policy_version,
        logprobs=floats(message.log_prob, (count,), "log_prob") if len(message.log_prob) else None,
        values=floats(message.value, (count,), "value") if len(message.value) else None,
    )


def goal_msg(goals: Goals, spec: EnvironmentSpec) -> TaskGoal:
    message = TaskGoal(header=header(goals.stamp_ns), task=spec.task, instruction=spec.instruction)
    message.goal_found, message.episode_id = to_field(goals.found), to_field(goals.episode_ids)
    if goals.images is not None:
        message.goal_image = mosaic_msg(goals.images, goals.stamp_ns, spec)
    return message


def goals_of(message: TaskGoal, spec: EnvironmentSpec) -> Goals:
    return Goals(
        stamp_ns=time_ns(message.header.stamp),
        images=images_of(message.goal_image, spec) if len(message.goal_image.data) else None,
        found=flags(message.goal_found, spec.num_envs, "goal_found"),
        episode_ids=reshape_field(from_field(message.episode_id, np.uint64), (spec.num_envs,), "episode_id"),
    )


def episode_msg(note: EpisodeNote, spec: EnvironmentSpec) -> EpisodeEvent:
    return EpisodeEvent(
        header=header(note.stamp_ns), kind=note.kind, env_index=note.env_index, episode_id=note.episode_id,
        seed=note.seed, task=spec.task, instruction=spec.instruction, behaviour=note.behaviour, length=note.length,
        outcome=note.outcome, termination_reason=note.reason, policy_version_first=note.policy_version_first,
        policy_version_last=note.policy_version_last, source=spec.source,
    )


def reward_msg(
    transition: Transition, result: "RewardResult", *, name: str, version: int, eval_s: float
) -> RewardBatch:
    """The rewards of one transition; session and seq are set by the publisher."""
    components = list(result.components)
    message = RewardBatch(
        header=header(transition.stamp_ns), transition_session=transition.session, step_id=transition.step_id,
        num_envs=len(result.total), component_names=components, invalid_reason=result.invalid_reason,
        reward_version=version, reward_name=name, eval_ms=eval_s * 1e3,
    )
    set_optional(message, total=result.total, dense=result.dense, sparse=result.sparse, success=result.success,
                  valid=result.valid)
    if components:
        message.components = to_field(np.stack([result.components[key] for key in components], axis=1))
        message.weights = to_field(np.asarray([result.weights.get(key, 1.0) for key in components], np.float32))
    return message


def rewards_of(message: RewardBatch) -> Rewards:
    """Raises WireError: BAD_SHAPE where arrays differ in length from num_envs, NAN_INPUT for a valid no-number."""
    count = message.num_envs
    rewards = Rewards(
        transition_session=message.transition_session, step_id=message.step_id,
        total=floats(message.total, (count,), "total"), valid=flags(message.valid, count, "valid"),
        success=reshape_field(from_field(message.success, np.uint8), (count,), "success"),
        invalid_reason=message.invalid_reason,
    )
    _check_finite(rewards.total[rewards.valid], "total", "reward")
    return rewards


def _check_finite(values: FloatArray, name: str, what: str) -> None:
    if not np.isfinite(values).all():
        raise WireError(ErrorCode.NAN_INPUT, f"{name} of a valid {what} is NaN or infinite; set valid to 0")
