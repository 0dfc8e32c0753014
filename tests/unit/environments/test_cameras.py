"""Where the cameras say that things are, against where the simulator draws them; and what the world model says."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sapien
from model_folders import make_model_folder
from numpy.typing import NDArray
from safetensors.numpy import save_file
from transforms3d.euler import euler2quat

from wm_nodes.config.load import load_config
from wm_nodes.core.cameras import CameraModel
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.cameras import hand_over, table_top_cameras
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.table_top import CUBE_HALF_SIZE_M
from wm_nodes.policy_rl.factories import make_imagined_environment

SIDE_PX = 256
CONFIG = load_config("smoke", {"simulation.image_size": SIDE_PX})
CORNERS_M = CUBE_HALF_SIZE_M * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment("push_cube", CONFIG.simulation, num_envs=1)
    yield environment
    environment.close()


def pixels(camera: CameraModel, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 2) u, v of points (K, 3) in the base frame."""
    pose = np.linalg.inv(camera.pose_in(0))
    seen = camera.K @ (pose[:3, :3] @ points_m.T + pose[:3, 3:])
    return (seen[:2] / seen[2]).T


def outlines(env: ManiSkillEnvironment, place: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least u, v and largest u, v of the cube in the picture of a camera, and of its corners' projections."""
    cube = env.scene.obj.pose.to_transformation_matrix()[0].numpy()
    corners = CORNERS_M @ cube[:3, :3].T + cube[:3, 3] - ROBOT_BASE
    red, green, blue = np.split(env.current().image[0].astype(int), 2, axis=1)[place].transpose(2, 0, 1)
    v, u = np.nonzero((blue > red + 60) & (blue > green + 20))
    expected = pixels(env.cameras[place], corners)
    return np.array([u.min(), v.min(), u.max(), v.max()], float), np.concatenate([expected.min(0), expected.max(0)])


@pytest.mark.rendering
def test_the_cubes_corners_project_onto_the_edges_of_its_picture(env: ManiSkillEnvironment) -> None:
    env.reset(seeds=np.array([4], np.uint64))
    off, height = [], float(env.scene.obj.pose.raw_pose[0, 2])
    for x, y in ((0.08, -0.12), (0.11, -0.08), (0.14, -0.03), (0.17, 0.03), (0.2, 0.06)):
        env.scene.obj.set_pose(sapien.Pose([x, y, height], euler2quat(0, 0, 0.3)))
        env._start(0)  # so that it is drawn
        found, expected = outlines(env, 0)
        np.testing.assert_allclose(found, expected, atol=1.2)
        off.append((found - expected).reshape(2, 2).mean(0))
    assert np.abs(np.mean(off, 0)).max() < 0.3  # half a pixel is what another corner to count from would make


@pytest.mark.rendering
def test_the_camera_on_the_hand_sees_the_cube_where_it_projects(env: ManiSkillEnvironment) -> None:
    env.reset(seeds=np.array([4], np.uint64))
    env.step(np.array([[0.3, 0.2, -0.3]], np.float32))
    found, expected = outlines(env, 1)
    np.testing.assert_allclose(found[:3], expected[:3], atol=1.2)  # the fingers hide the lower edge


@pytest.mark.rendering
def test_pose_and_intrinsics_are_the_simulators_also_after_the_hand_has_moved(env: ManiSkillEnvironment) -> None:
    env.reset(seeds=np.array([7], np.uint64))
    env.step(np.array([[0.5, -1, 0.25]], np.float32))
    for camera in env.cameras:
        rendered = env.scene._sensors[camera.name].camera
        world_from_camera = camera.pose_in(0).copy()
        world_from_camera[:3, 3] += ROBOT_BASE
        seen_from_world = rendered.get_extrinsic_matrix()[0].numpy()
        np.testing.assert_allclose(seen_from_world @ world_from_camera, np.eye(4)[:3], atol=1e-5, err_msg=camera.name)
        half = np.zeros((3, 3))
        half[:2, 2] = 0.5  # SAPIEN counts from the corner of the first pixel, ROS from its centre
        np.testing.assert_allclose(rendered.get_intrinsic_matrix()[0].numpy() - half, camera.K, rtol=1e-6)


@pytest.mark.rendering
def test_a_hand_that_is_only_known_by_the_commanded_tool_is_almost_where_the_simulators_is(
    env: ManiSkillEnvironment,
) -> None:
    for seed in (3, 4, 5):
        env.reset(seeds=np.array([seed], np.uint64))
        env.step(np.array([[0.3, 0.2, -0.3]], np.float32))
        side, wrist = table_top_cameras(CONFIG.simulation, lambda i: hand_over(env.current().state[i]))
        np.testing.assert_array_equal(side.pose_in(0), env.cameras[0].pose_in(0))
        off = np.linalg.inv(wrist.pose_in(0)) @ env.cameras[1].pose_in(0)
        assert np.linalg.norm(off[:3, 3]) < 0.012
        assert np.arccos((np.trace(off[:3, :3]) - 1) / 2) < 0.1


def test_the_world_model_says_where_its_cameras_are_and_starts_no_simulator(tmp_path: Path) -> None:
    config = load_config("smoke")
    model = make_model_folder(tmp_path / "model", config)
    size = config.simulation.image_size
    images, states = np.zeros((2, size, 2 * size, 3), np.uint8), np.array([[0.6, 0.0, 0.2]] * 2, np.float32)
    save_file({"images": images, "states": states}, tmp_path / "starts.safetensors")
    imagined = make_imagined_environment(config, model, tmp_path / "starts.safetensors", num_envs=2, seed=0)
    imagined.reset()
    side, wrist = imagined.cameras
    assert (side.name, wrist.name, side.moves, wrist.moves) == ("side", "wrist", False, True)
    np.testing.assert_allclose(side.pose_in()[:3, 3], [0.09 + 0.615, 0.5, 0.45])
    before = [wrist.pose_in(n) for n in range(2)]
    np.testing.assert_allclose(before[1][:3, 3], [0.6 + 0.06, 0.0, 0.2 + 0.1034], atol=1e-6)
    imagined.step(np.array([[0, 0, 0], [0, 0.5, 0]], np.float32))
    moved = [wrist.pose_in(n)[:3, 3] - before[n][:3, 3] for n in range(2)]
    np.testing.assert_allclose(moved, [[0, 0, 0], [0, 0.5 * config.simulation.max_action_m, 0]], atol=1e-6)
    loaded = "import sys, wm_nodes.policy_rl.factories; sys.exit('sapien' in sys.modules)"
    subprocess.run([sys.executable, "-c", loaded], check=True)
