"""The services env/step and env/reset: commands and replies as numpy, to requests and responses and back. Shapes: N
environments, A action, S state, H W 3 image."""

from dataclasses import replace
from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import UInt64Array
from wm_nodes.recording.messages import array_of, flags, floats, images_of, time_ns
from wm_nodes.ros.convert import mosaic_msg, set_optional, time_msg, to_field
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand


def step_request(command: StepCommand) -> StepBatch.Request:
    request = StepBatch.Request(
        session=command.session, step_id=command.step_id, spec_hash=command.spec_hash,
        policy_version=command.policy_version, observation=int(command.with_image),
    )
    request.action = to_field(command.actions)
    set_optional(request, log_prob=command.logprobs, value=command.values, reset_mask=command.reset_mask,
                  reset_seed=command.reset_seeds)
    return request


def step_command(request: StepBatch.Request, spec: EnvironmentSpec) -> StepCommand:
    """Raises WireError(BAD_SHAPE) where an array has another length than the spec says."""
    count = spec.num_envs
    return StepCommand(
        session=request.session, step_id=request.step_id, spec_hash=request.spec_hash,
        actions=floats(request.action, (count * spec.action_dim,), "action"), policy_version=request.policy_version,
        logprobs=floats(request.log_prob, (count,), "log_prob") if len(request.log_prob) else None,
        values=floats(request.value, (count,), "value") if len(request.value) else None,
        reset_mask=flags(request.reset_mask, count, "reset_mask") if len(request.reset_mask) else None,
        reset_seeds=_seeds(request.reset_seed, count, "reset_seed"),
        with_image=request.observation == StepBatch.Request.OBSERVATION_MOSAIC,
    )


def reset_request(command: ResetCommand) -> ResetBatch.Request:
    request = ResetBatch.Request(task=command.task, behaviour=command.behaviour, observation=int(command.with_image))
    set_optional(request, mask=command.mask, seed=command.seeds)
    return request


def reset_command(request: ResetBatch.Request, spec: EnvironmentSpec) -> ResetCommand:
    return ResetCommand(
        mask=flags(request.mask, spec.num_envs, "mask") if len(request.mask) else None,
        seeds=_seeds(request.seed, spec.num_envs, "seed"), task=request.task, behaviour=request.behaviour,
        with_image=request.observation == StepBatch.Request.OBSERVATION_MOSAIC,
    )


def fill_step_response(
    response: StepBatch.Response, reply: Reply, spec: EnvironmentSpec, shown: Image | None = None
) -> StepBatch.Response:
    """shown: the newest published mosaic; sent again where it is the reply's."""
    response.step_id = reply.step_id
    response.step_ms = reply.step_s * 1e3
    response.terminated, response.truncated = to_field(reply.terminated), to_field(reply.truncated)
    response.success_probability = to_field(reply.success_probability)
    response.model_uncertainty = to_field(reply.uncertainty)
    return _fill_common(response, reply, spec, shown)


def fill_reset_response(
    response: ResetBatch.Response, reply: Reply, spec: EnvironmentSpec, shown: Image | None = None
) -> ResetBatch.Response:
    """shown: as in fill_step_response."""
    response.session, response.next_step_id = reply.session, reply.step_id + 1
    return _fill_common(response, reply, spec, shown)


def _fill_common(response: Any, reply: Reply, spec: EnvironmentSpec, shown: Image | None) -> Any:
    response.error_code = ErrorCode.OK
    response.stamp = time_msg(reply.stamp_ns)
    response.state = to_field(reply.states)
    response.episode_id = to_field(reply.episode_ids)
    if reply.images is not None:
        known = shown is not None and time_ns(shown.header.stamp) == reply.stamp_ns
        response.observation = shown if known else mosaic_msg(reply.images, reply.stamp_ns, spec)
    return response


def step_reply(response: StepBatch.Response, spec: EnvironmentSpec, session: int) -> Reply:
    """Raises WireError with the response's error code, or BAD_SHAPE."""
    _raise_for(response)
    count = spec.num_envs
    return replace(
        _common_reply(response, spec, session, response.step_id),
        terminated=flags(response.terminated, count, "terminated"),
        truncated=flags(response.truncated, count, "truncated"),
        success_probability=floats(response.success_probability, (count,), "success_probability"),
        uncertainty=floats(response.model_uncertainty, (count,), "model_uncertainty"), step_s=response.step_ms / 1e3,
    )


def reset_reply(response: ResetBatch.Response, spec: EnvironmentSpec) -> Reply:
    """Raises WireError with the response's error code, or BAD_SHAPE."""
    _raise_for(response)
    return _common_reply(response, spec, response.session, response.next_step_id - 1)


def _common_reply(response: Any, spec: EnvironmentSpec, session: int, step_id: int) -> Reply:
    """What both answers have; nothing ended, succeeded or is uncertain."""
    count, zeros = spec.num_envs, np.zeros(spec.num_envs, np.float32)
    return Reply(
        session=session, step_id=step_id, stamp_ns=time_ns(response.stamp),
        images=images_of(response.observation, spec) if len(response.observation.data) else None,
        states=floats(response.state, (count, spec.state_dim), "state"), terminated=zeros != 0, truncated=zeros != 0,
        episode_ids=array_of(response.episode_id, np.uint64, (count,), "episode_id"),
        success_probability=zeros, uncertainty=zeros,
    )


def _raise_for(response: Any) -> None:
    if response.error_code != ErrorCode.OK:
        raise WireError(response.error_code, response.message)


def _seeds(field: Any, count: int, name: str) -> UInt64Array | None:
    return array_of(field, np.uint64, (count,), name) if len(field) else None
