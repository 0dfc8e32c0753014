"""Ground truth of the procedural scenes, and the rules that several tasks share. Lengths in m, P: GROUND_TRUTH_NAMES.

The first eleven are in the order of table_top.py, so that its slices hold here too.
"""

from typing import Any

import numpy as np

from wm_nodes.config.tasks import WeakPolicy
from wm_nodes.core.types import BoolArray, FloatArray
from wm_nodes.environments.maniskill.table_top import CUBE, CUBE_START, GOAL

GROUND_TRUTH_NAMES = (
    "object_x", "object_y", "object_z", "object_yaw", "tool_x", "tool_y", "tool_z", "goal_x", "goal_y",
    "object_start_x", "object_start_y", "object_bottom_z", "object_speed", "gripper_opening", "grasped", "container_x",
    "container_y", "container_radius", "container_height",
)
"""object_bottom_z: lowest point of the object above the table. object_speed: m/s. gripper_opening: between the fingers.
grasped: 1 where both fingers press on the object."""
POSITIONS = {name: name for name in ("object_x", "object_y", "tool_x", "tool_y", "tool_z")}
"""What probes learn where the pictures do not show the goal, see config/tasks.py: ModelPart."""
WITH_GOAL = POSITIONS | {name: name for name in ("goal_x", "goal_y")}
STARTS = ("object_start_x", "object_start_y")
"""Where the object was at the reset."""
STATE = ("object_x", "object_y", "object_z", "container_x", "container_y", "goal_x", "goal_y", *STARTS)
"""What a state may hold of the ground truth."""
NO_CARPET = ("goal_x", "goal_y")
"""What is hidden where no carpet is the goal: a container that is the goal is told as container."""
MIDDLE_M = 0.02
"""About where the middle of an object is above the table."""
OBJECT, OBJECT_START = CUBE, CUBE_START
BOTTOM, SPEED, OPENING, GRASPED, RADIUS, HEIGHT = 11, 12, 13, 14, 17, 18
CONTAINER = slice(15, 17)
MODEL_TASKS = ("move_to_aim", "pick_place", "pull", "push", "reach_object")
"""One world model serves them."""
SETTINGS = {
    "simulation.scenes": "train", "simulation.cameras": ["front", "wrist"], "simulation.max_action_m": 0.1,
    "simulation.max_episode_steps": 40, "world_model.part_steps": 16, "world_model.condition_map": 256,
    "world_model.latent_weight": 10.0, "sft.num_demonstrations": 400, "tokenizer.foreground": "surroundings",
    "tokenizer.latent_dim": 48, "tokenizer.probe_weight": 1.0, "tokenizer.probe_depth": 2,
    "tokenizer.probe_iterations": 7000, "sft.num_iterations": 3000, "ppo.num_envs": 64, "ppo.num_steps": 40,
    "ppo.advantage_floor": 0.1, "policy.init_log_std": -3.0, "policy.inputs": "state",
}
"""Of every task in these scenes. A rollout begins with a reset and is as long as an episode: what comes after it would
never be trained on."""
GRASPING = {"policy.two_valued_actions": ["gripper"]}
"""Of tasks with a grasp."""
ON_TABLE_M = 0.01
"""An object whose lowest point is below this lies on the table."""


def policy_sees(*places: str) -> dict[str, list[str]]:
    """Of a task whose policies need these places, of container and goal, beside the object's."""
    others = tuple({"container", "goal", "object_start"} - {*places})
    return {"policy.ignored_state": [name for name in STATE if name.startswith(others)]}


def weak_policies(number: int) -> tuple[WeakPolicy, ...]:
    """Those of one task, 0 to 4: a better one that explores much, and a worse one that goes on after its misses."""
    return WeakPolicy(number, 100, 0.25), WeakPolicy(number + len(MODEL_TASKS), 25, 0.1)


def measure(scene: Any, start: FloatArray | None) -> FloatArray:
    """Ground truth (P,) of an ObjectScene. start: that of the reset, None at the reset."""
    from transforms3d.euler import quat2euler

    from wm_nodes.environments.maniskill.scene_parts import CONTAINER_HEIGHT_M, CONTAINER_RADIUS_M
    from wm_nodes.environments.maniskill.shape import bottom_m

    layout, shape = scene.layout, scene.catalogue_scene
    pose = scene.object.pose.raw_pose[0].numpy()
    tool = scene.agent.tcp.pose.p[0].numpy()
    speed = float(np.linalg.norm(scene.object.linear_velocity[0].numpy()))
    opening = float(scene.agent.robot.get_qpos()[0, -2:].sum())
    first = pose[:2] if start is None else start[OBJECT_START]
    return np.asarray(np.concatenate([
        pose[:3], [quat2euler(pose[3:])[2]], tool, layout.goal, first,
        [bottom_m(shape.shape, pose[2], pose[3:]), speed, opening, float(scene.agent.is_grasping(scene.object)[0])],
        layout.container, [CONTAINER_RADIUS_M, CONTAINER_HEIGHT_M[shape.container]],
    ]), np.float32)


def on_table(truth: FloatArray) -> BoolArray:
    return np.asarray(truth[..., BOTTOM] < ON_TABLE_M)


def pushed(truth: FloatArray, direction: int, distance_m: float, aside_m: float) -> BoolArray:
    """Whether the object went at least `distance_m` along x in `direction`, 1 or -1, at most `aside_m` to the
    side, and lies on the table."""
    way = truth[..., OBJECT][..., :2] - truth[..., OBJECT_START]
    return np.asarray((direction * way[..., 0] >= distance_m) & (np.abs(way[..., 1]) <= aside_m) & on_table(truth))


def goal_distance(truth: FloatArray) -> FloatArray:
    """Of the object's centre from the goal, in the plane."""
    distance: FloatArray = np.linalg.norm(truth[..., OBJECT][..., :2] - truth[..., GOAL], axis=-1)
    return distance
