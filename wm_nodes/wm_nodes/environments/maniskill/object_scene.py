"""ManiSkill environment of the procedural scenes: a Panda at a table, one object, one container, perhaps a carpet.

Every reset builds its scene anew (ManiSkill's reconfigure). A robot that stays, or parts that are taken out and put
back, leave traces in PhysX: half of the episodes then depended on those before them.
"""

from typing import Any

import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.scene_builder.table import TableSceneBuilder

from wm_nodes.config.scenes import Scene, scene_of
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.maniskill.layouts import Place
from wm_nodes.environments.maniskill.scene_parts import COLOURS, build_carpet, build_container, build_object


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

    def evaluate(self) -> dict[str, Any]:
        return {}

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {}
