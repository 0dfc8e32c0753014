"""An environment stepped by its own clock instead of by requests (ros_interface 3.6). No rclpy: numpy in, numpy out.

Shapes: N environments, A action.
"""

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wm_msgs.msg import ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.nodes.environment.lockstep import LockstepEnvironment
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand, TimedAction

REMEMBERED = 256
"""Observations whose time of publication is kept, to tell the age of the actions that answer them."""


class AsynchronousEnvironment:
    """Makes one step per tick, with the newest action that is not too old; else it holds the tool.

    Ended environments are reset in the next step. A held step carries policy version 0, so that no learner takes it for
    the policy's.

    Args:
        max_age_s: longest time from the publication of an observation to a step with the action that answers it.
        clock: returns monotonic time, in s.
    """

    def __init__(
        self, served: LockstepEnvironment, max_age_s: Callable[[], float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._served, self._max_age_s, self._clock = served, max_age_s, clock
        self._newest: tuple[TimedAction, float] | None = None
        self._published: OrderedDict[int, float] = OrderedDict()
        self._ended = np.zeros(served.spec.num_envs, bool)
        self._is_waiting = False

    def start(self) -> None:
        """Reset every environment and publish the first observation. Raises WireError."""
        self.reset(ResetCommand(with_image=False))

    def reset(self, command: ResetCommand) -> Reply:
        """Reset as asked for, and forget the newest action. Raises WireError."""
        self._newest = None
        reply = self._served.reset(command)
        self._ended = np.zeros_like(self._ended) if command.mask is None else self._ended & ~command.mask
        self._note(reply.stamp_ns)
        return reply

    def offer(self, action: TimedAction) -> None:
        """Take a new action.

        Raises:
            WireError: ESTOP, BAD_SHAPE, NAN_INPUT, OUT_OF_RANGE; TIMEOUT for one whose observation is too old to act
                upon. The action before it stays.
        """
        self._served.check_estop()
        now = self._clock()
        self._served.check_actions(action.actions)
        seen = now if not action.stamp_ns else self._published.get(action.stamp_ns)
        if seen is None or now - seen > self._max_age_s():
            age = "unknown" if seen is None else f"{now - seen:.3f} s old"
            raise WireError(
                ErrorCode.TIMEOUT,
                f"action refused: the observation of stamp {action.stamp_ns} is {age}, max_action_age_s is "
                f"{self._max_age_s():g}; use a faster policy or a longer control_period_s",
            )
        self._newest = action, seen

    def hold(self) -> None:
        """Forget the newest action: hold until another comes."""
        self._newest = None

    def stop(self) -> None:
        """Hold at once: the next step may never come. Raises WireError."""
        self.hold()
        self._served.hold_now()

    def tick(self) -> bool:
        """Step once; return False when it had to hold for want of an action.

        Raises:
            WireError: BUSY (no credit) and ESTOP, where nothing has changed but that a robot holds; NAN_MODEL and
                INTERNAL, after which all are reset.
        """
        action = None
        if self._newest is not None and self._clock() - self._newest[1] <= self._max_age_s():
            action = self._newest[0]
        spec = self._served.spec
        reset = self._ended if self._ended.any() else None
        command = StepCommand(
            session=self._served.session, step_id=self._served.next_step_id, spec_hash=spec.spec_hash,
            actions=self._served.hold_actions().reshape(-1), reset_mask=reset, with_image=False,
        )
        if action is not None:
            command = replace(
                command, actions=action.actions.reshape(-1), policy_version=action.policy_version,
                logprobs=action.logprobs, values=action.values,
            )
        try:
            reply = self._served.step(command)
        except WireError as error:
            if error.code == ErrorCode.BUSY:
                self._wait()
            if error.code in (ErrorCode.NAN_MODEL, ErrorCode.INTERNAL):
                self._ended[:] = True
            raise
        self._is_waiting = False
        self._ended = reply.ended
        self._note(reply.stamp_ns)
        return action is not None or bool(reset is not None and reset.all())

    def _wait(self) -> None:
        """Have a robot hold, once for each wait for credit, since every hold shortens its episode. Raises WireError."""
        if self._served.is_robot and not self._is_waiting:
            self._ended |= self._served.hold_now()
            self._is_waiting = True

    def _note(self, stamp_ns: int) -> None:
        self._published[stamp_ns] = self._clock()
        while len(self._published) > REMEMBERED:
            self._published.popitem(last=False)
