"""What the shipped world model says of clips that it imagined itself, and of the same clips made wrong (RA-17)."""

from dataclasses import replace

import numpy as np
import pytest
from imagined_clip import STEPS, imagined, models

from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.agent.types import TaskSpec
from wm_nodes.judge.evidence.world_model import MODEL_EVIDENCE, model_evidence


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


def test_every_second_frame_of_a_clip_is_explained_by_the_two_actions_between() -> None:
    frames, actions, _ = imagined()
    pairs = actions.reshape(STEPS // 2, -1)
    right, wrong = evidence(frames[::2], pairs), evidence(frames[::2], -pairs)
    assert wrong["surprise"] > 2 * right["surprise"] and wrong["tool_error"] > right["tool_error"]
    assert right["action_gain"] > 0.5 > -0.5 > wrong["action_gain"]


def test_without_a_first_state_the_tool_is_where_the_first_frame_shows_it() -> None:
    frames, actions, _ = imagined()
    spec = TaskSpec("push the blue cube into the red target", "push_cube", "panda", frames[0], None, actions)
    told, seen = evidence(frames, actions), model_evidence(models(), frames, spec)
    wrong = model_evidence(models(), frames, replace(spec, actions=-actions))
    assert seen["action_gain"] > 0.2 > -0.2 > wrong["action_gain"]
    assert seen["tokenizer_error"] == told["tokenizer_error"]


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
    with pytest.raises(ValueError, match=r"needs actions \(12, 3 or a multiple\), got None"):
        evidence(frames, None)
    with pytest.raises(ValueError, match=r"needs actions \(12, 3 or a multiple\), got \(5, 3\)"):
        evidence(frames, actions[:5])
    with pytest.raises(ValueError, match=r"got \(12, 2\)"):
        evidence(frames, actions[:, :2])
    with pytest.raises(ValueError, match=r"images must be uint8 \(B, 64, 128, 3\)"):
        evidence(frames[:, :, :64], actions)
    with pytest.raises(ModelFolderError, match="knows the tasks reach, push_cube, not 'fold'"):
        evidence(frames, actions, task="fold")
