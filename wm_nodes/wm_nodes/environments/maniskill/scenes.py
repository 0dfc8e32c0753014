"""ManiSkill's table-top environments with our two cameras and a plain table top; physics unchanged.

What differs from the stock picture: two near cameras (the stock one shows the cube 2 px wide), a thin plain sheet in
place of the wooden table and the ground (visual only), arm links 0 to 6 not drawn (they are outside or at the edge of
both views and cost two thirds of the rendering), and fingers closed from the start.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env

from wm_nodes.config.environments import SimulationConfig
from wm_nodes.environments.maniskill.backend import render_backend
from wm_nodes.environments.maniskill.cameras import PLACEMENTS

SIMULATION_HZ = 100
TABLE_COLOUR = (0.78, 0.74, 0.66, 1.0)
LINKS_NOT_DRAWN = tuple(f"panda_link{i}" for i in range(7))


class TableTopScene(BaseEnv):  # type: ignore[misc]
    """Mixin before a ManiSkill table-top task. cameras: names of PLACEMENTS. image_size: of each, px."""

    table_colour = TABLE_COLOUR

    def __init__(self, *args: Any, image_size: int, cameras: Sequence[str], **options: Any) -> None:
        self.image_size, self.cameras = image_size, cameras
        super().__init__(*args, **options)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        common = {"width": self.image_size, "height": self.image_size, "near": 0.01, "far": 10.0}
        hand = self.agent.robot.links_map["panda_hand"]
        return [
            CameraConfig(
                name, pose=sapien_utils.look_at(eye=list(camera.eye), target=list(camera.target)), fov=camera.fov_rad,
                mount=hand if camera.on_hand else None, **common,
            )
            for name, camera in PLACEMENTS.items() if name in self.cameras
        ]

    def _load_scene(self, options: dict[str, Any]) -> None:
        super()._load_scene(options)
        sheet = self.scene.create_actor_builder()
        material = sapien.render.RenderMaterial(base_color=list(self.table_colour))
        sheet.add_box_visual(half_size=[0.6, 0.8, 0.0003], material=material)
        sheet.initial_pose = sapien.Pose(p=[0.1, 0.0, 0.0003])
        sheet.build_kinematic(name="plain_table_top")
        for actor in (self.table_scene.table, self.table_scene.ground):
            _do_not_draw(actor._objs)
        for link in self.agent.robot.links:
            if link.name in LINKS_NOT_DRAWN:
                _do_not_draw([obj.entity for obj in link._objs])

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        super()._initialize_episode(env_idx, options)
        joint_positions = self.agent.robot.get_qpos()
        joint_positions[:, -2:] = 0.0
        self.agent.reset(joint_positions)


def renew_physics(scene: BaseEnv) -> None:
    """Move everything in the scene to a physics system of its own, in the order in which it was built. A millisecond.

    A PhysX system that has simulated episodes treats contacts in another order than a new one, whatever poses and
    velocities a reset sets, and taking all bodies out and putting them back does not help: the same actions moved the
    cube up to 12 mm elsewhere. Reset in a new system, an episode goes as the first one of a process.
    """
    scene._set_scene_config()
    used = scene.scene.sub_scenes[0]
    physics = sapien.physx.PhysxCpuSystem()
    physics.timestep = used.timestep
    renewed = sapien.Scene([physics, used.render_system])
    entities = used.entities
    used.clear()
    for entity in entities:
        renewed.add_entity(entity)
    scene.scene.sub_scenes[0], scene.scene.px = renewed, physics


def make_scene(
    scene: Callable[[], type[BaseEnv]], config: SimulationConfig, *mixins: type[BaseEnv], **options: Any
) -> BaseEnv:
    """Build the scene of a task (Task.scene) on the CPU physics, rendered by config.render_device.

    mixins: classes before TableTopScene. options: ManiSkill's.
    """
    views = {"image_size": config.image_size, "cameras": tuple(config.cameras)}
    return make(_registered(scene, mixins), config, **views, **options).unwrapped


@functools.cache
def _registered(scene: Callable[[], type[BaseEnv]], mixins: tuple[type[BaseEnv], ...]) -> str:
    """The name under which gymnasium makes the scene, built and registered once in a process."""
    name = ".".join([*(mixin.__qualname__ for mixin in mixins), scene.__module__, scene.__qualname__]) + "-v1"
    register_env(name, max_episode_steps=10_000)(type(name, (*mixins, TableTopScene, scene()), {}))
    return name


def make(scene: str, config: SimulationConfig, **options: Any) -> gym.Env[Any, Any]:
    """Build a scene of ours or of ManiSkill; options are ManiSkill's."""
    usual = {"obs_mode": "rgb", "control_mode": "pd_ee_target_delta_pos"}
    return gym.make(
        scene, sim_backend="physx_cpu", render_backend=render_backend(config.render_device),
        sim_config={"sim_freq": SIMULATION_HZ, "control_freq": _control_frequency(config.control_hz)},
        **(usual | options),
    )


def render(scene: BaseEnv, cameras: Sequence[str]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return uint8 (H, len(cameras) * W, 3), cameras side by side."""
    scene.scene.update_render()
    views = []
    for name in cameras:
        camera = scene._sensors[name]
        camera.capture()
        views.append(camera.get_obs(rgb=True, depth=False, position=False, segmentation=False)["rgb"][0].numpy())
    return np.concatenate(views, axis=1)


def _control_frequency(control_hz: float) -> int:
    if control_hz % 1 or SIMULATION_HZ % control_hz:
        raise ValueError(f"simulation.control_hz must be a whole number that divides {SIMULATION_HZ}, got {control_hz}")
    return int(control_hz)


def _do_not_draw(entities: list[sapien.Entity]) -> None:
    for entity in entities:
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is not None:
            body.disable()
