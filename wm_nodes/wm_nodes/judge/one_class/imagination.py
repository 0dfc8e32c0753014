"""Numbers of a clip by the world model: what it cannot draw, what it did not expect, how sure it is of the end (RA-27).

The actions between two frames are read off the tool, so that a clip needs none of its own.
Shapes: T frames, H W 3 image, S tokens, D values per token, A action, J tasks.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.world_model import ActionModel, WorldModels
from wm_nodes.world_model.dynamics import done_signal
from wm_nodes.world_model.tokenizer import PROBE_NAMES, normalise_tokens

BLOCK_PX = 8
"""Side of the blocks whose mean error is compared."""
PLACES = {
    name: [i for i, found in enumerate(PROBE_NAMES) if found.startswith(name)] for name in ("object", "tool", "goal")
}
"""Columns of the position probe that are each thing's place."""
LAST = 2
"""Frames at the end, of which the most done counts."""

COMPONENTS = {
    "redrawn": "clarity", "redrawn_worst": "deformation", "redrawn_change": "temporal",
    "unexpected": "interaction", "unexpected_most": "interaction", "unexpected_token": "interaction",
    "unexpected_place": "interaction", "worse_than_still": "temporal",
    "object_alone_m": "interaction", "object_step_m": "interaction", "object_faster_m": "interaction",
    "object_expected_m": "interaction", "object_expected_sum_m": "interaction",
    "tool_step_m": "robot", "tool_jerk_m": "temporal", "tool_low_m": "geometry", "goal_moves_m": "background",
    "start_place_m": "objective",
}
"""Each number, and the component of the rubric that it speaks about."""


@torch.inference_mode()
def model_numbers(
    models: WorldModels, frames: UInt8Array, reference: UInt8Array, stride: int, origin: FloatArray
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the numbers of COMPONENTS, and the done signal at the end of each task that the model knows.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2, in the model's cameras. reference: (H, W, 3). stride: steps between frames.
        origin: (3,), what the probe's tool positions lack to be the model's states, m.

    Raises:
        ValueError: frames of another size, a model over discrete tokens, or one without a position probe.
    """
    model = models.action
    if not isinstance(model, ActionModel) or models.probe is None:
        raise ValueError("the embedded judge needs a world model over continuous latents with a position probe")
    every = np.concatenate([reference[None], frames])
    latents = models.tokenizer.encode(every)[1:]
    redrawn = models.tokenizer.decode(latents)
    shown = torch.from_numpy(every[1:]).to(redrawn.device)
    missed = (redrawn.float() - shown.float()).abs().mean(3)
    places = models.probe.read(every)
    start, places = places[0], places[1:]
    tool, thing = torch.from_numpy(places[:, PLACES["tool"]]), places[:, PLACES["object"]]
    imagined, logits = _next_frames(model, models, latents, tool.to(latents.device), stride, origin)
    error = (imagined - latents[1:]).square().mean(2)
    still = (latents[1:] - latents[:-1]).square().mean(2)
    drawn = models.tokenizer.decode(imagined)
    miss = (models.probe.read(drawn) - models.probe.read(redrawn[1:]))[:, PLACES["object"]]
    surprise = _blocks((drawn.float() - redrawn[1:].float()).abs().mean(3))
    moved, went = np.linalg.norm(np.diff(thing, axis=0), axis=1), np.linalg.norm(np.diff(tool.numpy(), axis=0), axis=1)
    gap = np.linalg.norm(tool.numpy()[:, :2] - thing, axis=1)
    goal = places[:, PLACES["goal"]]
    per_frame = missed.mean((1, 2))
    numbers = {
        "redrawn": per_frame.mean(), "redrawn_worst": _blocks(missed).max(),
        "redrawn_change": per_frame.diff().abs().max(),
        "unexpected": error.mean(), "unexpected_most": error.mean(1).max(), "unexpected_token": error.max(),
        "unexpected_place": surprise.max(),
        "worse_than_still": torch.log((error.mean() + 1e-3) / (still.mean() + 1e-3)),
        "object_alone_m": (moved * np.clip((np.minimum(gap[:-1], gap[1:]) - 0.06) / 0.05, 0, 1)).sum(),
        "object_step_m": moved.max(), "object_faster_m": (moved - went).max(),
        "object_expected_m": np.linalg.norm(miss, axis=1).max(), "object_expected_sum_m": np.linalg.norm(miss.sum(0)),
        "tool_step_m": went.max(), "tool_jerk_m": np.abs(np.diff(went)).max(initial=0.0),
        "tool_low_m": -tool[:, 2].min(),
        "goal_moves_m": np.linalg.norm(goal - np.median(goal, 0), axis=1).max(),
        "start_place_m": np.linalg.norm(start - places[0]),
    }
    done = dict(zip(models.tasks, done_signal(logits)[0][-LAST:].amax(0).tolist()))
    return {name: float(value) for name, value in numbers.items()}, done


def _next_frames(
    model: ActionModel, models: WorldModels, latents_TSD: Tensor, tool_T3: Tensor, stride: int, origin: FloatArray
) -> tuple[Tensor, Tensor]:
    """The next frame imagined from each true one, (T - 1, S, D), and done logits there (T - 1, heads, J)."""
    action_dim, state_dim = models.spec.action_dim, models.spec.state_dim
    step = tool_T3.diff(dim=0) / stride
    actions = F.pad((step / models.spec.action_scale[0]).clamp(-1, 1), (0, action_dim - 3))
    between = torch.stack([tool_T3[:-1] + i * step for i in range(stride + 1)]) + torch.from_numpy(origin).to(tool_T3)
    states = F.pad(between, (0, state_dim - 3))
    if state_dim > 3:
        states[..., 3:] = model.condition.state_mean[3:]
    if stride == 1:
        prediction = model(latents_TSD[:-1][None], actions[None], states[0][None], states[1][None])
        return normalise_tokens(latents_TSD[:-1] + prediction.change_BTSD[0]), prediction.done_logits_BTKJ[0]
    caches = model.trunk.new_ring_caches(1, latents_TSD.device)
    imagined, done = list[Tensor](), list[Tensor]()
    for t in range(len(step)):
        current, row = latents_TSD[t : t + 1], slice(t, t + 1)
        for i in range(stride):
            current, logits = model.advance(current, actions[row], states[i, row], states[i + 1, row], caches)
        imagined.append(current[0])
        done.append(logits[0])
    return torch.stack(imagined), torch.stack(done)


def _blocks(pictures_THW: Tensor) -> Tensor:
    """The largest mean of a block of each picture (T,)."""
    return F.avg_pool2d(pictures_THW[:, None], BLOCK_PX, BLOCK_PX // 2).amax((1, 2, 3))
