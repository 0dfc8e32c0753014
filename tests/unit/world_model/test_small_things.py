"""What keeps a small thing in the latents where no recording says where it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recording_samples import make_episode, make_spec
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import Episode, FloatArray
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.tokenizer import recorded_targets, success_states, train_tokenizer, worst_error
from wm_nodes.world_model.validation.pictures import varying_error

SIZE = 32
TASKS = ("reach_the_dot",)
SPEC = make_spec(height=SIZE, width=SIZE, cameras=("top",), task="reach_the_dot", ground_truth_names=())


def place(seed: int) -> FloatArray:
    """Of the dot, row and column, px."""
    return np.random.default_rng(seed).integers(2, SIZE - 4, 2).astype(np.float32)


def reaching(seed: int) -> Episode:
    """A dot of nine pixels lies still while a bar crosses the picture; actions point to the dot."""
    rng, (row, column) = np.random.default_rng(seed + 1), place(seed).astype(int)
    one = make_episode(SPEC, seed, 5)
    one.images[:] = 120
    for image in one.images:
        left = rng.integers(0, SIZE - 8)
        image[:, left : left + 8] = rng.integers(150, 255)
        image[row : row + 3, column : column + 3] = (200, 40, 40)
    one.actions[:, :2] = place(seed) / SIZE * 2 - 1
    return replace(one, success=np.arange(6) == 5)


def episodes(count: int, first: int = 0) -> EpisodeArrays:
    return stack_episodes([reaching(first + seed) for seed in range(count)], TASKS)


def settings(**tokenizer: float) -> RunConfig:
    small = {
        "width": 24, "depth": 1, "patch_px": 16, "latent_dim": 12, "batch_size": 32, "num_iterations": 200,
        "learning_rate": 3e-3, "worst_weight": 0.0, "probe_weight": 0.0,
    }
    return load_config("base", {f"tokenizer.{name}": value for name, value in (small | tokenizer).items()})


def test_the_targets_of_a_frame_are_the_action_taken_there_and_whether_the_task_is_done() -> None:
    recorded = stack_episodes([reaching(0), replace(make_episode(SPEC, 1, 3), success=np.zeros(4, bool))], TASKS)
    targets = recorded_targets(recorded)
    assert targets.shape == (2, 6, 4)
    np.testing.assert_array_equal(targets[0, :5, :3], recorded.actions[0])
    assert np.isnan(targets[0, 5, :3]).all() and np.isnan(targets[1, 3:, :3]).all()
    np.testing.assert_array_equal(targets[0, :, 3], [0, 0, 0, 0, 0, 1])


def test_the_state_at_success_is_known_up_to_the_first_success_and_nowhere_else() -> None:
    succeeds, fails = make_episode(SPEC, 0, 3), replace(make_episode(SPEC, 1, 3), success=np.zeros(4, bool))
    succeeds = replace(succeeds, success=np.array([False, False, True, True]))
    now, reached = np.split(success_states(stack_episodes([succeeds, fails], TASKS)), 2, axis=-1)
    np.testing.assert_array_equal(now, [succeeds.states, fails.states])
    np.testing.assert_array_equal(reached[0, :3], succeeds.states[[2, 2, 2]])
    assert np.isnan(reached[0, 3]).all() and np.isnan(reached[1]).all()


def test_the_worst_error_is_the_mean_of_the_worst_fiftieth_of_a_frames_pixels() -> None:
    errors = torch.zeros(2, 3, 10, 10)
    errors[0, :, 4, 4], errors[0, :, 4, 5], errors[1, 0, 2, 2] = 6.0, 2.0, 3.0
    assert worst_error(errors) == pytest.approx((6 + 2 + 1 + 0) / 4)


@pytest.fixture(scope="module")
def plain() -> Tokenizer:
    return train_tokenizer(episodes(150), settings(), 0, None)[0]


def shown(tokenizer: Tokenizer) -> float:
    frames = episodes(60, 1000).images[:, 0]
    with torch.inference_mode():
        return varying_error(tokenizer.decode(tokenizer.encode(frames)).numpy(), frames)


def read_error_px(tokenizer: Tokenizer) -> float:
    """Of the dot's place, by the best linear map from the latents of 150 episodes, on others."""
    def columns(count: int, first: int) -> tuple[Tensor, Tensor]:
        with torch.inference_mode():
            latents = tokenizer.encode(episodes(count, first).images[:, 0]).flatten(1)
        where = torch.from_numpy(np.stack([place(first + seed) for seed in range(count)]))
        return torch.cat((latents, torch.ones(count, 1)), 1), where

    (known, places), (other, wanted) = columns(150, 0), columns(60, 1000)
    ridge = known.T @ known + 1.0 * torch.eye(known.shape[1])
    return float((other @ torch.linalg.solve(ridge, known.T @ places) - wanted).norm(dim=1).mean())


def test_the_loss_of_the_worst_pixels_shows_a_dot_that_is_lost_without_it(plain: Tokenizer) -> None:
    found = shown(train_tokenizer(episodes(150), settings(worst_weight=0.2), 0, None)[0])
    assert found < 0.9 * shown(plain)


def test_recorded_actions_keep_a_dot_in_the_latents_that_is_lost_without_them(plain: Tokenizer) -> None:
    found = read_error_px(train_tokenizer(episodes(150), settings(probe_weight=0.1), 0, None)[0])
    assert found < 0.9 * read_error_px(plain)
