"""The services env/step and env/reset: commands and replies as numpy, to requests and responses and back. Shapes: N
environments, A action, S state, H W 3 image."""

from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import ResetBatch, StepBatch
from wm_nodes.core.errors import WireError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt64Array
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


def fill_response(
    response: StepBatch.Response | ResetBatch.Response, reply: Reply, spec: EnvironmentSpec, shown: Image | None = None
) -> Any:
    """shown: the newest published mosaic; sent again where it is the reply's."""
    response.error_code, response.stamp = ErrorCode.OK, time_msg(reply.stamp_ns)
    set_optional(response, state=reply.states, episode_id=reply.episode_ids)
    if isinstance(response, StepBatch.Response):
        response.step_id, response.step_ms = reply.step_id, reply.step_s * 1e3
        set_optional(response, terminated=reply.terminated, truncated=reply.truncated,
                     success_probability=reply.success_probability, model_uncertainty=reply.uncertainty)
    else:
        response.session, response.next_step_id = reply.session, reply.step_id + 1
    if reply.images is not None:
        known = shown is not None and time_ns(shown.header.stamp) == reply.stamp_ns
        response.observation = shown if known else mosaic_msg(reply.images, reply.stamp_ns, spec)
    return response


def reply_of(
    response: StepBatch.Response | ResetBatch.Response, spec: EnvironmentSpec, session: int | None = None
) -> Reply:
    """After a reset nothing has ended or succeeded, and nothing is uncertain.

    Args:
        session: of the environment, which the answer to a step does not say.

    Raises:
        WireError: the response's error code, or BAD_SHAPE.
    """
    if response.error_code != ErrorCode.OK:
        raise WireError(response.error_code, response.message)
    count, stepped = spec.num_envs, session is not None
    zeros = np.zeros(count, np.float32)

    def flags_in(name: str) -> Any:
        return flags(getattr(response, name), count, name) if stepped else zeros != 0

    def floats_in(name: str) -> FloatArray:
        return floats(getattr(response, name), (count,), name) if stepped else zeros

    return Reply(
        session=response.session if session is None else session,
        step_id=response.step_id if stepped else response.next_step_id - 1, stamp_ns=time_ns(response.stamp),
        images=images_of(response.observation, spec) if len(response.observation.data) else None,
        states=floats(response.state, (count, spec.state_dim), "state"), terminated=flags_in("terminated"),
        truncated=flags_in("truncated"), episode_ids=array_of(response.episode_id, np.uint64, (count,), "episode_id"),
        success_probability=floats_in("success_probability"), uncertainty=floats_in("model_uncertainty"),
        step_s=response.step_ms / 1e3 if stepped else 0.0,
    )


def _seeds(field: Any, count: int, name: str) -> UInt64Array | None:
    return array_of(field, np.uint64, (count,), name) if len(field) else None
