"""Numbers out of recorded messages of any known type, by the dotted names of a contract."""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from wm_nodes.recording.errors import BagError

JOINT_STATE, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
_OF_JOINTS = {
    JOINT_STATE: {"position": "position", "velocity": "velocity", "effort": "effort"},
    TRAJECTORY: {"position": "positions", "velocity": "velocities", "effort": "effort"},
}


class Selector:
    """Takes the selected numbers out of messages of one type.

    Raises:
        BagError: the type has no such field, or it is no number; names what there is.
    """

    def __init__(self, msgtype: str, select: Sequence[str]) -> None:
        self.msgtype, self.select = msgtype, select
        self.joints: list[str] = []
        self._columns: dict[str, int] = {}
        self._paths = [name.split(".") for name in select]
        if of_joints := _OF_JOINTS.get(msgtype):
            if wrong := [name for name in select if name.partition(".")[0] not in of_joints or "." not in name]:
                raise BagError(f"{msgtype} has no {wrong[0]!r}; select position.JOINT, velocity.JOINT or effort.JOINT")
            self._wanted = [(of_joints[name.partition(".")[0]], name.partition(".")[2]) for name in select]

    def __call__(self, message: Any) -> list[float] | None:
        """The numbers, in the order of `select`; None where a message lacks one, or has one that is not finite."""
        try:
            if self.msgtype in _OF_JOINTS:
                values = self._of_joints(message)
            else:
                values = [self._at(message, path) for path in self._paths]
        except (IndexError, KeyError):
            return None
        return values if all(map(math.isfinite, values)) else None

    def _of_joints(self, message: Any) -> list[float]:
        names = message.name if self.msgtype == JOINT_STATE else message.joint_names
        if names != self.joints:
            self.joints, self._columns = names, {name: column for column, name in enumerate(names)}
        if self.msgtype == TRAJECTORY:
            if len(message.points) > 1:
                raise BagError(f"a {TRAJECTORY} of {len(message.points)} points is a plan, not a command of one step; "
                               "record what the controller was commanded")
            message = message.points[0]
        return [float(getattr(message, field)[self._columns[joint]]) for field, joint in self._wanted]

    def _at(self, message: Any, path: Sequence[str]) -> float:
        value = message
        for part in (["data", *path] if path[0].isdigit() else path):
            if not part.isdigit() and not hasattr(value, part):
                there = ", ".join(field.name for field in fields(value)) if is_dataclass(value) else repr(value)
                raise BagError(f"{self.msgtype} has no {'.'.join(path)!r}; at {part!r} there is {there}")
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        try:
            return float(value)
        except (TypeError, ValueError):
            raise BagError(f"{'.'.join(path)!r} of {self.msgtype} is no number; select one field of it") from None
