"""Recipes on states (S): scenes that are drawn sharp and well lit and cannot happen (RA-21).

Each takes (states, amount, rng) and returns edited states, which a simulator draws without stepping physics; nothing
here knows a simulator. Lengths in m; T frames.

After an edit of the robot, `tool` is interpolated between recorded points; whoever draws the states measures it anew.
`contact` says what touches in the edited scene as far as the edit knows, so that truth.py can judge it before drawing.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import FloatArray
from wm_nodes.judge.dataset.edits.clips import NotApplicableError, SceneStates
from wm_nodes.judge.dataset.edits.truth import overlap_m

MOVED_M = 0.03
"""An object that went less far is no motion to edit."""
RAMP_FRAMES = 3
"""Frames in which a levitating object rises and a reshaped one changes."""
MIN_PULL_M = 0.01


def ghost_motion(states: SceneStates, share: float, rng: np.random.Generator) -> SceneStates:
    """The object follows its path while the robot stays home, for that share of the robot's motion."""
    _check_moved(states)
    stay = np.float32(share)
    home = states.at(np.zeros(len(states), np.intp))
    return replace(
        states, robot_q=(1 - stay) * states.robot_q + stay * home.robot_q,
        tool=(1 - stay) * states.tool + stay * home.tool,
        gripper_m=(1 - stay) * states.gripper_m + stay * home.gripper_m,
        contact=states.contact if share < 0.5 else np.broadcast_to(home.contact, states.contact.shape).copy(),
    )


def pass_through(states: SceneStates, share: float, rng: np.random.Generator) -> SceneStates:
    """The robot keeps its path, the object that share of its place at the start: the robot goes through it."""
    _check_moved(states)
    stay = np.float32(share)
    return _place_thing(states, (1 - stay) * states.thing + stay * states.thing[:1])


def early_motion(states: SceneStates, frames: float, rng: np.random.Generator) -> SceneStates:
    """The object leads the contact by so many frames, a fraction by interpolation."""
    _check_moved(states)
    if not states.contact.any() or states.contact[: round(frames) + 1].any():
        raise NotApplicableError(f"no first contact after frame {round(frames)}: the object cannot lead it")
    times = np.minimum(np.arange(len(states)) + frames, len(states) - 1)
    before = np.floor(times).astype(np.intp)
    after, share = np.minimum(before + 1, len(states) - 1), (times - before).astype(np.float32)[:, None]
    poses = states.poses.copy()
    last = states.poses[after, 0]
    same = np.where((states.poses[before, 0, 3:] * last[:, 3:]).sum(1, keepdims=True) < 0, -1, 1)
    poses[:, 0, :3] = (1 - share) * states.poses[before, 0, :3] + share * last[:, :3]
    turned = (1 - share) * states.poses[before, 0, 3:] + share * same * last[:, 3:]
    poses[:, 0, 3:] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return replace(states, poses=poses)


def teleport(states: SceneStates, distance_m: float, rng: np.random.Generator) -> SceneStates:
    """The object is so far to a side at once, from a frame on when nothing touches it."""
    free = [t for t in range(2, len(states) - 1) if not states.contact[max(0, t - 2) : t + 2].any()]
    if not free:
        raise NotApplicableError("the object is touched all through the clip")
    angle = rng.uniform(0, 2 * np.pi)
    offset = np.zeros_like(states.thing)
    offset[rng.choice(free) :, :2] = distance_m * np.array([np.cos(angle), np.sin(angle)])
    return _place_thing(states, states.thing + offset)


def sink(states: SceneStates, depth_m: float, rng: np.random.Generator) -> SceneStates:
    """The object lies that deep in the table."""
    if np.abs(states.bottom_m).max() > MIN_PULL_M:
        raise NotApplicableError("the object does not lie on the table all through")
    return _place_thing(states, states.thing - np.array([0, 0, depth_m], np.float32))


def pull_in(states: SceneStates, share: float, rng: np.random.Generator) -> SceneStates:
    """While it is touched the object is that share of the way inside the tool, and it moves on from there."""
    if not states.contact.any():
        raise NotApplicableError("the object is never touched")
    if overlap_m(states).max() > 0 or (states.gripper_m >= 1.8 * states.half_sizes_m[0].min())[states.contact].all():
        raise NotApplicableError("the tool point is inside the object or around it already; a grasp has no inside")
    way = np.float32(share) * (states.tool - states.thing) * np.array([1, 1, 0], np.float32)
    first, last = np.flatnonzero(states.contact)[[0, -1]]
    frames = np.arange(len(states))
    offset = way[np.clip(frames, first, last)]
    offset[frames < first] = 0
    return _place_thing(states, states.thing + offset)


def stretch(states: SceneStates, share: float, rng: np.random.Generator) -> SceneStates:
    """The object gets longer by that share along one axis and thinner along the others, and keeps standing."""
    start, axis = int(rng.integers(1, max(2, len(states) // 2))), int(rng.integers(3))
    factors = np.full(3, 1 / np.sqrt(1 + share))
    factors[axis] = 1 + share
    if rng.random() < 0.5:  # squash: the other way round
        factors = 1 / factors
    ramp = _ramp(len(states), start)[:, None]
    scales = states.scales.copy()
    scales[:, 0] *= (1 + ramp * (factors - 1)).astype(np.float32)
    lift = states.half_sizes_m[0, 2] * (scales[:, 0, 2] - states.scales[:, 0, 2])
    raised = states.thing + lift[:, None] * np.array([0, 0, 1], np.float32)
    return replace(_place_thing(states, raised), scales=scales)


def second_copy(states: SceneStates, distance_m: float, rng: np.random.Generator) -> SceneStates:
    """Another object of the same kind so far to a side, away from the tool, all through; it moves as the first does."""
    side = np.sign(states.thing[:, 1].mean() - states.tool[:, 1].mean()) or 1.0
    copy = states.poses[:, :1].copy()
    copy[:, 0, 1] += np.float32(side * distance_m)
    return replace(
        states, poses=np.concatenate([states.poses, copy], 1),
        scales=np.concatenate([states.scales, states.scales[:, :1]], 1),
        half_sizes_m=np.concatenate([states.half_sizes_m, states.half_sizes_m[:1]]),
    )


def levitation(states: SceneStates, height_m: float, rng: np.random.Generator) -> SceneStates:
    """Released, the object rises so high and hangs there."""
    touched = np.flatnonzero(states.contact)
    start = int(touched[-1]) + 2 if len(touched) else len(states)
    if start > len(states) - RAMP_FRAMES - 1:
        raise NotApplicableError("the object is not let go of early enough to rise")
    rise = (_ramp(len(states), start) * height_m).astype(np.float32)
    return _place_thing(states, states.thing + rise[:, None] * np.array([0, 0, 1], np.float32))


def _ramp(num_frames: int, start: int) -> NDArray[np.float64]:
    """0 before `start`, then up to 1 in RAMP_FRAMES."""
    return np.clip((np.arange(num_frames) - start + 1) / RAMP_FRAMES, 0, 1)


def _check_moved(states: SceneStates) -> None:
    way = float(np.linalg.norm(states.thing - states.thing[:1], axis=1).max())
    if way < MOVED_M:
        raise NotApplicableError(f"the object moves {100 * way:.1f} cm; {100 * MOVED_M:.0f} cm are needed")


def _place_thing(states: SceneStates, centres: FloatArray) -> SceneStates:
    poses = states.poses.copy()
    poses[:, 0, :3] = centres
    return replace(states, poses=poses)
