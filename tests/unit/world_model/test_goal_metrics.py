"""How near imagined goals are to what was reached."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from model_folders import spec_of
from pushing_scene import episode, stacked_scene
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model import ActionModel, TextModel, Tokenizer, WorldModels
from wm_nodes.world_model.dynamics import Prediction
from wm_nodes.world_model.training.tokenizer import train_tokenizer
from wm_nodes.world_model.validation.acceptance import accept_world_model
from wm_nodes.world_model.validation.goals import goal_metrics

CONFIG = load_config("base", {
    "tokenizer.width": 32, "tokenizer.depth": 1, "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8,
    "tokenizer.batch_size": 32, "tokenizer.num_iterations": 250, "tokenizer.learning_rate": 3e-3,
    "world_model.width": 16, "world_model.depth": 1, "world_model.num_heads": 2,
})


class Oracle(TextModel):
    """Shows `frames` (E, H, W, 3) at once and says that the task is done where `sure`."""

    def __init__(self, tokenizer: Tokenizer, frames: np.ndarray, sure: bool = True) -> None:
        super().__init__(
            CONFIG.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            vocabulary=("push", "the", "square", *map(str, range(20))), num_tasks=1,
        )
        self.told: list[str] = []
        self._wanted, self._signal = tokenizer.encode(frames), 5.0 if sure else -5.0

    def forward(self, latents_BTSD: Tensor, instructions: Sequence[str], caches: object = None) -> Prediction:
        self.told = list(instructions)
        change = self._wanted.unsqueeze(1) - latents_BTSD
        logits = change.new_full((len(change), 1, 1, 1), self._signal)
        return Prediction(change, change.new_zeros(len(change), 1, 0), logits)


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return train_tokenizer(arrays(60), CONFIG, 0, None)[0]


def arrays(count: int, first_seed: int = 0) -> EpisodeArrays:
    return stacked_scene([episode(first_seed + i) for i in range(count)], ("push_cube",))


def models(tokenizer: Tokenizer, text: TextModel | None) -> WorldModels:
    action = ActionModel(
        CONFIG.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim, action_dim=3, state_dim=3,
        num_tasks=1,
    )
    return WorldModels(tokenizer, action, text, ("push_cube",), spec_of(CONFIG, tokenizer), {})


def won(episodes: EpisodeArrays) -> tuple[EpisodeArrays, np.ndarray, np.ndarray]:
    """The successful episodes, their first frames and those of their first success."""
    rows = np.flatnonzero(episodes.success[..., 0].any(1) & ~episodes.success[:, 0, 0])
    first = episodes.success[rows, :, 0].argmax(1)
    return episodes.select(rows), episodes.images[rows, 0], episodes.images[rows, first]


def test_a_goal_that_was_reached_is_near_and_the_first_frame_is_as_far_as_copying(tokenizer: Tokenizer) -> None:
    episodes = arrays(40, 1000)
    winners, first, reached = won(episodes)
    assert 5 < len(winners) < 40
    right = goal_metrics(models(tokenizer, Oracle(tokenizer, reached)), episodes, CONFIG, "push_cube")
    assert right["goal_episodes"] == len(winners) and right["goal_found"] == 1.0
    assert right["goal_object_cm"] < 0.5 * right["goal_object_copy_cm"]
    assert right["goal_tool_cm"] < 0.5 * right["goal_tool_copy_cm"]
    assert right["goal_perceptual"] < 0.5 * right["goal_perceptual_copy"]
    still = goal_metrics(models(tokenizer, Oracle(tokenizer, first, sure=False)), episodes, CONFIG, "push_cube")
    assert still["goal_found"] == 0.0
    assert still["goal_object_cm"] == pytest.approx(still["goal_object_copy_cm"], rel=0.3)


def test_an_instruction_of_unknown_words_is_left_out_and_counted(tokenizer: Tokenizer) -> None:
    episodes, _, reached = won(arrays(20, 2000))
    texts = ("push the mug", *("push the square",) * (len(episodes) - 1))
    told = replace(episodes, instructions=texts)
    metrics = goal_metrics(models(tokenizer, Oracle(tokenizer, reached[1:])), told, CONFIG, "push_cube")
    assert (metrics["goal_left_out"], metrics["goal_episodes"]) == (1, len(episodes) - 1)
    assert metrics["goal_object_cm"] < 0.5 * metrics["goal_object_copy_cm"]
    nobody = replace(episodes, instructions=("push the mug",) * len(episodes))
    left = goal_metrics(models(tokenizer, Oracle(tokenizer, reached)), nobody, CONFIG, "push_cube")
    assert left == {"goal_episodes": 0, "goal_left_out": len(episodes)}


def test_each_episode_is_told_its_own_instruction_and_no_success_gives_no_metric(tokenizer: Tokenizer) -> None:
    episodes, _, reached = won(arrays(20, 2000))
    told = replace(episodes, instructions=tuple(f"push {i}" for i in range(len(episodes))))
    text = Oracle(tokenizer, reached)
    goal_metrics(models(tokenizer, text), told, CONFIG, "push_cube")
    assert text.told == list(told.instructions)
    lost = replace(episodes, success=np.zeros_like(episodes.success))
    assert goal_metrics(models(tokenizer, text), lost, CONFIG, "push_cube") == {}
    assert goal_metrics(models(tokenizer, None), episodes, CONFIG, "push_cube") == {}


def test_where_goals_are_rewards_a_text_model_that_learned_nothing_is_refused(tokenizer: Tokenizer) -> None:
    episodes, first, reached = won(arrays(40, 1000))
    paid = CONFIG.with_values(reward=CONFIG.reward.with_values(dense_weight=0.5))
    torch.manual_seed(0)
    random = TextModel(
        CONFIG.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
        vocabulary=("push", "the", "square"), num_tasks=1,
    ).eval()
    found = {}
    for name, text in (
        ("random", random), ("still", Oracle(tokenizer, first)), ("right", Oracle(tokenizer, reached)),
    ):
        report = accept_world_model(models(tokenizer, text), episodes, paid)
        found[name] = {row.name.split(": ")[1]: row for row in report.criteria if row.name.startswith("imagined goal")}
        silent = accept_world_model(models(tokenizer, text), episodes, CONFIG)
        assert not any("goal" in row.name for row in silent.criteria), "goals pay nothing there"
    assert {name: row.outcome for name, row in found["right"].items()} == dict.fromkeys(found["right"], "passed")
    assert found["right"].keys() == {"found", "object error / first frame", "tool error / first frame"}
    for name in ("random", "still"):
        assert found[name]["object error / first frame"].outcome == "failed"
        assert found[name]["tool error / first frame"].outcome == "failed"
    assert found["random"]["found"].outcome == "failed"
    low, high = found["right"]["object error / first frame"].interval or (1, 0)
    assert low < found["right"]["object error / first frame"].value < high


def test_without_an_episode_that_reaches_the_goal_the_text_model_is_undecided(tokenizer: Tokenizer) -> None:
    episodes, _, reached = won(arrays(20, 2000))
    paid = CONFIG.with_values(reward=CONFIG.reward.with_values(dense_weight=0.5))
    lost = replace(episodes, success=np.zeros_like(episodes.success))
    report = accept_world_model(models(tokenizer, Oracle(tokenizer, reached)), lost, paid)
    assert report.undecided == ("imagined goal of push_cube: episodes that reach it",)
