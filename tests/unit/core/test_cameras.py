"""Camera geometry: poses and rotations worked by hand, and what is no camera."""

import numpy as np
import pytest

from wm_nodes.core.cameras import CameraModel, Matrix, intrinsics, look_at, quaternion


def test_a_camera_above_the_table_sees_plus_x_to_the_right_when_it_looks_along_plus_y() -> None:
    pose = look_at(eye=(0.0, -1.0, 1.0), target=(0.0, 0.0, 0.0))
    forward = np.array([0.0, 1.0, -1.0]) / np.sqrt(2)
    np.testing.assert_allclose(pose[:3, :3], np.stack([[1, 0, 0], [0, -(0.5**0.5), -(0.5**0.5)], forward], axis=1))
    np.testing.assert_allclose(pose[:3, 3], [0, -1, 1])


def test_the_edge_of_the_field_of_view_is_the_edge_of_the_picture() -> None:
    matrix = intrinsics(64, 48, fov_rad=np.pi / 2)
    top = matrix @ [0.0, -1.0, 1.0]
    np.testing.assert_allclose(top / top[2], [31.5, -0.5, 1])
    np.testing.assert_allclose(matrix @ [0.0, 0.0, 1.0], [31.5, 23.5, 1])


HALF = 0.5**0.5
TURNS: list[tuple[Matrix, list[float]]] = [
    (np.eye(3), [0, 0, 0, 1]),
    (np.diag([1.0, -1.0, -1.0]), [1, 0, 0, 0]),
    (np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0, 0, HALF, HALF]),
    (np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [-0.5, 0.5, -0.5, 0.5]),  # body axes to optical axes
]


@pytest.mark.parametrize(("rotation", "expected"), TURNS)
def test_a_quaternion_is_x_y_z_w_of_the_rotation(rotation: Matrix, expected: list[float]) -> None:
    found = quaternion(rotation)
    np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-12)
    assert found[3] >= 0


def test_a_camera_that_moves_is_asked_for_its_pose_in_an_environment() -> None:
    poses = np.stack([look_at((0, 0, 1), (0, 1, 0)), look_at((2, 0, 1), (0, 1, 0))])
    still = CameraModel("top", 4, 4, intrinsics(4, 4, 1.0), poses[0])
    moving = CameraModel("hand", 4, 4, intrinsics(4, 4, 1.0), lambda env: poses[env])
    assert moving.moves and not still.moves
    np.testing.assert_array_equal(moving.pose_in(1), poses[1])
    np.testing.assert_array_equal(still.pose_in(1), poses[0])


def test_what_is_no_camera_is_refused_by_name() -> None:
    matrix, pose = intrinsics(4, 4, 1.0), np.eye(4)
    for arguments, words in (
        (("to p", 4, 4, matrix, pose), "camera 'to p'.*letters"),
        (("top", 4, 4, np.zeros((3, 3)), pose), "camera top: K must be 3 x 3"),
        (("top", 4, 4, matrix, np.eye(3)), "camera top: pose must be 4 x 4"),
        (("top", 4, 4, matrix, np.diag([1.0, 1, -1, 1])), "camera top: pose must"),
    ):
        with pytest.raises(ValueError, match=words):
            CameraModel(*arguments)
    with pytest.raises(ValueError, match="camera hand: pose must"):
        CameraModel("hand", 4, 4, matrix, lambda env: np.full((4, 4), np.nan)).pose_in()
