"""What topics carry: our types to rclpy messages, never through the slow uint8[] path, and back with the checks that a
live sender needs; what is the same for live and recorded messages is in recording.messages, services are in ros.calls.
Shapes: N environments, A action, S state, P ground truth, H W 3 image, R reward components.

Assigning an ndarray to a message's array field takes 21 ms for 197 kB and fails under ROS_PYTHON_CHECK_FIELDS=1; an
array.array takes 10 us and is right in both modes.
"""

from array import array
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
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
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep, Rewards
from wm_nodes.core.named_files import OutsideFolders
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.recording import messages
from wm_nodes.recording.messages import (
    BASE_FRAME,
    NS_PER_S,
    floats,
    lockstep_arrays,
    lockstep_of,
    spec_fields,
    spec_of,
    tiles_of,
    time_ns,
)
from wm_nodes.ros.wire import EpisodeNote, TimedAction

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


def set_optional(message: Any, **arrays: NDArray[Any] | None) -> None:
    """Set array fields; None leaves one empty."""
    for name, values in arrays.items():
        if values is not None:
            setattr(message, name, to_field(values))


def fill_error(response: Any, error: WireError) -> Any:
    """Refuse a request in its answer."""
    response.error_code, response.message = error.code, str(error)
    return response


def refusal_of(error: Exception, code: int = ErrorCode.IO_ERROR) -> WireError:
    """What is answered to a request that raised: a WireError itself; else of this code, or OUT_OF_RANGE for a file
    outside the folders."""
    if isinstance(error, WireError):
        return error
    return WireError(ErrorCode.OUT_OF_RANGE if isinstance(error, OutsideFolders) else code, str(error))


def time_msg(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)


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


def transition_msg(step: LockStep) -> TransitionBatch:
    """session and seq are set by the publisher."""
    message = TransitionBatch(
        header=header(step.stamp_ns), next_stamp=time_msg(step.next_stamp_ns), step_id=step.step_id,
        num_envs=len(step.valid), source=step.source,
    )
    set_optional(message, **lockstep_arrays(step))
    return message


def transition_of(message: TransitionBatch, spec: EnvironmentSpec) -> LockStep:
    """Raises WireError: BAD_SHAPE where an array does not fit the spec, NAN_INPUT where a valid row has no numbers."""
    step = lockstep_of(message, spec)
    for name in ("actions", "states", "next_states", "success_probability"):
        _check_finite(getattr(step, name)[step.valid], name, "transition")
    return step


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


def episode_msg(note: EpisodeNote, spec: EnvironmentSpec) -> EpisodeEvent:
    return EpisodeEvent(
        header=header(note.stamp_ns), kind=note.kind, env_index=note.env_index, episode_id=note.episode_id,
        seed=note.seed, task=spec.task, instruction=spec.instruction, behaviour=note.behaviour, length=note.length,
        outcome=note.outcome, termination_reason=note.reason, policy_version_first=note.policy_version_first,
        policy_version_last=note.policy_version_last, source=spec.source,
    )


def reward_msg(
    step: LockStep, result: "RewardResult", *, name: str, version: int, eval_s: float
) -> RewardBatch:
    """The rewards of one lock-step; session and seq are set by the publisher."""
    components = list(result.components)
    message = RewardBatch(
        header=header(step.stamp_ns), transition_session=step.session, step_id=step.step_id,
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
    rewards = messages.rewards_of(message)
    _check_finite(rewards.total[rewards.valid], "total", "reward")
    return rewards


def _check_finite(values: FloatArray, name: str, kind: str) -> None:
    if not np.isfinite(values).all():
        raise WireError(ErrorCode.NAN_INPUT, f"{name} of a valid {kind} is NaN or infinite; set valid to 0")
