"""Recipes on pixels (P): what a generator does wrong to the picture, with the masks saying where (RA-21).

Each takes (clip, amount, rng) and returns the edited clip. The unit of `amount` and its mild and failing ranges are in
recipes.py. Shapes: T frames, H W image.
"""

import math
from dataclasses import replace

import numpy as np

from wm_nodes.core.types import BoolArray
from wm_nodes.judge.dataset.edits import images
from wm_nodes.judge.dataset.edits.clips import BACKGROUND, DISTRACTOR, OBJECT, ROBOT, NotApplicableError, SourceClip
from wm_nodes.judge.dataset.edits.images import Images

SHIFT_PX, ROLL_DEGREES, ZOOM = 20.0, 25.0, 0.6
"""A camera drift of amount 1 at the end of the clip, in px of a picture 96 px wide; ZOOM is x1.6."""
SWAP_AT = 1 / 3
"""Share of the clip after which the table is another one."""


def blur_all(clip: SourceClip, sigma_px: float, rng: np.random.Generator) -> SourceClip:
    """Everything out of focus."""
    return _with_frames(clip, images.blur(_floats(clip), sigma_px))


def expose(clip: SourceClip, gain: float, rng: np.random.Generator) -> SourceClip:
    """Exposure, as a factor of the grey level."""
    return _with_frames(clip, _floats(clip) * np.float32(gain))


def drift_hue(clip: SourceClip, degrees: float, rng: np.random.Generator) -> SourceClip:
    """All colours turn, linearly from the first frame to the last."""
    turn = rng.choice([-1.0, 1.0]) * degrees
    shares = np.linspace(0, 1, len(clip))
    return _with_frames(clip, np.stack([images.turn_hue(f, turn * s) for f, s in zip(_floats(clip), shares)]))


def flicker(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """The exposure jumps by +- share from frame to frame."""
    signs = np.where((np.arange(len(clip)) + rng.integers(2)) % 2, 1.0, -1.0)
    gains = 1 + share * signs * rng.uniform(0.8, 1.0, len(clip))
    return _with_frames(clip, _floats(clip) * gains.astype(np.float32)[:, None, None, None])


def recolour_object(clip: SourceClip, degrees: float, rng: np.random.Generator) -> SourceClip:
    """The object has another colour than the instruction names, all through."""
    turned = images.turn_hue(_floats(clip), rng.choice([-1.0, 1.0]) * degrees)
    return _blend(clip, turned, clip.masks == OBJECT)


def vanish_object(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """The object fades into the scene behind it, from a frame in the first half on."""
    start = int(rng.integers(0, max(1, len(clip) // 2)))
    mask = _visible_mask(clip, OBJECT)
    mask[:start] = False
    return _blend(clip, (1 - opacity) * _floats(clip) + opacity * _plate(clip), mask)


def copy_object(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """A second object beside the first one, from a frame in the first half on."""
    start, mask = int(rng.integers(0, max(1, len(clip) // 2))), _visible_mask(clip, OBJECT)
    rows, columns = np.nonzero(mask[start:].any(0))
    if not len(rows):
        raise NotApplicableError("the object is hidden to the end: nothing to copy")
    extent = max(np.ptp(rows), np.ptp(columns)) + 4
    away = extent if columns.mean() < clip.frames.shape[2] / 2 else -extent
    frames, copied = _floats(clip), np.roll(mask, away, axis=2)
    copied[:start] = False
    copied &= clip.masks == BACKGROUND
    if not copied[-1].any():
        raise NotApplicableError("no room for a second object beside the first one")
    return _blend(clip, (1 - opacity) * frames + opacity * np.roll(frames, away, axis=2), copied)


def tint_robot(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """The arm in another colour. A tint, not a turn of hue: arms are grey."""
    colour = rng.permutation([230.0, 120.0, 20.0]).astype(np.float32)
    return _blend(clip, (1 - opacity) * _floats(clip) + opacity * colour, _visible_mask(clip, ROBOT))


def cut_robot(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """A link is missing: a band across the arm shows the scene behind it."""
    mask = _visible_mask(clip, ROBOT)
    rows = np.arange(mask.shape[1])[None, :, None]
    seen = mask.any(2)
    top, bottom = seen.argmax(1), mask.shape[1] - 1 - seen[:, ::-1].argmax(1)
    height = np.maximum(1, np.rint(share * (bottom - top + 1)))
    start = top + rng.uniform(0.2, 0.8) * (bottom - top + 1 - height)
    band = (rows >= start[:, None, None]) & (rows < (start + height)[:, None, None])
    return _blend(clip, np.broadcast_to(_plate(clip), clip.frames.shape), mask & band)


def shift_camera(clip: SourceClip, amount: float, rng: np.random.Generator) -> SourceClip:
    """The view drifts sideways, up or down."""
    angle = rng.uniform(0, 2 * math.pi)
    length = amount * SHIFT_PX * clip.frames.shape[2] / 96
    down, right = length * round(math.sin(angle), 6), length * round(math.cos(angle), 6)
    return _warp(clip, [(down * s, right * s, 0.0, 1.0) for s in _drift(clip)])


def roll_camera(clip: SourceClip, amount: float, rng: np.random.Generator) -> SourceClip:
    """The view rolls about its middle."""
    turn = rng.choice([-1.0, 1.0]) * amount * math.radians(ROLL_DEGREES)
    return _warp(clip, [(0.0, 0.0, turn * s, 1.0) for s in _drift(clip)])


def zoom_camera(clip: SourceClip, amount: float, rng: np.random.Generator) -> SourceClip:
    """The view closes in on its middle."""
    return _warp(clip, [(0.0, 0.0, 0.0, 1 + amount * ZOOM * s) for s in _drift(clip)])


def tremble(clip: SourceClip, amplitude_px: float, rng: np.random.Generator) -> SourceClip:
    """The whole picture trembles by up to so many px in each direction; the first frame stays."""
    offsets = rng.choice([-1.0, 1.0], (len(clip), 2)) * amplitude_px
    offsets[0] = 0
    return _warp(clip, [(float(row), float(column), 0.0, 1.0) for row, column in offsets])


def hide_contact(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """A dark blurred patch follows the object and covers where it is touched."""
    return _darken(clip, opacity, radius_px=0.16 * clip.frames.shape[2], blur_px=3.0)


def cast_shadow(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """A wide soft shadow follows the object."""
    return _darken(clip, opacity, radius_px=0.28 * clip.frames.shape[2], blur_px=0.0)


def flatten_background(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """The scene is pulled to its median colour."""
    mask = _scenery(clip)
    median = np.median(clip.frames[mask], axis=0).astype(np.float32)
    return _blend(clip, (1 - share) * _floats(clip) + share * median, mask)


def smooth_background(clip: SourceClip, sigma_px: float, rng: np.random.Generator) -> SourceClip:
    """The scene loses its texture."""
    return _with_frames(clip, images.blur_within(_floats(clip), _scenery(clip), sigma_px))


def remove_clutter(clip: SourceClip, opacity: float, rng: np.random.Generator) -> SourceClip:
    """Things that have no part in the task fade into the table, from one third of the clip on."""
    mask = _visible_mask(clip, DISTRACTOR)
    mask[: _swap_frame(clip)] = False
    return _blend(clip, (1 - opacity) * _floats(clip) + opacity * _plate(clip), mask)


def swap_table(clip: SourceClip, levels: float, rng: np.random.Generator) -> SourceClip:
    """The scene changes its colour by so many grey levels per channel, after one third of the clip."""
    mask, signs = _scenery(clip), rng.permutation([-1.0, 1.0, rng.choice([-1.0, 1.0])])
    mask[: _swap_frame(clip)] = False
    middle = clip.frames[mask].mean(0)
    signs = np.where((middle + signs * levels > 255) | (middle + signs * levels < 0), -signs, signs)
    return _blend(clip, _floats(clip) + (levels * signs).astype(np.float32), mask)


def _darken(clip: SourceClip, opacity: float, radius_px: float, blur_px: float) -> SourceClip:
    """Pull a disc around the object to a sixth of its brightness, blurred; where the object is hidden, it stays."""
    track, frames = clip.tracks["object"], _floats(clip)
    known = np.flatnonzero(np.isfinite(track).all(1))
    if not len(known):
        raise NotApplicableError("the object is never in view")
    height, width = frames.shape[1:3]
    centres = [track[known[np.abs(known - t).argmin()]] for t in range(len(clip))]
    patch = np.stack([images.disc((float(r), float(c)), radius_px, height, width) for r, c in centres])[..., None]
    dark = (images.blur(frames, blur_px) if blur_px else frames) / np.float32(6)
    alpha = np.float32(opacity) * patch
    return _with_frames(clip, (1 - alpha) * frames + alpha * dark)


def _warp(clip: SourceClip, moves: list[tuple[float, float, float, float]]) -> SourceClip:
    """Move the view of each frame by (down px, right px, turn rad, zoom factor); masks and tracks go along."""
    height, width = clip.frames.shape[1:3]
    middle = np.array([(height - 1) / 2, (width - 1) / 2])
    grid = np.indices((height, width)).astype(np.float64) - middle[:, None, None]
    frames, masks = _floats(clip).copy(), clip.masks.copy()
    tracks = {name: track.astype(np.float64) for name, track in clip.tracks.items()}
    for t, (down, right, turn, zoom) in enumerate(moves):
        cos, sin = round(math.cos(turn), 9), round(math.sin(turn), 9)
        rows = (cos * grid[0] - sin * grid[1]) / zoom + middle[0] + down
        columns = (sin * grid[0] + cos * grid[1]) / zoom + middle[1] + right
        frames[t] = images.sample(frames[t], rows.astype(np.float32), columns.astype(np.float32))
        nearest_row = np.clip(np.rint(rows), 0, height - 1).astype(int)
        masks[t] = masks[t, nearest_row, np.clip(np.rint(columns), 0, width - 1).astype(int)]
        for track in tracks.values():
            row, column = track[t] - middle - (down, right)
            track[t] = zoom * np.array([cos * row + sin * column, cos * column - sin * row]) + middle
    moved = {name: track.astype(np.float32) for name, track in tracks.items()}
    return replace(_with_frames(clip, frames), masks=masks, tracks=moved)


def _drift(clip: SourceClip) -> list[float]:
    return [float(share) for share in np.linspace(0, 1, len(clip))]


def _swap_frame(clip: SourceClip) -> int:
    return max(1, round(SWAP_AT * len(clip)))


def _floats(clip: SourceClip) -> Images:
    return clip.frames.astype(np.float32)


def _with_frames(clip: SourceClip, frames: Images) -> SourceClip:
    return replace(clip, frames=images.to_uint8(frames))


def _blend(clip: SourceClip, edited: Images, mask: BoolArray) -> SourceClip:
    """The clip with `edited` pixels where the mask (T, H, W) holds, and its own elsewhere."""
    return replace(clip, frames=np.where(mask[..., None], images.to_uint8(edited), clip.frames))


def _visible_mask(clip: SourceClip, label: int) -> BoolArray:
    mask = np.asarray(clip.masks == label)
    if not mask.any():
        raise NotApplicableError(f"no pixel of the clip has mask value {label}")
    return mask


def _scenery(clip: SourceClip) -> BoolArray:
    return np.asarray((clip.masks == BACKGROUND) | (clip.masks == DISTRACTOR))


def _plate(clip: SourceClip) -> Images:
    return images.plate(clip.frames, clip.masks == BACKGROUND)
