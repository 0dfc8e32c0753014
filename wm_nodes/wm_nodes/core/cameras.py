"""Pinhole cameras: where they are and how they project. Lengths in m.

Optical axes (REP 103): x right, y down, z forward. Pixel (0, 0) is the centre of the first one, as in OpenCV.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera of an Environment. Raises ValueError: names the value and the remedy."""

    name: str
    """As in EnvironmentSpec.cameras."""
    width: int
    """Of its picture, px."""
    height: int
    """Of its picture, px."""
    K: Matrix
    """(3, 3), px, of a picture without distortion."""
    pose: Matrix | Callable[[int], Matrix]
    """(4, 4), from its optical axes to the robot's base frame; of a camera that moves, a function that gives it for
    environment 0 to N - 1 as of the last observation."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z]\w*", self.name, re.ASCII):
            raise ValueError(f"camera {self.name!r}: a name of letters, digits and _ is part of its topics' names")
        if np.shape(self.K) != (3, 3) or not np.isfinite(self.K).all() or min(self.K[0][0], self.K[1][1]) <= 0:
            raise ValueError(f"camera {self.name}: K must be 3 x 3 with focal lengths in px, got {self.K!r}")
        if not callable(self.pose):
            check_pose(self.pose, self.name)

    @property
    def moves(self) -> bool:
        return callable(self.pose)

    def pose_in(self, env: int = 0) -> Matrix:
        """The pose (4, 4) in environment `env`. Raises ValueError where it is none."""
        return check_pose(self.pose(env) if callable(self.pose) else self.pose, self.name)


def check_pose(pose: Matrix, name: str) -> Matrix:
    """Return a camera's pose. Raises ValueError unless it is a rotation and a translation."""
    matrix = np.asarray(pose, np.float64)
    rotation = matrix[:3, :3] if matrix.shape == (4, 4) and np.isfinite(matrix).all() else np.zeros((3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError(f"camera {name}: pose must be 4 x 4, optical axes to base frame, got {pose!r}")
    return matrix


def intrinsics(width: int, height: int, fov_rad: float) -> Matrix:
    """K of square pixels and a vertical field of view `fov_rad`, looking along the picture's centre."""
    focal = height / 2 / np.tan(fov_rad / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def look_at(eye: Sequence[float], target: Sequence[float]) -> Matrix:
    """Pose (4, 4) of a camera at `eye` that looks at `target`, upright with respect to +z."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.asarray(eye, np.float64)], axis=1)
    return pose


def quaternion(rotation: Matrix) -> Matrix:
    """(x, y, z, w), w >= 0, of a rotation (3, 3): the eigenvector of Bar-Itzhack's matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rotation, np.float64)
    symmetric = np.array([
        [xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, yy - xx - zz, zy + yz, xz - zx],
        [zx + xz, zy + yz, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ])
    best: Matrix = np.linalg.eigh(symmetric)[1][:, -1]
    return best if best[3] >= 0 else -best
