"""Numbers of a clip by the world model: what it cannot draw, what it did not expect, how sure it is of the end (RA-27).

The actions between two frames are read off the tool, so that a clip needs none of its own.
Shapes: T frames, H W 3 image, S tokens, D values per token, A action, J tasks.
"""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.core.action_spaces import tool_columns
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.environments.object_reader import ObjectReader
from wm_nodes.world_model import ActionModel, WorldModels
from wm_nodes.world_model.dynamics import done_signal
from wm_nodes.world_model.positions import columns_of
from wm_nodes.world_model.state_model import next_states
from wm_nodes.world_model.tokenizer import normalise_tokens

BLOCK_PX = 8
"""Side of the blocks whose mean error is compared."""
UNTOUCHED_M, FREE_M = 0.05, 0.08
"""Distance of the tool's path from which an object's move begins to count as untouched, and wholly counts."""
LEAST_M = 0.003
"""Distances count from here on a scale of ratios."""
LAST = 2
"""Frames at the end, of which the most done counts."""

COMPONENTS = {
    "redrawn": "clarity", "redrawn_worst": "deformation", "redrawn_change": "temporal",
    "worse_than_still": "temporal", "tool_step_m": "temporal",
    "object_untouched_m": "interaction", "object_faster_m": "interaction",
    "tool_inside": "geometry", "tool_through": "geometry", "tool_low_m": "geometry", "goal_moves_m": "viewpoint",
}
"""Each number, and the component of the rubric that it speaks about."""


@torch.inference_mode()
def model_numbers(
    models: WorldModels, frames: UInt8Array, stride: int, origin: FloatArray, height_m: float,
    reader: ObjectReader | None = None,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the numbers of COMPONENTS, and the done signal at the end of each task that the model knows.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2, in the model's cameras. stride: steps between frames.
        origin: (3,), what the probe's tool positions lack to be the model's states, m.
        height_m: of the object's middle.
        reader: of the model's folder: what its states say of things, and the done signal of them, is read off the
            frames, and goes on as the model predicts.

    Raises:
        ValueError: frames of another size, a model over discrete tokens or without a position probe, or a robot whose
            tool is not commanded by its position.
    """
    model = models.action
    if not isinstance(model, ActionModel) or models.probe is None:
        raise ValueError("the embedded judge needs a world model over continuous latents with a position probe")
    frames = frames.copy()  # one that may be read backwards or only read
    latents = models.tokenizer.encode(frames)
    redrawn = models.tokenizer.decode(latents)
    missed = (redrawn.float() - torch.from_numpy(frames).to(redrawn.device).float()).abs().mean(3)
    places = models.probe.read(frames)
    tool, thing, goal = (places[:, columns_of(models.tasks[0], name)] for name in ("tool", "object", "goal"))
    actions, states = _between(model, models, torch.tensor(tool, device=latents.device), stride, origin)
    told = None if reader is None else _read_states(model, reader, frames, latents, actions, states)
    imagined, logits = _next_frames(model, latents, actions, states)
    logits = logits if told is None else told
    error, still = (imagined - latents[1:]).square().mean(), (latents[1:] - latents[:-1]).square().mean()
    moved, went = (np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (thing, tool))
    per_frame = missed.mean((1, 2))
    numbers = {
        "redrawn": per_frame.mean(), "redrawn_worst": _blocks(missed).max(),
        "redrawn_change": per_frame.diff().abs().max(),
        "worse_than_still": torch.log((error + 1e-3) / (still + 1e-3)),
        "tool_step_m": went.max(), "object_faster_m": (moved - went).max(), "tool_low_m": -tool[:, 2].min(),
        "goal_moves_m": np.linalg.norm(goal - np.median(goal, 0), axis=1).max(),
        **contact_numbers(tool, thing, height_m),
    }
    done = dict(zip(models.tasks, done_signal(logits)[0][-LAST:].amax(0).tolist()))
    return {name: float(value) for name, value in numbers.items()}, done


def contact_numbers(tool: FloatArray, thing: FloatArray, height_m: float) -> dict[str, float]:
    """Numbers of a tool in or through an object, and of an object that moves without it.

    Args:
        tool, thing: places (T, 3) and (T, 2), m. height_m: of the object's middle.
    """
    place = np.column_stack([thing, np.full(len(thing), height_m)])
    gap, ahead = np.linalg.norm(tool - place, axis=1), _from_path(tool, place[1:])
    calm = np.median(np.stack([place[[0, *range(len(place) - 1)]], place, place[[*range(1, len(place)), -1]]]), 0)
    free = np.minimum(_from_path(tool, calm[1:]), _from_path(tool, calm[:-1]))
    untouched = np.clip((free - UNTOUCHED_M) / (FREE_M - UNTOUCHED_M), 0, 1)
    return {
        "tool_inside": -np.log(np.sort(np.concatenate([gap, ahead]))[1] + LEAST_M),
        "tool_through": -np.log(np.maximum(ahead, _from_path(tool, place[:-1])).min() + LEAST_M),
        "object_untouched_m": np.linalg.norm((np.diff(calm, axis=0) * untouched[:, None]).sum(0)),
    }


def _from_path(path: FloatArray, points: FloatArray) -> FloatArray:
    """Distance of each point (T - 1, 3) to the straight way between two neighbours of a path (T, 3), (T - 1,)."""
    way = np.diff(path, axis=0)
    at = ((points - path[:-1]) * way).sum(1) / np.maximum((way * way).sum(1), 1e-9)
    distance: FloatArray = np.linalg.norm(path[:-1] + np.clip(at, 0, 1)[:, None] * way - points, axis=1)
    return distance


def _between(
    model: ActionModel, models: WorldModels, tool_T3: Tensor, stride: int, origin: FloatArray
) -> tuple[Tensor, Tensor]:
    """The actions (T - 1, A) of the steps between two frames, and the states (stride + 1, T - 1, P) before and after
    each: of what is not the tool's place, the mean."""
    moving, placed = tool_columns(models.spec)
    step = tool_T3.diff(dim=0) / stride
    actions = step.new_zeros(len(step), models.spec.action_dim)
    actions[:, moving] = (step / models.spec.action_scale[moving[0]]).clamp(-1, 1)
    between = torch.stack([tool_T3[:-1] + i * step for i in range(stride + 1)]) + torch.from_numpy(origin).to(tool_T3)
    states = model.condition.state_mean.to(between).repeat(*between.shape[:2], 1)
    states[..., placed] = between
    return actions, states


def _read_states(
    model: ActionModel, reader: ObjectReader, frames: UInt8Array, latents_TSD: Tensor, actions: Tensor,
    states: Tensor,
) -> Tensor | None:
    """Fill the measured values of the states of _between in place, as read off the frame before and as the model
    predicts from there; return the done logits (T - 1, heads, J) of what is read off the frame after, None where states
    do not tell what is done."""
    stride, ends = len(states) - 1, torch.cat((states[0], states[-1, -1:]))
    seen = torch.from_numpy(reader.fill_clip(frames, ends.cpu().numpy())).to(states)
    moves = seen.diff(dim=0) / stride
    states[0], earlier = seen[:-1], seen[:-1] - torch.cat((0 * moves[:1], moves[:-1]))
    for i in range(stride):
        states[i + 1] = next_states(model, latents_TSD[:-1], actions, states[i], earlier, states[i + 1])
        earlier = states[i]
    return model.told(seen[1:], seen[1:] - moves)


def _next_frames(
    model: ActionModel, latents_TSD: Tensor, actions: Tensor, states: Tensor
) -> tuple[Tensor, Tensor]:
    """The next frame imagined from each true one, (T - 1, S, D), and done logits there (T - 1, heads, J). actions,
    states: of _between."""
    if len(states) == 2:
        prediction = model(latents_TSD[:-1][None], actions[None], states[0][None], states[1][None])
        return normalise_tokens(latents_TSD[:-1] + prediction.change_BTSD[0]), prediction.done_logits_BTKJ[0]
    caches = model.trunk.new_ring_caches(1, latents_TSD.device)
    imagined, done = list[Tensor](), list[Tensor]()
    for t in range(len(actions)):
        current, row = latents_TSD[t : t + 1], slice(t, t + 1)
        for before, after in pairwise(states):
            current, logits = model.advance(current, actions[row], before[row], after[row], caches)
        imagined.append(current[0])
        done.append(logits[0])
    return torch.stack(imagined), torch.stack(done)


def _blocks(pictures_THW: Tensor) -> Tensor:
    """The largest mean of a block of each picture (T,)."""
    return F.avg_pool2d(pictures_THW[:, None], BLOCK_PX, BLOCK_PX // 2).amax((1, 2, 3))
