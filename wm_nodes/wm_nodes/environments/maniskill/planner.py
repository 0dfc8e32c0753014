"""MPLib demonstrations: plan joint paths between the task's waypoints, follow their tool path with delta actions.

The planner works on joint angles; the policy's action is a displacement of the commanded tool. So a planned joint path
becomes a tool path by forward kinematics, and the demonstration tracks it in steps of at most one full-scale action: of
a position as fast as it can, of a pose at the times of the plan.
"""

import logging
from collections.abc import Callable

import mplib
import numpy as np

from wm_nodes.config.tasks import simulator_part
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import moves_pose
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.control import quaternion_of, rotation_of
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.pose_scripts import difference

PLANNER_TIME_STEP_S = 0.02
TOOL_LINK = "panda_hand_tcp"
JOINT_SPEED_RAD_S, JOINT_ACCELERATION_RAD_S2 = 1.5, 4.5
"""Of plans of poses, whose times are kept; at 6 rad/s2 a pushed capsule rolls off sideways."""
GRIPPER_S = 0.4
"""In which the fingers close or open while the tool waits."""
SCREW_STEPS = 0.1, 0.07
"""rad, tried in this order: MPLib calls a path failed whose last step but one ends a hair before the goal."""
NUM_JOINTS = 7
Joints = np.ndarray[tuple[int], np.dtype[np.float64]]
JointPath = np.ndarray[tuple[int, int], np.dtype[np.float64]]


class PlanningError(ValueError):
    """MPLib found no path."""


class DemonstrationPlanner:
    """Plans for the Panda of one simulator environment."""

    def __init__(self, env: ManiSkillEnvironment) -> None:
        self._env = env
        _quieten(logging.getLogger("toppra.algorithm"))
        agent = env.scene.agent
        limits = {
            "joint_vel_limits": np.full(NUM_JOINTS, JOINT_SPEED_RAD_S),
            "joint_acc_limits": np.full(NUM_JOINTS, JOINT_ACCELERATION_RAD_S2),
        }
        self._planner = mplib.Planner(
            urdf=agent.urdf_path, srdf=agent.urdf_path.replace(".urdf", ".srdf"),
            user_link_names=[link.get_name() for link in agent.robot.get_links()],
            user_joint_names=[joint.get_name() for joint in agent.robot.get_active_joints()], move_group=TOOL_LINK,
            **(limits if moves_pose(env.spec) else {}),
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
        waypoints = simulator_part(self._env.spec.task).waypoints(self._env.ground_truth[0])
        for number, waypoint in enumerate(waypoints, 1):
            pose = np.concatenate([waypoint, rotation])
            result = self._planner.plan_screw(pose, joints, time_step=PLANNER_TIME_STEP_S)
            if result["status"] != "Success":
                result = self._planner.plan_qpos_to_pose(pose, joints, time_step=PLANNER_TIME_STEP_S)
            if result["status"] != "Success":
                where = f"waypoint {number} of {len(waypoints)}, {np.round(waypoint, 3).tolist()}"
                raise PlanningError(f"no path to {where}: {result['status']}")
            for position in result["position"]:
                joints = np.concatenate([position, joints[len(position) :]])
                tools.append(self._forward_kinematics(joints)[:3])
        path: FloatArray = np.stack(tools).astype(np.float32)
        return path

    def start(self) -> FloatArray:
        """The environment's commanded state (7,), with its position in the world frame."""
        state: FloatArray = self._env.current().state[0, : self._env.spec.commanded_dim] + np.pad(ROBOT_BASE, (0, 4))
        return state

    def pose_path(self, waypoints: list[FloatArray]) -> FloatArray:
        """Plan through waypoints (7,) from the environment's current pose: commanded states (K, 7), positions in the
        world frame, one per control step.

        Raises:
            PlanningError: names the waypoint that no screw path reaches.
        """
        joints = self._env.scene.agent.robot.get_qpos()[0].numpy().astype(np.float64)
        period_s = self._env.spec.control_period_s
        state, path = self.start(), list[FloatArray]()
        for number, waypoint in enumerate(waypoints, 1):
            if np.array_equal(waypoint[:6], state[:6]):
                path += [waypoint] * (round(GRIPPER_S / period_s) if waypoint[6] != state[6] else 0)
            else:
                times, positions = self._plan_pose(waypoint, joints, f"{number} of {len(waypoints)}")
                for time_s in np.arange(1, np.ceil(times[-1] / period_s)) * period_s:
                    at = np.array([np.interp(time_s, times, angle) for angle in positions.T])
                    tool = self._forward_kinematics(np.concatenate([at, joints[len(at) :]]))
                    path.append(np.append(tool, waypoint[6]))
                joints = np.concatenate([positions[-1], joints[positions.shape[1] :]])
                path.append(waypoint)
            state = waypoint
        return np.stack(path).astype(np.float32)

    def _plan_pose(self, waypoint: FloatArray, joints: Joints, number: str) -> tuple[Joints, JointPath]:
        """Times (K,), s, and joint angles (K, 7) of a screw path. RRT-Connect is no way out where there is none: MPLib
        0.1.1 cannot seed it, and no episode would repeat."""
        pose = np.concatenate([waypoint[:3], quaternion_of(waypoint[3:6])])
        for step in SCREW_STEPS:
            try:
                result = self._planner.plan_screw(pose, joints, qpos_step=step, time_step=PLANNER_TIME_STEP_S)
            except RuntimeError as error:  # of the path's times
                result = {"status": str(error)}
            logging.getLogger("toppra").handlers.clear()  # MPLib adds one with every plan
            if result["status"] == "Success":
                return result["time"], result["position"]
        raise PlanningError(f"no path to waypoint {number}, {np.round(pose[:3], 3).tolist()}: {result['status']}")

    def _forward_kinematics(self, joints: Joints) -> FloatArray:
        """Tool position in the world frame and rotation vector from straight down, (6,)."""
        model = self._planner.pinocchio_model
        model.compute_forward_kinematics(joints)
        pose = model.get_link_pose(self._tool_index)
        return np.asarray(np.concatenate([pose[:3] + ROBOT_BASE, rotation_of(pose[3:])]), np.float32)


def _quieten(logger: logging.Logger) -> None:
    """Print nothing of it: what failed is in the PlanningError, in one line."""
    logger.propagate = False
    logger.addHandler(logging.NullHandler())


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


def track(path: FloatArray, spec: EnvironmentSpec) -> Callable[[FloatArray], FloatArray]:
    """Return act(state) -> action that commands the states of a path (K, 7) one after the other and holds the last;
    what is more than one full-scale action away takes several."""
    step, scale = 0, np.asarray(spec.action_scale[:6])

    def act(state: FloatArray) -> FloatArray:
        nonlocal step
        target = path[min(step, len(path) - 1)]
        action = np.concatenate(difference(state, target)) / scale
        largest = max(1.0, np.abs(action).max())
        step += int(largest <= 1.0 + 1e-4)
        return np.append(action / largest, target[6]).astype(np.float32)

    return act
