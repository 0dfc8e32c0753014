"""Figure 3 of RoboScape-R with numbers: what is imagined, paid and learned, and what is said of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import make_model_folder

from benchmarks.environments import reward_test
from benchmarks.environments.reward_test import (
    EMPTY_HAND,
    Imagined,
    goals_of,
    imagine_all,
    judge_reward,
    judged,
    largest,
    learned_heads,
    paid,
)
from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.recording.episode_arrays import EpisodeArrays

CONFIG = load_config("smoke")
EPISODES, STEPS = 6, 5


def recorded(won: tuple[int, ...] = (0, 2, 3)) -> EpisodeArrays:
    """Episodes of noise; those of `won` succeed at their last step, the last one is two steps short."""
    rng = np.random.default_rng(0)
    success = np.zeros((EPISODES, STEPS + 1, 1), bool)
    success[list(won), -1] = True
    return EpisodeArrays(
        rng.integers(0, 256, (EPISODES, STEPS + 1, 64, 128, 3), dtype=np.uint8),
        rng.uniform(0.5, 0.7, (EPISODES, STEPS + 1, 3)).astype(np.float32),
        rng.uniform(-1, 1, (EPISODES, STEPS, 3)).astype(np.float32), np.zeros((EPISODES, STEPS + 1, 0), np.float32),
        success, np.array([STEPS] * (EPISODES - 1) + [STEPS - 2]), ("push_cube",), ("",) * EPISODES,
        ("expert", EMPTY_HAND) * (EPISODES // 2), ("push_cube",) * EPISODES,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model_folder(tmp_path_factory.mktemp("model") / "model")


@pytest.fixture(scope="module")
def found(folder: Path) -> Imagined:
    return imagine_all(models_of(folder), recorded(), "push_cube")


def test_the_kept_features_are_those_that_the_done_signal_is_made_of(folder: Path, found: Imagined) -> None:
    heads = models_of(folder).action.done
    with torch.no_grad():
        features = torch.from_numpy(found.features)
        if heads.positions is not None:
            features = torch.cat((features, heads.positions(features)), -1)
        signals = torch.stack([head(features).sigmoid() for head in heads.heads]).amin(0)
    column = models_of(folder).task_index("push_cube")
    np.testing.assert_allclose(signals[..., column].numpy(), found.signals, atol=1e-2)
    assert found.frames.shape == (EPISODES, STEPS + 1, 64, 128, 3)
    assert (found.frames[:, 0] == found.real.images[:, 0]).all()


def test_nothing_is_paid_after_the_done_signal_nor_after_the_end(folder: Path, found: Imagined) -> None:
    signals = np.full((EPISODES, STEPS), 0.1, np.float32)
    signals[0, [1, 3]] = signals[5, 4] = 0.9
    sums = paid(replace(found, signals=signals), None, folder, CONFIG)["done signal"]
    assert sums[0].tolist() == [0, 1, 1, 1, 1] and not sums[1:].any()
    assert goals_of(models_of(folder), found.real, CONFIG) is None, "no text model, no goal"


def test_the_agent_pays_at_the_end_of_an_episode_and_its_silence_is_an_error(found: Imagined) -> None:
    found = replace(found, real=replace(found.real, instructions=("push the cube to the goal",) * EPISODES))
    paid_by_it = judged(found, CONFIG)
    assert paid_by_it.shape == (EPISODES, STEPS) and (paid_by_it[:, -1] > 0).all()
    assert not paid_by_it[:-1, :-1].any() and not paid_by_it[-1, : STEPS - 3].any() and paid_by_it[-1, STEPS - 3] > 0
    slow = CONFIG.with_values(simulation=CONFIG.simulation.with_values(control_hz=1.0))
    with pytest.raises(ValueError, match=rf"no verdict on {EPISODES} of {EPISODES} episodes: .*frames per second"):
        judged(found, slow)


def test_learned_rewards_tell_what_they_were_shown(
    folder: Path, found: Imagined, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reward_test, "PROXY_ITERATIONS", 20)
    features = np.where(found.real.success[:, 1:], 1.0, -1.0) + np.zeros_like(found.features)
    shown = replace(found, features=features.astype(np.float32))
    heads = learned_heads(shown, folder, seed=0)
    values = heads["embedding head"](shown)
    assert judge_reward(values, shown, 0)["auroc"][0] == 1
    again = learned_heads(shown, folder, seed=0)["proxy network"](found)
    assert (again == heads["proxy network"](found)).all() and ((again >= 0) & (again <= 1)).all()


def test_values_up_to_a_step_do_not_fall_and_ignore_what_follows_an_episode(found: Imagined) -> None:
    values = np.zeros((EPISODES, STEPS))
    values[0] = [1, 3, 2, 0, 4]
    values[5, 3:] = 9
    assert largest(values, found)[0].tolist() == [1, 3, 3, 3, 4] and largest(values, found)[5].max() == 0


def test_a_reward_is_judged_by_success_by_an_empty_hand_and_along_time(found: Imagined) -> None:
    """Won are 0, 2 and 3; of the others 1 and 5 have an empty hand."""
    scores = np.array([5, 4, 6, 3, 1, 2])[:, None] * np.linspace(0.2, 1, STEPS)
    told = judge_reward(scores, found, 0)
    assert told["auroc"][0] == pytest.approx(8 / 9) and told["auroc_empty_hand"] == pytest.approx(5 / 6)
    assert told["rank_correlation"] == pytest.approx(1) and (told["episodes_scored"], told["successes"]) == (6, 3)
    assert judge_reward(-scores, found, 0)["rank_correlation"] == pytest.approx(-1)


@pytest.mark.filterwarnings("error")
def test_a_reward_that_never_changes_along_a_success_has_no_rank_correlation(found: Imagined) -> None:
    assert np.isnan(judge_reward(np.zeros((EPISODES, STEPS)), found, 0)["rank_correlation"])
