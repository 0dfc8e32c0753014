"""Clips that the shipped world model imagined itself: their actions are known, and nothing is wrong with them."""

import functools

import numpy as np
import torch

from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.evidence.world_model import commanded_states
from wm_nodes.world_model import WorldModels, load_model_folder

STEPS = 12


@functools.cache
def models() -> WorldModels:
    return load_model_folder(shipped_model("push_cube"))


@functools.cache
def imagined() -> tuple[UInt8Array, FloatArray, FloatArray]:
    """Frames (T, H, W, 3), actions (T - 1, A), first state (S,): the model's own rollout from its mean picture."""
    tokenizer, action = models().tokenizer, models().action
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (STEPS // 4, 3)), 4, 0).astype(np.float32)
    start = action.condition.state_mean.clone()
    states = commanded_states(models(), start, torch.from_numpy(actions))
    picture = (tokenizer.background * 255).round().byte().permute(1, 2, 0)
    latents = [tokenizer.encode(picture[None])]
    caches = action.trunk.new_ring_caches(1, tokenizer.device)
    with torch.inference_mode():
        for t, moved in enumerate(torch.from_numpy(actions)):
            before, after = states[t : t + 1], states[t + 1 : t + 2]
            latents.append(action.advance(latents[-1], moved[None], before, after, caches)[0])
    return tokenizer.decode(torch.cat(latents)).numpy(), actions, start.numpy()
