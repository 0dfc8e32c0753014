"""Choose the frames that a read sees (RA-3). Shapes: T frames.

Two media trunks: S, then I, then E only append images to one another, so that a server's prefix cache still holds what
came before; D is a trunk of its own. No image is in a trunk twice.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.judge import MediaItem
from wm_nodes.judge.agent.types import ClipRef, Profile, TaskSpec

STATIC_UNIFORM, NUM_BURSTS, BURST = 4, 2, 3
INSTRUCTION_UNIFORM = 8
END_FRAMES = 3
DENSE_FPS, DENSE_MAX = 8.0, 32

Energy = NDArray[np.float64]


def profile_media(
    clip: ClipRef, task: TaskSpec, profile: Profile, *, motion: Energy | None = None, max_frames: int = DENSE_MAX
) -> tuple[MediaItem, ...]:
    """The images of a profile, in the order they are sent.

    Args:
        motion: (T - 1,), >= 0, motion between neighbouring frames, e.g. of a gripper track; None: frame differences.
        max_frames: of the dense profile.

    Raises:
        ValueError: motion of another length, or fewer than 2 frames allowed.
    """
    energy = frame_energy(clip.frames) if motion is None else motion
    num_frames = len(clip.frames)
    if energy.shape != (num_frames - 1,):
        raise ValueError(f"motion must have shape ({num_frames - 1},), got {energy.shape}")
    if profile is Profile.D:
        return _clip_items(dense_indices(energy, clip.fps, max_frames), clip)
    shown = static_indices(energy)
    media = [MediaItem("reference"), *_clip_items(shown, clip)]
    if profile in (Profile.I, Profile.E):
        media += _clip_items(more := _exclude(uniform(num_frames, INSTRUCTION_UNIFORM), shown), clip)
        shown = shown + more
    if profile is Profile.E:
        media += _clip_items(_exclude(list(range(max(0, num_frames - END_FRAMES), num_frames)), shown), clip)
        media += [MediaItem("goal")] if task.goal_image is not None else []
    return tuple(media)


def cited_media(frames: tuple[int, ...], clip: ClipRef) -> tuple[MediaItem, ...]:
    """The cited frames, each once, in time order."""
    return _clip_items(sorted(set(frames)), clip)


def frame_energy(frames: UInt8Array) -> Energy:
    """Mean squared difference of neighbouring frames, (T - 1,), in grey levels squared."""
    return np.array([np.mean((b.astype(np.float32) - a) ** 2, dtype=np.float64) for a, b in itertools.pairwise(frames)])


def uniform(num_frames: int, count: int) -> list[int]:
    """At most `count` indices from the first frame to the last, evenly spaced, each once."""
    return sorted({int(index) for index in np.linspace(0, num_frames - 1, min(count, num_frames)).round()})


def static_indices(energy: Energy) -> list[int]:
    """Profile S, sorted: 4 uniform frames, and two bursts of 3 neighbours where they differ most and do not overlap."""
    num_frames = len(energy) + 1
    chosen = set(uniform(num_frames, STATIC_UNIFORM))
    starts = np.convolve(energy, np.ones(BURST - 1), "valid") if num_frames >= BURST else np.zeros(0)
    taken: list[int] = []
    for start in np.argsort(-starts, kind="stable"):
        if len(taken) < NUM_BURSTS and all(abs(int(start) - other) >= BURST for other in taken):
            taken.append(int(start))
            chosen.update(range(int(start), int(start) + BURST))
    return sorted(chosen)


def dense_indices(energy: Energy, fps: float, max_frames: int = DENSE_MAX) -> list[int]:
    """Profile D, sorted: frames at 8 per second, at most half of max_frames, and the contact window at full rate."""
    num_frames = len(energy) + 1
    if max_frames < 2:
        raise ValueError(f"max_frames must be >= 2, got {max_frames}")
    wanted = int(np.ceil((num_frames - 1) / fps * DENSE_FPS)) + 1
    base = uniform(num_frames, wanted if wanted + len(contact_window(energy)) <= max_frames else max_frames // 2)
    window = _exclude(contact_window(energy), base)
    peak = int(energy.argmax())
    nearest = sorted(window, key=lambda index: abs(2 * index - 2 * peak - 1))[: max_frames - len(base)]
    return sorted(base + nearest)


def contact_window(energy: Energy) -> list[int]:
    """The frames around the largest energy between which it stays at least half as large."""
    first = last = peak = int(energy.argmax())
    while first > 0 and energy[first - 1] >= energy[peak] / 2:
        first -= 1
    while last < len(energy) - 1 and energy[last + 1] >= energy[peak] / 2:
        last += 1
    return list(range(first, last + 2))


def _exclude(indices: list[int], shown: list[int]) -> list[int]:
    return [index for index in indices if index not in shown]


def _clip_items(indices: list[int], clip: ClipRef) -> tuple[MediaItem, ...]:
    return tuple(MediaItem("clip", index, index / clip.fps) for index in indices)
