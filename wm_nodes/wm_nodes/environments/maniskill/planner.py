"""MPLib demonstrations: plan joint paths between the task's waypoints, follow their tool path with delta actions.

The planner works on joint angles; the policy's action is a displacement of the commanded tool position. So a planned
joint path becomes a tool path by forward kinematics, and the demonstration tracks it in steps of at most one full-scale
action.
"""

from collections.abc import Callable

import mplib
import numpy as np

from wm_nodes.config.tasks import get_task
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment

PLANNER_TIME_STEP_S = 0.02
TOOL_LINK = "panda_hand_tcp"


class PlanningError(ValueError):
    """MPLib found no path."""


class DemonstrationPlanner:
    """Plans for the Panda of one simulator environment."""

    def __init__(self, env: ManiSkillEnvironment) -> None:
        self._env = env
        agent = env.scene.agent
        self._planner = mplib.Planner(
            urdf=agent.urdf_path, srdf=agent.urdf_path.replace(".urdf", ".srdf"),
            user_link_names=[link.get_name() for link in agent.robot.get_links()],
            user_joint_names=[joint.get_name() for joint in agent.robot.get_active_joints()], move_group=TOOL_LINK,
        )
        self._planner.set_base_pose(np.hstack([ROBOT_BASE, [1.0, 0.0, 0.0, 0.0]]))
        self._tool_index = self._planner.user_link_names.index(TOOL_LINK)

    def tool_path(self) -> FloatArray:
        """Plan the task from the environment's current pose: (K, 3) world tool positions, m.

        Raises:
            PlanningError: names the waypoint that neither a screw path nor RRT-Connect reaches.
        """
        agent = self._env.scene.agent
        joints = agent.robot.get_qpos()[0].numpy().astype(np.float64)
        rotation = agent.tcp.pose.q[0].numpy()
        tools = [agent.tcp.pose.p[0].numpy()]
        for waypoint in get_task(self._env.spec.task).waypoints(self._env.ground_truth[0]):
            pose = np.concatenate([waypoint, rotation])
            result = self._planner.plan_screw(pose, joints, time_step=PLANNER_TIME_STEP_S)
            if result["status"] != "Success":
                result = self._planner.plan_qpos_to_pose(pose, joints, time_step=PLANNER_TIME_STEP_S)
            if result["status"] != "Success":
                raise PlanningError(f"no path to {np.round(waypoint, 3).tolist()}: {result['status']}")
            for position in result["position"]:
                joints = np.concatenate([position, joints[len(position) :]])
                tools.append(self._forward_kinematics(joints))
        path: FloatArray = np.stack(tools).astype(np.float32)
        return path

    def _forward_kinematics(self, joints: np.ndarray[tuple[int], np.dtype[np.float64]]) -> FloatArray:
        model = self._planner.pinocchio_model
        model.compute_forward_kinematics(joints)
        return np.asarray(model.get_link_pose(self._tool_index)[:3] + ROBOT_BASE, np.float32)


def follow(path: FloatArray, max_action_m: float) -> Callable[[FloatArray], FloatArray]:
    """Return act(state) -> action that tracks a tool path (K, 3) in full-scale steps and holds its end."""
    reached = 0

    def act(state: FloatArray) -> FloatArray:
        nonlocal reached
        tool = state + ROBOT_BASE
        while reached < len(path) - 1 and np.abs(path[reached + 1] - tool).max() <= max_action_m:
            reached += 1
        action: FloatArray = np.clip((path[reached] - tool) / max_action_m, -1, 1).astype(np.float32)
        return action

    return act
