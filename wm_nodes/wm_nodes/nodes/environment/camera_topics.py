"""What ROS tools need of each camera: picture, calibration and frame. Nothing is made that nobody looks at."""

import time

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from sensor_msgs.msg import CameraInfo, Image

from wm_nodes.core.cameras import CameraModel, quaternion
from wm_nodes.core.types import Environment, UInt8Array
from wm_nodes.recording.messages import BASE_FRAME, time_ns
from wm_nodes.ros import convert
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.qos import TOPICS


def camera_info_msg(camera: CameraModel, stamp_ns: int, frame_id: str) -> CameraInfo:
    """Calibration of a picture without distortion."""
    message = CameraInfo(height=camera.height, width=camera.width, distortion_model="plumb_bob", d=[0.0] * 5)
    message.header = convert.header(stamp_ns, frame_id)
    message.k[:] = np.ravel(camera.K)
    message.r[::4] = [1.0] * 3
    message.p.reshape(3, 4)[:, :3] = camera.K
    return message


def transform_msg(camera: CameraModel, env: int, stamp_ns: int, frame_id: str) -> TransformStamped:
    """From the base frame to the camera's optical frame `frame_id`, in environment `env`."""
    pose = camera.pose_in(env)
    (tx, ty, tz), (x, y, z, w) = pose[:3, 3].tolist(), quaternion(pose[:3, :3]).tolist()
    transform = Transform(translation=Vector3(x=tx, y=ty, z=tz), rotation=Quaternion(x=x, y=y, z=z, w=w))
    return TransformStamped(header=convert.header(stamp_ns), child_frame_id=frame_id, transform=transform)


def cameras_of(environment: Environment) -> dict[int, CameraModel]:
    """The environment's own description of its cameras, by place in spec.cameras; empty where it has none.

    Raises:
        ValueError: one that does not fit the spec.
    """
    spec, models = environment.spec, dict[int, CameraModel]()
    for camera in getattr(environment, "cameras", ()):
        if camera.name not in spec.cameras:
            raise ValueError(f"environment {spec.env_id}: camera {camera.name!r} is none of {list(spec.cameras)}")
        size, expected = (camera.width, camera.height), (spec.width // len(spec.cameras), spec.height)
        if size != expected:
            raise ValueError(
                f"environment {spec.env_id}: camera {camera.name} says {size} px (W, H), its picture has {expected}"
            )
        models[spec.cameras.index(camera.name)] = camera
    return models


class _Outlets:
    """The publishers of one camera."""

    def __init__(self, node: ManagedNode, camera: CameraModel) -> None:
        below = f"env/camera/{camera.name}"
        self.image = node.publish_unnumbered(f"{below}/image_raw")
        self.info = node.publish_unnumbered(f"{below}/camera_info")
        self.transform = node.publish_unnumbered(f"{below}/transform")
        names = [*node.get_namespace().split("/"), "camera", camera.name, "optical"]
        self.frame_id = "_".join(filter(None, names))


class CameraTopics:
    """Publishes env/camera/<name>/camera_info, transform and image_raw, and /tf_static and /tf where tf2_msgs is
    installed, until the node's cleanup.

    The pictures, and the frames of cameras that move, are those of environment `view_env` (0 where that is -1).
    """

    def __init__(self, node: ManagedNode, environment: Environment) -> None:
        self._node = node
        self._cameras = cameras_of(environment)
        self._outlets = {place: _Outlets(node, camera) for place, camera in self._cameras.items()}
        self._last_s = -1e9
        self._tf = None
        if not self._cameras:
            node.get_logger().info(
                f"environment {environment.spec.env_id} says nothing about its cameras: no camera_info, image_raw and "
                "frames; give it the attribute `cameras` (wm_nodes/core/cameras.py)"
            )
            return
        now = node.get_clock().now().nanoseconds
        static = []
        for place, camera in self._cameras.items():
            outlets = self._outlets[place]
            outlets.info.publish(camera_info_msg(camera, now, outlets.frame_id))
            if not camera.moves:
                static.append(transform_msg(camera, 0, now, outlets.frame_id))
                outlets.transform.publish(static[-1])
        if "/tf" in TOPICS:
            message = TOPICS["/tf"].type
            self._tf = node.publish_unnumbered("/tf")
            if static:
                node.publish_unnumbered("/tf_static").publish(message(transforms=static))

    @property
    def mosaic_frame_id(self) -> str:
        """The frame of env/image, which is in the TF: that of the first camera, and without cameras the base."""
        return next((outlets.frame_id for outlets in self._outlets.values()), BASE_FRAME)

    def show(self, images: UInt8Array, mosaic: Image) -> None:
        """Publish what is due. images: uint8 (N, H, W, 3); mosaic: the env/image message of the same observation."""
        tf_watched = self._tf is not None and self._tf.get_subscription_count() > 0
        watched = [place for place, outlets in self._outlets.items() if outlets.image.get_subscription_count()]
        moving = [
            place for place, camera in self._cameras.items()
            if camera.moves and (tf_watched or self._outlets[place].transform.get_subscription_count())
        ]
        if not watched and not moving:
            return
        env = max(0, int(self._node.param("view_env")))
        if env >= len(images):
            return
        transforms, stamp_ns = [], time_ns(mosaic.header.stamp)
        for place in moving:
            outlets = self._outlets[place]
            try:
                transforms.append(transform_msg(self._cameras[place], env, stamp_ns, outlets.frame_id))
            except Exception as error:  # the environment's own code, which a viewer's wish must not let fail a step
                self._node.diagnostics.count("camera_pose_errors", text=f"{type(error).__name__}: {error}")
                continue
            outlets.transform.publish(transforms[-1])
        if self._tf is not None and transforms:
            self._tf.publish(TOPICS["/tf"].type(transforms=transforms))
        now = time.monotonic()
        if now - self._last_s < float(self._node.param("view_period_s")):
            return
        self._last_s = now
        for place in watched:
            camera, outlets = self._cameras[place], self._outlets[place]
            left = place * camera.width
            message = convert.image_msg(images[env][:, left : left + camera.width], stamp_ns, mosaic.encoding)
            message.header.frame_id = outlets.frame_id
            outlets.info.publish(camera_info_msg(camera, stamp_ns, outlets.frame_id))
            outlets.image.publish(message)
