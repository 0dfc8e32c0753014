"""Recorded pictures of any camera to the size of a contract. Shapes: H W picture, px."""

from typing import Any

import cv2
import numpy as np

from wm_nodes.core.types import UInt8Array
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.imported.contract import IMAGE, Camera

ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB), "mono8": (1, cv2.COLOR_GRAY2RGB),
}
"""Channels of an encoding, and OpenCV's conversion to RGB."""
MOSAIC = "bayer_"
"""How formats begin of compressed pictures with one colour a pixel, which would be read as grey."""
RGB_ORDER = "compressed rgb8"
"""How formats end of pictures that were compressed in this order; all others were in OpenCV's, BGR."""
DEPTH = ("16UC1", "32FC1", "mono16", "compressedDepth")


class DamagedPictureError(BagError):
    """One picture that cannot be decoded."""


def check_encoding(message: Any) -> None:
    """Raise BagError for an encoding that is not read, with the remedy."""
    encoding = message.encoding if hasattr(message, "encoding") else message.format
    if any(name in encoding for name in DEPTH):
        raise BagError(f"encoding {encoding!r} is depth, which is not read; record the colour pictures of this camera")
    is_read = encoding in ENCODINGS if hasattr(message, "encoding") else not encoding.startswith(MOSAIC)
    if not is_read:
        raise BagError(f"encoding {encoding!r} is not read; publish one of {', '.join(ENCODINGS)}, or compressed")


def rgb_of(message: Any) -> UInt8Array:
    """Image or CompressedImage to uint8 (H, W, 3). Raises BagError as check_encoding, DamagedPictureError."""
    check_encoding(message)
    if message.__msgtype__ != IMAGE:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
        decoded = cv2.imdecode(np.asarray(message.data, np.uint8), flags) if len(message.data) else None
        if decoded is None:
            raise DamagedPictureError(f"a {message.format!r} picture of {len(message.data)} bytes cannot be decoded")
        if decoded.dtype != np.uint8:
            raise BagError(f"a {message.format!r} picture holds {decoded.dtype} values, as depth does, which is not "
                           "read; record the colour pictures of this camera with 8 bits a channel")
        is_rgb = message.format.endswith(RGB_ORDER)
        return np.asarray(decoded if is_rgb else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)
    channels, conversion = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if step < width * channels or len(message.data) < height * step:
        raise DamagedPictureError(
            f"a {message.encoding} picture of {height} x {width} px has {len(message.data)} bytes in rows of {step}"
        )
    rows = np.asarray(message.data, np.uint8)[: height * step].reshape(height, step)  # rows may be padded
    picture = rows[:, : width * channels].reshape(height, width, channels)
    return picture if conversion is None else np.asarray(cv2.cvtColor(picture, conversion), np.uint8)


def kept_part(height: int, width: int, camera: Camera) -> tuple[int, int, int, int]:
    """Top, left, height and width, px, of what camera.crop keeps. Raises BagError: it does not fit, or is too small."""
    to_height, to_width = camera.size
    if isinstance(camera.crop, tuple):
        part = camera.crop
    elif camera.crop == "none":
        part = (0, 0, height, width)
    else:
        high, wide = min(height, width * to_height // to_width), min(width, height * to_width // to_height)
        part = ((height - high) // 2, (width - wide) // 2, high, wide)
    top, left, high, wide = part
    if top + high > height or left + wide > width:
        raise BagError(f"pictures have {height} x {width} px, and crop {list(part)} leaves them; mend crop")
    if high < to_height or wide < to_width:
        raise BagError(f"pictures keep {high} x {wide} px of {height} x {width}, less than size {list(camera.size)}; "
                       "give a smaller size")
    return part


def fitted(picture: UInt8Array, camera: Camera) -> UInt8Array:
    """uint8 (H, W, 3) cropped and scaled to the camera's size. Raises BagError as kept_part."""
    top, left, height, width = kept_part(picture.shape[0], picture.shape[1], camera)
    part = picture[top : top + height, left : left + width]
    return np.asarray(cv2.resize(part, camera.size[::-1], interpolation=cv2.INTER_AREA), np.uint8)
