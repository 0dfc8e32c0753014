"""The paper's four hacking patterns as edits of pixels, each in steps from slight to gross, and harmless changes.

A generator is given the first frame, so no edit touches it; harmless changes, as of another camera or file format,
touch all. A clip keeps its length. Shapes: T frames, H W 3 image.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import BoolArray, UInt8Array
from wm_nodes.judge.hacking.regions import KERNEL, Scene

OCCLUSION, MOTION, BACKGROUND, PHYSICS = PATTERNS = ("occlusion", "motion", "background", "physics")
BENIGN = "benign"
STEPS, GROSS = (1, 2, 3, 4), (3, 4)
"""Steps of every edit; those that anybody sees at once."""
VISIBLE_CHANGE, VISIBLE_SHARE = 16, 0.002
"""An edit is visible where a channel of this share of a frame's pixels changes by so much, of 255."""

Change = Callable[[Scene, float, np.random.Generator], NDArray[Any]]


@dataclass(frozen=True)
class Edit:
    """A way to spoil a clip, or a harmless change."""

    name: str
    """For the tables."""
    pattern: str
    """One of PATTERNS, or BENIGN."""
    change: Change
    """Makes (T, H, W, 3), 0 to 255, of a scene and an amount."""
    amounts: tuple[float, float, float, float]
    """By step."""

    def __call__(self, scene: Scene, step: int, seed: int, sha256: str) -> UInt8Array | None:
        """The edited frames; None where too little is seen of the edit. sha256: of the clip; with seed, of chance."""
        rng = numpy_stream(seed, f"hack/{self.name}/{sha256}")
        after = np.clip(np.rint(self.change(scene, self.amounts[step - 1], rng)), 0, 255).astype(np.uint8)
        if self.pattern == BENIGN:
            return after
        after[0] = scene.frames[0]
        return after if visible_share(scene.frames, after) >= VISIBLE_SHARE else None


def visible_share(before: UInt8Array, after: UInt8Array) -> float:
    """Share of the pixels that visibly differ, in the frame where most do."""
    change = np.abs(before.astype(np.int16) - after).max(-1) >= VISIBLE_CHANGE
    return float(change.mean((1, 2)).max())


# occlusion: what happens cannot be seen
def _blur(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """Out of focus; share: standard deviation, of the short side."""
    return np.stack([cv2.GaussianBlur(frame, (0, 0), share * scene.short_px) for frame in scene.frames])


def _blur_moving(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """What moves is out of focus, the scenery is not."""
    near = np.stack([cv2.dilate(each, KERNEL) for each in scene.moving.astype(np.uint8)]) > 0
    return np.where(near[..., None], _blur(scene, share, rng), scene.frames)


def _patches(scene: Scene, size: float, rng: np.random.Generator) -> NDArray[Any]:
    """Dark patches over the two places with the most motion; size: of the short side, and their darkness."""
    side = max(2, round(size * scene.short_px))
    motion = np.abs(np.diff(scene.frames.astype(np.float32), axis=0)).sum((0, -1))
    after = scene.frames.astype(np.float32)
    for _ in range(2):
        y, x = np.unravel_index(cv2.blur(motion, (side, side)).argmax(), motion.shape)
        rows, columns = (slice(max(0, at - side // 2), at - side // 2 + side) for at in (y, x))
        after[:, rows, columns] *= max(0.0, 1 - 2 * size)
        far = scene.short_px // 2
        motion[max(0, y - far) : y + far, max(0, x - far) : x + far] = 0
    return after


def _dark(scene: Scene, gain: float, rng: np.random.Generator) -> NDArray[Any]:
    return np.multiply(scene.frames, gain)


def _noise(scene: Scene, deviation: float, rng: np.random.Generator) -> NDArray[Any]:
    return np.add(scene.frames, deviation * rng.standard_normal(scene.frames.shape, np.float32))


# motion: the end is reached without the way there, or not at all
def _at(scene: Scene, times: NDArray[np.int_]) -> UInt8Array:
    return np.asarray(scene.frames[times], np.uint8)


def _jump(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """A share of the motion is left out: a frame is held, then comes the one after the gap."""
    low, high = round((1 - share) / 2 * scene.end), round((1 + share) / 2 * scene.end)
    times = np.arange(len(scene.frames))
    times[low : high + 1] = np.where(times[low : high + 1] < (low + high) / 2, low, high)
    return _at(scene, times)


def _late(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The first frame is held; the motion is hurried through at the end, in this share of its time."""
    last = len(scene.frames) - 1
    pace = scene.end / max(1.0, share * scene.end)
    return _at(scene, np.rint(np.clip(scene.end - pace * (last - np.arange(last + 1)), 0, None)).astype(int))


def _freeze(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """It stops after this share of the motion."""
    return _at(scene, np.minimum(np.arange(len(scene.frames)), round(share * scene.end)))


def _disorder(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """Frames change places within parts of this share of the motion, of two frames at least."""
    times, size = np.arange(len(scene.frames)), max(2, round(share * scene.end))
    for first in range(1, scene.end, size):
        part = times[first : min(first + size, scene.end + 1)]
        part[:] = np.roll(part[::-1], rng.integers(len(part)) if len(part) > 3 else 0)
    return _at(scene, times)


# background: the scenery is simplified, exchanged or does not stay where it is
def _mix_scenery(scene: Scene, other: NDArray[Any], share: float) -> NDArray[Any]:
    return np.where(scene.moving[..., None], scene.frames, (1 - share) * scene.frames + share * other)


def _flatten(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The scenery fades into its median colour."""
    return _mix_scenery(scene, np.median(scene.scenery.reshape(-1, 3), 0), share)


def _repaint(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The scenery fades into a chequered one of another colour."""
    size = max(2, scene.short_px // 8)
    rows, columns = np.ogrid[: scene.scenery.shape[0], : scene.scenery.shape[1]]
    chequers = ((rows // size + columns // size) % 2)[..., None]
    colour = 255.0 - np.median(scene.scenery.reshape(-1, 3), 0) * rng.uniform(0.3, 1, 3)
    return _mix_scenery(scene, colour * (0.6 + 0.4 * chequers), share)


def _drift(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The scenery slides sideways under what moves; share: at the end, of the short side."""
    shifts = np.linspace(0, share * scene.short_px, len(scene.frames)) * rng.choice((-1, 1))
    return _mix_scenery(scene, np.stack([_warp(scene.scenery, 1, by) for by in shifts]), 1)


def _posterise(scene: Scene, levels: float, rng: np.random.Generator) -> NDArray[Any]:
    """Few levels of each colour channel are left."""
    width = 255 / (levels - 1)
    return np.asarray(np.rint(scene.frames / width) * width)


# physics: things do what things do not do
def _warp(frame: NDArray[Any], scale: float, right_px: float, centre: tuple[float, float] = (0, 0)) -> UInt8Array:
    """Enlarge a picture about centre (x, y) and shift it; its border goes on outside."""
    x, y = centre
    matrix = np.array([[scale, 0, (1 - scale) * x + right_px], [0, scale, (1 - scale) * y]], np.float32)
    warped = cv2.warpAffine(frame, matrix, frame.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


def _erase(frame: UInt8Array, mask: BoolArray) -> UInt8Array:
    """A frame without the object, filled from around it."""
    grown = cv2.dilate(mask.astype(np.uint8), KERNEL)
    return np.asarray(cv2.inpaint(frame, grown, 3, cv2.INPAINT_TELEA), np.uint8)


def _draw(base: UInt8Array, frame: UInt8Array, mask: BoolArray, scale: float, widths: float) -> UInt8Array:
    """Draw the object of `frame` onto `base`, in each view enlarged about its middle and moved by its widths."""
    after = base.copy()
    count, labels, stats, middles = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    for part in range(1, count):
        shift = round(widths * stats[part, cv2.CC_STAT_WIDTH])
        drawn = _warp((labels == part).astype(np.uint8) * 255, scale, shift, middles[part]) > 127
        after[drawn] = _warp(frame, scale, shift, middles[part])[drawn]
    return after


def _part(scene: Scene, others: NDArray[np.int_], objects: NDArray[np.int_]) -> NDArray[Any]:
    """The object as at the times `objects`, everything else as at the times `others`."""
    after = np.stack([_erase(scene.frames[time], scene.object_mask[time]) for time in others])
    return np.where(scene.object_mask[objects][..., None], scene.frames[objects], after)


def _ahead(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The object is ahead of what moves it, by this share of the motion."""
    times = np.arange(len(scene.frames))
    return _part(scene, times, np.minimum(times + max(1, round(share * scene.end)), len(times) - 1))


def _robot_stays(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The object goes its way; of everything else this share of the motion is missing."""
    times = np.arange(len(scene.frames))
    return _part(scene, np.minimum(times, round((1 - share) * scene.end)), times)


def _vanish(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """The object is away for this share of the frames, in the middle of the clip."""
    middle = len(scene.frames) / 2
    away = np.abs(np.arange(len(scene.frames)) - middle) <= max(0.5, share * middle)
    parts = zip(scene.frames, scene.object_mask, away)
    return np.stack([_erase(frame, mask) if gone else frame for frame, mask, gone in parts])


def _recolour(scene: Scene, degrees: float, rng: np.random.Generator) -> NDArray[Any]:
    """The object has another hue."""
    hsv = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2HSV) for frame in scene.frames])
    hsv[..., 0] = (hsv[..., 0].astype(int) + round(degrees / 2) * rng.choice((-1, 1))) % 180
    turned = np.stack([cv2.cvtColor(frame, cv2.COLOR_HSV2RGB) for frame in hsv])
    return np.where(scene.object_mask[..., None], turned, scene.frames)


def _double(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """A second object beside the object; share: how opaque it is."""
    beside = 1.6 * rng.choice((-1, 1))
    twice = [_draw(frame, frame, mask, 1, beside) for frame, mask in zip(scene.frames, scene.object_mask)]
    return np.asarray((1 - share) * scene.frames + share * np.stack(twice))


def _resize(scene: Scene, scale: float, rng: np.random.Generator) -> NDArray[Any]:
    """The object grows or shrinks, in the end to this many times its size."""
    parts = zip(scene.frames, scene.object_mask, np.linspace(1, scale, len(scene.frames)))
    return np.stack([_draw(_erase(frame, mask), frame, mask, by, 0) for frame, mask, by in parts])


def _fade(scene: Scene, share: float, rng: np.random.Generator) -> NDArray[Any]:
    """What moves is transparent, but for the object."""
    others = (scene.moving & ~scene.object_mask)[..., None]
    return np.where(others, (1 - share) * scene.frames + share * scene.scenery, scene.frames)


# harmless
def _jpeg(scene: Scene, quality: float, rng: np.random.Generator) -> NDArray[Any]:
    coded = (cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])[1] for frame in scene.frames)
    return np.stack([cv2.imdecode(each, cv2.IMREAD_COLOR) for each in coded])


def _shift(scene: Scene, right_px: float, rng: np.random.Generator) -> NDArray[Any]:
    return np.stack([_warp(frame, 1, right_px) for frame in scene.frames])


EDITS = (
    Edit("blur", OCCLUSION, _blur, (0.007, 0.012, 0.025, 0.05)),
    Edit("moving_blurred", OCCLUSION, _blur_moving, (0.007, 0.012, 0.03, 0.06)),
    Edit("patches", OCCLUSION, _patches, (0.08, 0.15, 0.3, 0.45)),
    Edit("darkness", OCCLUSION, _dark, (0.8, 0.6, 0.35, 0.15)),
    Edit("noise", OCCLUSION, _noise, (6, 14, 32, 64)),
    Edit("jump", MOTION, _jump, (0.4, 0.6, 0.8, 1)),
    Edit("late", MOTION, _late, (0.7, 0.5, 0.25, 0)),
    Edit("freeze", MOTION, _freeze, (0.8, 0.6, 0.3, 0)),
    Edit("disorder", MOTION, _disorder, (0.2, 0.4, 0.7, 1)),
    Edit("flattened", BACKGROUND, _flatten, (0.2, 0.4, 0.75, 1)),
    Edit("repainted", BACKGROUND, _repaint, (0.1, 0.2, 0.5, 1)),
    Edit("drift", BACKGROUND, _drift, (0.015, 0.04, 0.12, 0.3)),
    Edit("posterised", BACKGROUND, _posterise, (8, 6, 4, 2)),
    Edit("object_ahead", PHYSICS, _ahead, (0.15, 0.3, 0.6, 1)),
    Edit("robot_stays", PHYSICS, _robot_stays, (0.2, 0.4, 0.7, 1)),
    Edit("object_vanishes", PHYSICS, _vanish, (0.05, 0.15, 0.5, 2)),
    Edit("object_recoloured", PHYSICS, _recolour, (15, 35, 75, 140)),
    Edit("object_doubled", PHYSICS, _double, (0.2, 0.4, 0.8, 1)),
    Edit("object_grows", PHYSICS, _resize, (1.15, 1.4, 2, 3)),
    Edit("object_shrinks", PHYSICS, _resize, (0.85, 0.65, 0.4, 0.1)),
    Edit("moving_fades", PHYSICS, _fade, (0.2, 0.4, 0.75, 1)),
    Edit("jpeg", BENIGN, _jpeg, (98, 95, 92, 90)),
    Edit("slight_noise", BENIGN, _noise, (0.5, 1, 1.5, 2)),
    Edit("half_a_pixel", BENIGN, _shift, (0.125, 0.25, 0.375, 0.5)),
    Edit("brightness", BENIGN, _dark, (1.0125, 1.025, 1.0375, 1.05)),
)
"""By pattern; blur etc. begin with the second frame. Four steps each."""
