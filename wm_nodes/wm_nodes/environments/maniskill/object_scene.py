"""ManiSkill environment of the procedural scenes: a Panda at a table, one object, one container, perhaps a carpet.

Every reset builds its scene anew (ManiSkill's reconfigure). A robot that stays, or parts that are taken out and put
back, leave traces in PhysX: half of the episodes then depended on those before them.
"""

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from transforms3d.euler import euler2quat

from wm_nodes.config.scenes import Scene, scene_of
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.maniskill.layouts import ANYWHERE, Place, free_of
from wm_nodes.environments.maniskill.scene_parts import COLOURS, build_carpet, build_container, build_object
from wm_nodes.environments.maniskill.shape import get_shape

NEAR_M = 0.1
"""Along x and y, of an object that is put near the tool."""
BESIDE_M, ABOVE_M = 0.07, 0.08
"""It does not touch a tool that is so far beside, or so high above the table."""


class ObjectScene(BaseEnv):  # type: ignore[misc]
    """Base of the tasks' scenes; reset takes options={"scene": a config.scenes.Scene}, by default one of train.

    After a reset: catalogue_scene, layout, object (the actor).
    """

    SUPPORTED_ROBOTS = ("panda",)
    place: Place
    """Draws the layout; of the task."""

    def __init__(self, *args: Any, robot_uids: str = "panda", **options: Any) -> None:
        super().__init__(*args, robot_uids=robot_uids, **options)

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed, {**(options or {}), "reconfigure": True})

    def _clear(self) -> None:
        """Forget the former scene. ManiSkill's own waits for a full collection of garbage, a second or two; reference
        counts free nearly all of it."""
        self._close_viewer()
        self.agent = self.scene = None
        self._sensors: dict[str, Any] = {}
        self._human_render_cameras: dict[str, Any] = {}
        self._hidden_objects: list[Any] = []

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict[str, Any]) -> None:
        seed = int(self._episode_seed[0])
        scene = options.get("scene") or scene_of("train", seed)
        assert scene is not None
        self.catalogue_scene: Scene = scene
        self.layout = self.place(numpy_stream(seed, "layout"))
        self.table_colour = (*COLOURS[self.catalogue_scene.table], 1.0)
        self.table_scene = TableSceneBuilder(env=self)
        self.table_scene.build()
        self.object = build_object(self.scene, scene, self.layout.object, self.layout.object_yaw)
        build_container(self.scene, scene.container, self.layout.container)
        if self.layout.carpet:
            build_carpet(self.scene, self.layout.goal)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        self.table_scene.initialize(env_idx)

    def scatter(self, rng: np.random.Generator) -> None:
        """Put the object to rest elsewhere on the table, half of the times near the tool, never in its way."""
        agent: Any = self.agent
        tool = agent.tcp.pose.p[0].numpy()
        while True:
            place = rng.uniform(*ANYWHERE)
            if rng.random() < 0.5:
                place = np.clip(tool[:2] + rng.uniform(-NEAR_M, NEAR_M, 2), *ANYWHERE)
            if free_of(self.layout.container, place, place) and (
                tool[2] > ABOVE_M or np.linalg.norm(place - tool[:2]) > BESIDE_M
            ):
                break
        height = get_shape(self.catalogue_scene.shape).rest_height_m
        self.object.set_pose(sapien.Pose([*place, height], euler2quat(0, 0, rng.uniform(-np.pi, np.pi))))
        self.object.set_linear_velocity(torch.zeros(3))
        self.object.set_angular_velocity(torch.zeros(3))

    def evaluate(self) -> dict[str, Any]:
        return {}

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {}
