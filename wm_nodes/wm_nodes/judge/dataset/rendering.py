"""Episodes as states, and pictures of states without physics: the clips of the judges' benchmark.

A clip is drawn from recorded or edited states by a scene of its own: nearer cameras than the policy's, a tiled table,
clutter, coloured things of any size and number (RA-21). Shapes: T frames, K things, J joints, H W image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from numpy.typing import ArrayLike, NDArray

from wm_nodes.config.schema import SimulationConfig
from wm_nodes.config.tasks import get_task
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import BoolArray, FloatArray, Observation, UInt8Array
from wm_nodes.environments.maniskill.behaviours import turned
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import record_episode
from wm_nodes.environments.maniskill.scenes import make_scene, render

View = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Eye and target of a camera, m, world frame."""
CLIP_FOV_RAD = 0.72
"""With this a 4 cm cube is at least 9 px wide in 96 px."""
CAMERAS: Mapping[str, View] = {
    "near_side": ((0.22, 0.46, 0.34), (0.06, 0.0, 0.02)),
    "near_left": ((0.26, -0.42, 0.36), (0.06, 0.0, 0.02)),
    "near_right": ((0.40, 0.34, 0.38), (0.05, 0.0, 0.02)),
    "near_high": ((0.26, 0.30, 0.50), (0.06, 0.0, 0.0)),
}
MOVED_CAMERA = "moved"
"""The sensor that draws a View which is none of CAMERAS."""
HIDDEN = sapien.Pose(p=[0.0, 0.0, -9.0])
TILE_M, TILES = 0.06, 14
TILE_TOP_M, GOAL_Z_M = 0.0009, 0.0014
"""Over the plain sheet of scenes.py, whose top is at 0.6 mm; the goal is drawn over both."""
TOUCH_N = 0.05
"""A contact force beyond this is a touch."""
FINGERS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
MAX_ID = 30_000
"""Entities are never numbered twice, and ManiSkill gives the numbers as int16: beyond this the scene is new."""
BACKGROUND, ROBOT, THING, CLUTTER = 0, 1, 2, 3
"""Values of a mask, as dataset.edits.clips numbers them."""


@dataclass(frozen=True, eq=False)
class EpisodeStates:
    """What was so at each of T frames. robot_q: (T, J). tool: (T, 3) m. gripper_m: (T,). poses: (T, 1, 7) of the cube,
    x y z m and quaternion w x y z. contact: bool (T,), the hand touched it since the frame before. goal: (T, 3) m, z
    is NaN. actions: (T - 1, A) in [-1, 1]. commanded: (T, S), Observation.state. All floats float32, the others' frame
    is the world's.
    """

    robot_q: FloatArray
    tool: FloatArray
    gripper_m: FloatArray
    poses: FloatArray
    contact: BoolArray
    goal: FloatArray
    actions: FloatArray
    commanded: FloatArray


@dataclass(frozen=True)
class Layout:
    """Where the cube starts, x y m, and which way its goal lies, rad from +x to +y; the cube faces that way."""

    cube_m: tuple[float, float]
    heading_rad: float


@dataclass(frozen=True)
class SceneAppearance:
    """How a scene is drawn. Colours are RGB in [0, 1]. seed: of the tiles' shades and the clutter's places. shades:
    range of a tile's brightness over the table's. ambient: light from everywhere. lamp: direction and strength of a
    light besides the scene's own two, whose strength is 1 each. layout: of the episode; clutter lies beside its way,
    without one beside y = 0. tiled: the table has tiles; else it is the loops' plain one, of its own colour.
    """

    thing: tuple[float, float, float] = (0.05, 0.16, 0.63)
    table: tuple[float, float, float] = (0.78, 0.74, 0.66)
    num_clutter: int = 3
    seed: int = 0
    shades: tuple[float, float] = (0.75, 1.15)
    ambient: float = 0.3
    lamp: tuple[tuple[float, float, float], float] | None = None
    layout: Layout | None = None
    tiled: bool = True


@dataclass(frozen=True, eq=False)
class Drawing:
    """frames: uint8 (T, H, W, 3). masks: uint8 (T, H, W). tracks: "object" and "tool", float32 (T, 2) row and column
    in px, whole numbers at pixel centres, NaN out of view. others: uint8 (T, H, W, 3) by camera, drawn besides.
    """

    frames: UInt8Array
    masks: UInt8Array
    tracks: dict[str, FloatArray]
    others: dict[str, UInt8Array]


def record_states(env: ManiSkillEnvironment, behaviour: str, seed: int, layout: Layout | None = None) -> EpisodeStates:
    """Act one scripted episode in slot 0 and keep its states. Everything follows from the arguments.

    layout: in place of the task's own. The scene is built anew: what PhysX keeps of earlier episodes changes the last
    bits of the next contact.
    """
    scene, frames = env.scene, list[dict[str, Any]]()
    touched = [False]

    def feel() -> None:
        fingers = [scene.agent.robot.links_map[name] for name in FINGERS]
        forces = (scene.scene.get_pairwise_contact_forces(link, scene.obj) for link in fingers)
        touched[0] |= any(float(force.norm()) > TOUCH_N for force in forces)

    def keep() -> None:
        q = scene.agent.robot.get_qpos()[0].numpy().astype(np.float32)
        goal = np.append(scene.goal_region.pose.p[0, :2].numpy(), np.nan)
        frames.append({
            "robot_q": q, "tool": scene.agent.tcp.pose.p[0].numpy(), "gripper_m": q[-2:].sum(),
            "poses": scene.obj.pose.raw_pose[0].numpy()[None], "contact": touched[0], "goal": goal,
        })
        touched[0] = False

    scene.reset(seed=0, options={"reconfigure": True})
    env.reset(seeds=np.array([seed], np.uint64))
    rng, scale = numpy_stream(seed, "behaviour"), env.spec.action_scale[0]
    if layout is None:
        scripted = get_task(env.spec.task).script(behaviour, env.ground_truth[0], rng, scale)
    else:
        env.lay_out(layout.cube_m, layout.heading_rad)
        scripted = turned(behaviour, env.ground_truth[0], rng, scale, layout.heading_rad)

    def act(observation: Observation, truth: FloatArray) -> FloatArray:
        keep()
        return scripted(truth, observation.state[0])

    scene._after_simulation_step = feel  # ManiSkill calls it after each physics step
    try:
        episode = record_episode(env, act, behaviour, seed, 0)
    finally:
        del scene._after_simulation_step
    keep()
    arrays = {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}
    stacked = {name: a if name == "contact" else a.astype(np.float32) for name, a in arrays.items()}
    return EpisodeStates(**stacked, actions=episode.actions, commanded=episode.states)


class _ClipScene(BaseEnv):  # type: ignore[misc]
    """Mixin: the cameras of CAMERAS, one that is put anywhere, and no other."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        size = {"width": self.image_size, "height": self.image_size, "near": 0.01, "far": 10.0, "fov": CLIP_FOV_RAD}
        return [
            CameraConfig(name, pose=sapien_utils.look_at(eye=list(eye), target=list(target)), **size)
            for name, (eye, target) in {**CAMERAS, MOVED_CAMERA: CAMERAS["near_side"]}.items()
        ]


class ClipStage:
    """Draws states of one task's scene; physics never runs. policy: through the loops' own cameras in place of CAMERAS.

    Raises:
        NoRendererError: Vulkan finds no device.
    """

    def __init__(self, task: str, config: SimulationConfig, *, policy: bool = False) -> None:
        self._env = make_scene(get_task(task).scene, config, *(() if policy else (_ClipScene,)))
        self._size = config.image_size
        self._build()

    def draw(
        self, robot_q: FloatArray, poses: FloatArray, half_sizes_m: FloatArray, tool: FloatArray, goal: FloatArray,
        camera: str | View, look: SceneAppearance, others: Sequence[str] = (),
    ) -> Drawing:
        """Draw T frames.

        Args:
            robot_q: (T, J). poses: (T, K, 7). half_sizes_m: (T, K, 3), of boxes as they are seen. tool, goal: (T, 3).
            others: cameras that draw the same besides.

        Raises:
            ValueError: no such camera.
        """
        known = [name for name in self._env._sensors if name != MOVED_CAMERA]
        if isinstance(camera, str) and camera not in known:
            raise ValueError(f"unknown camera {camera!r}; choose one of {', '.join(known)}")
        labels = self._dress(look)
        sensor = self._env._sensors[camera if isinstance(camera, str) else MOVED_CAMERA]
        if not isinstance(camera, str):
            pose = sapien_utils.look_at(eye=list(camera[0]), target=list(camera[1])).sp
            sensor.camera._render_cameras[0].set_local_pose(pose)
        frames, masks, beside = [], [], {name: list[UInt8Array]() for name in others}
        for t in range(len(poses)):
            self._env.agent.robot.set_qpos(torch.from_numpy(robot_q[t])[None])
            place = self._env.goal_region.pose.raw_pose[0].numpy()
            place[:3] = *goal[t, :2], GOAL_Z_M
            self._env.goal_region.set_pose(sapien.Pose(p=place[:3], q=place[3:]))
            shown = [self._add_box(half, look.thing, pose) for half, pose in zip(half_sizes_m[t], poses[t])]
            self._env.scene.update_render()
            sensor.capture()
            seen = sensor.get_obs(rgb=True, depth=False, position=False, segmentation=True)
            ids = seen["segmentation"][0, ..., 0].numpy()
            frames.append(seen["rgb"][0].numpy())
            masks.append(_mask(ids, labels | {thing.per_scene_id: THING for thing in shown}))
            for name, pictures in beside.items():
                pictures.append(render(self._env, [name]))
            for thing in shown:
                thing.remove_from_scene()
        params = {name: values[0].numpy().astype(np.float64) for name, values in sensor.get_params().items()}
        points = {"object": poses[:, 0, :3], "tool": tool}
        tracks = {name: _project(places, params, self._size) for name, places in points.items()}
        return Drawing(np.stack(frames), np.stack(masks), tracks, {n: np.stack(seen) for n, seen in beside.items()})

    def close(self) -> None:
        self._env.close()

    def _build(self) -> None:
        """An empty scene, whose entities are counted from the start again."""
        self._env.reset(seed=0, options={"reconfigure": True})
        self._scene = self._env.scene.sub_scenes[0]
        self._env.obj.set_pose(HIDDEN)
        self._drawn: list[sapien.Entity] = []
        self._look: SceneAppearance | None = None
        self._labels: dict[int, int] = {}
        self._last_id = 0

    def _dress(self, look: SceneAppearance) -> dict[int, int]:
        """Lay the tiles and the clutter, unless they lie there; returns mask values by entity."""
        if self._last_id > MAX_ID:
            self._build()
        if self._look == look:
            return self._labels
        for entity in self._drawn:
            entity.remove_from_scene()
        self._drawn.clear()
        rng = numpy_stream(look.seed, "clip_look")
        table, half, tiles = np.array(look.table), TILE_M / 2, TILES if look.tiled else 0
        for i in range(tiles):
            for j in range(tiles):
                place = [TILE_M * (i - TILES / 2) + 0.05, TILE_M * (j - TILES / 2), TILE_TOP_M / 2]
                shade = np.clip(table * rng.uniform(*look.shades), 0, 1)
                self._drawn.append(self._add_box([half, half, TILE_TOP_M / 2], shade, [*place, 1, 0, 0, 0]))
        clutter = []
        for _ in range(look.num_clutter):
            size, side = rng.uniform(0.008, 0.016, 3), rng.choice([-1.0, 1.0])
            place = [rng.uniform(-0.08, 0.2), side * rng.uniform(0.1, 0.16), size[2], 1, 0, 0, 0]
            if look.layout is not None:
                place[:2] = _offset(look.layout, place[0], place[1])
            clutter.append(self._add_box(size, rng.uniform(0.1, 0.9, 3), place))
        self._drawn += clutter
        self._scene.render_system.ambient_light = [look.ambient] * 3
        if look.lamp is not None:
            self._drawn.append(self._add_lamp(*look.lamp))
        robot = {link._objs[0].entity.per_scene_id: ROBOT for link in self._env.agent.robot.links}
        self._look, self._labels = look, robot | {entity.per_scene_id: CLUTTER for entity in clutter}
        return self._labels

    def _add_box(self, half_size_m: ArrayLike, colour: ArrayLike, pose: ArrayLike) -> sapien.Entity:
        size, rgb, at = (np.asarray(values, np.float64).tolist() for values in (half_size_m, colour, pose))
        material = sapien.render.RenderMaterial(base_color=[*rgb, 1.0])
        body = sapien.render.RenderBodyComponent()
        body.attach(sapien.render.RenderShapeBox(size, material))
        entity = sapien.Entity()
        entity.add_component(body)
        entity.set_pose(sapien.Pose(p=at[:3], q=at[3:]))
        self._scene.add_entity(entity)
        self._last_id = int(entity.per_scene_id)
        return entity

    def _add_lamp(self, direction: tuple[float, float, float], strength: float) -> sapien.Entity:
        light = sapien.render.RenderDirectionalLightComponent()
        light.color = [strength] * 3
        entity = sapien.Entity()
        entity.add_component(light)
        entity.set_pose(sapien.Pose(q=sapien.math.shortest_rotation([1, 0, 0], direction)))
        self._scene.add_entity(entity)
        return entity


def _offset(layout: Layout, ahead_m: float, left_m: float) -> tuple[float, float]:
    """x y m of a place so far along a layout's way and to its left, from where its cube starts."""
    cos, sin = np.cos(layout.heading_rad), np.sin(layout.heading_rad)
    x, y = layout.cube_m
    return x + cos * ahead_m - sin * left_m, y + sin * ahead_m + cos * left_m


def _mask(ids: NDArray[Any], labels: Mapping[int, int]) -> UInt8Array:
    mask = np.full(ids.shape, BACKGROUND, np.uint8)
    for entity, label in labels.items():
        mask[ids == entity] = label
    return mask


def _project(points: FloatArray, params: Mapping[str, NDArray[np.float64]], size: int) -> FloatArray:
    """(T, 3) m, world frame, to (T, 2) row and column, px."""
    extrinsic, intrinsic = params["extrinsic_cv"], params["intrinsic_cv"]
    seen = (points @ extrinsic[:3, :3].T + extrinsic[:3, 3]) @ intrinsic.T
    place = seen[:, 1::-1] / seen[:, 2:] - 0.5
    place[((place < -0.5) | (place > size - 0.5)).any(1)] = np.nan
    tracked: FloatArray = place.astype(np.float32)
    return tracked
