"""What people watch of an environment: one of N alone, and the mosaic as JPEG. Nothing is made that nobody looks at."""

import time

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from wm_nodes.core.types import UInt8Array
from wm_nodes.ros import convert
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.qos import VIEW

PARAMS = (
    Param("view_env", -1, "Also publish this environment's image alone on env/image/view while someone looks; -1: "
          "none. env/camera/<name>/image_raw and /tf show it too, at -1 environment 0", minimum=-1, maximum=4095),
    Param("view_period_s", 0.066, "Least time between two env/image/view, or two env/camera/<name>/image_raw", "s",
          minimum=0.0, maximum=10.0),
    Param("compressed", "subscribed", "When to publish env/image/compressed (JPEG, for remote viewers)",
          choices=("subscribed", "always", "never")),
    Param("compressed_period_s", 0.066, "Least time between two env/image/compressed", "s", minimum=0.0, maximum=10.0),
    Param("compressed_quality", 90, "JPEG quality", minimum=1, maximum=100),
)


def jpeg_msg(mosaic: Image, quality: int) -> CompressedImage:
    """An rgb8 image as a JPEG (quality 1 to 100), named as image_transport's compressed plug-in would."""
    pixels = np.frombuffer(mosaic.data, np.uint8).reshape(mosaic.height, mosaic.width, 3)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"cannot encode an image of shape {pixels.shape} as JPEG")
    message = CompressedImage(header=mosaic.header, format="rgb8; jpeg compressed bgr8")
    message.data = convert.to_field(data)
    return message


class ImageViews:
    """Publishes env/image/view and env/image/compressed until the node's cleanup."""

    def __init__(self, node: ManagedNode) -> None:
        self._node = node
        self._view = node.create_publisher(Image, "env/image/view", VIEW)
        node.own(node.destroy_publisher, self._view)
        self._compressed = node.publish_unnumbered("env/image/compressed")
        self._last_s: dict[str, float] = {}

    def show(self, images: UInt8Array, mosaic: Image) -> None:
        """Publish what is due. images: uint8 (N, H, W, 3); mosaic: the env/image message of the same observation."""
        if self._view.get_subscription_count():
            shown = int(self._node.param("view_env"))
            if 0 <= shown < len(images) and self._due("view"):
                message = convert.image_msg(images[shown], 0, mosaic.encoding)
                message.header = mosaic.header
                self._view.publish(message)
        when = self._node.param("compressed")
        wanted = when == "always" or (when == "subscribed" and self._compressed.get_subscription_count())
        if wanted and self._due("compressed"):
            self._compressed.publish(jpeg_msg(mosaic, int(self._node.param("compressed_quality"))))

    def _due(self, view: str) -> bool:
        now = time.monotonic()
        due = now - self._last_s.get(view, -1e9) >= float(self._node.param(f"{view}_period_s"))
        if due:
            self._last_s[view] = now
        return due
