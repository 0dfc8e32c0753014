"""Recipes on time (T): the clip's own frames in another order; length, masks and states go along (RA-21).

Each takes (clip, amount, rng) and returns the edited clip. Shapes: T frames; an order is int (T,), order[t] is the
frame that is shown at t.
"""

import numpy as np
from numpy.typing import NDArray

from wm_nodes.judge.agent.profiles import frame_energy
from wm_nodes.judge.dataset.edits.clips import SourceClip
from wm_nodes.judge.dataset.edits.pixels import tremble

Order = NDArray[np.intp]
FROZEN_FROM_PX = 0.5
"""Trembling by more than this stands in for the motion; by less it comes on top of it."""


def freeze(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """The first frame stands for that share of the clip, then the rest runs faster; share 1 shows nothing else."""
    hold = max(2, round(share * len(clip)))
    rest = _round(np.linspace(0, len(clip) - 1, len(clip) - hold + 1)[1:])
    return clip.at(np.concatenate([np.zeros(hold, np.intp), rest]))


def slow(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """The first 1 - share of the motion is stretched over the whole clip."""
    return clip.at(_round(np.linspace(0, (1 - share) * (len(clip) - 1), len(clip))))


def jitter(clip: SourceClip, amplitude_px: float, rng: np.random.Generator) -> SourceClip:
    """A still picture trembles as if something happened."""
    still = amplitude_px > FROZEN_FROM_PX
    return tremble(clip.at(np.zeros(len(clip), np.intp)) if still else clip, amplitude_px, rng)


def splice(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """The arm idles for that share of the clip, then the last frames of the success follow at once."""
    idle = min(len(clip) - 1, max(2, round(share * len(clip))))
    return clip.at(np.concatenate([np.zeros(idle, np.intp), np.arange(idle, len(clip))]))


def shuffle(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """That share of the frames between first and last change places; of two only, those that differ least."""
    order = np.arange(len(clip))
    count = max(2, round(share * (len(clip) - 2)))
    if count == 2:
        first = 1 + int(frame_energy(clip.frames[1:-1]).argmin())
        chosen = np.array([first, first + 1])
    else:
        chosen = rng.choice(order[1:-1], count, replace=False)
    order[chosen] = np.roll(chosen, 1)
    return clip.at(order)


def drop(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """That share of the frames is missing around the largest motion; the last frame stands for as long."""
    count = max(1, round(share * len(clip)))
    peak = int(frame_energy(clip.frames).argmax()) if count > 1 else int(rng.integers(1, len(clip) - 1))
    first = int(np.clip(peak - count // 2, 1, len(clip) - 1 - count))
    order = np.delete(np.arange(len(clip)), range(first, first + count))
    return clip.at(np.append(order, np.full(count, len(clip) - 1)))


def repeat(clip: SourceClip, share: float, rng: np.random.Generator) -> SourceClip:
    """That share of the clip is shown twice, and as much of the end never."""
    count = max(1, round(share * len(clip)))
    again = int(rng.integers(count, max(count + 1, len(clip) - count)))
    frames = np.arange(len(clip))
    return clip.at(np.where(frames <= again, frames, frames - count))


def _round(positions: NDArray[np.float64]) -> Order:
    return np.rint(positions).astype(np.intp)
