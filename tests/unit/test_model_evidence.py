"""What the shipped world model says of clips that it imagined itself, and of the same clips made wrong. Section 4.1."""

import functools

import numpy as np
import pytest
import torch

from wm_nodes.config.shipped import shipped_model
from wm_nodes.learning.model_evidence import MODEL_EVIDENCE, commanded_states, model_evidence
from wm_nodes.reward.agent.types import TaskSpec
from wm_nodes.types import FloatArray, UInt8Array
from wm_nodes.world_model import WorldModels, load_model_folder
from wm_nodes.world_model.folder import ModelFolderError

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


def evidence(
    frames: UInt8Array, actions: FloatArray | None, goal: UInt8Array | None = None, task: str = "push_cube"
) -> dict[str, float]:
    spec = TaskSpec("push the blue cube into the red target", task, "panda", frames[0], goal, actions)
    return model_evidence(models(), frames, spec, imagined()[2])


def test_actions_that_moved_the_clip_fit_better_than_their_reverse() -> None:
    frames, actions, _ = imagined()
    right, wrong = evidence(frames, actions), evidence(frames, -actions)
    assert right["action_gain"] > 0.5 > -0.5 > wrong["action_gain"]
    assert wrong["surprise"] > 2 * right["surprise"] and right["tokenizer_error"] == wrong["tokenizer_error"]
    assert wrong["tool_error"] > right["tool_error"]


def test_a_frozen_clip_is_told_by_its_actions_and_not_by_low_surprise_alone() -> None:
    frames, actions, _ = imagined()
    moving, frozen = evidence(frames, actions), evidence(np.repeat(frames[:1], STEPS + 1, 0), actions)
    assert frozen["still_energy"] < 1e-6 < moving["still_energy"]
    assert frozen["surprise_over_still"] > 3 > moving["surprise_over_still"]
    assert frozen["action_gain"] < moving["action_gain"] / 2


def test_noise_cannot_be_encoded_and_surprises() -> None:
    frames, actions, _ = imagined()
    noisy = frames.copy()
    noisy[6, :32] = np.random.default_rng(0).integers(0, 256, noisy[6, :32].shape)
    clean, found = evidence(frames, actions), evidence(noisy, actions)
    assert found["tokenizer_error_worst"] > clean["tokenizer_error_worst"] + 20
    assert found["surprise_max"] > 3 * clean["surprise_max"]


def test_goal_similarity_is_whole_at_the_goal_and_none_where_nothing_moved() -> None:
    frames, actions, _ = imagined()
    there = evidence(frames, actions, frames[-1])
    stayed = evidence(np.repeat(frames[:1], STEPS + 1, 0), actions, frames[-1])
    assert there["goal_similarity"] > 0.99 and there["goal_slope"] > 0.3
    assert [stayed["goal_similarity"], stayed["goal_slope"]] == pytest.approx([0, 0], abs=1e-4)
    assert set(there) == set(MODEL_EVIDENCE) and set(evidence(frames, actions)) < set(MODEL_EVIDENCE)
    assert all(np.isfinite(list(there.values())))


def test_clips_that_the_model_cannot_read_are_refused() -> None:
    frames, actions, _ = imagined()
    with pytest.raises(ValueError, match=r"needs actions \(12, 3\), got None"):
        evidence(frames, None)
    with pytest.raises(ValueError, match=r"needs actions \(12, 3\), got \(5, 3\)"):
        evidence(frames, actions[:5])
    with pytest.raises(ValueError, match=r"images must be uint8 \(B, 64, 128, 3\)"):
        evidence(frames[:, :, :64], actions)
    with pytest.raises(ModelFolderError, match="knows the tasks reach, push_cube, not 'fold'"):
        evidence(frames, actions, task="fold")
