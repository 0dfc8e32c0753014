"""Goals imagined by the text model (RS-6)."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.world_model import TextModel, Tokenizer, imagine_goals
from wm_nodes.world_model.dynamics import Prediction

HORIZON = 6


class ScriptedTextModel(TextModel):
    """Says a scripted done probability at each step, whatever it sees; pictures stay as they are."""

    def __init__(self, signals_BT: list[list[float]], tokenizer: Tokenizer) -> None:
        config = load_config("base", {"world_model.width": 16, "world_model.depth": 1, "world_model.num_heads": 2})
        super().__init__(
            config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            vocabulary=("push", "cube"), num_tasks=1,
        )
        self.signals = torch.tensor(signals_BT)
        self.step = 0

    def forward(self, latents_BTSD: Tensor, instructions: Sequence[str], caches: object = None) -> Prediction:
        logits = torch.logit(self.signals[:, self.step]).view(-1, 1, 1, 1)
        self.step += 1
        change = torch.zeros_like(latents_BTSD)
        change[..., 0] = 1.0
        return Prediction(change, logits.new_zeros(len(logits), 1, 0), logits)


def make_tokenizer() -> Tokenizer:
    config = load_config("base", {"tokenizer.width": 16, "tokenizer.depth": 1, "tokenizer.latent_dim": 6})
    torch.manual_seed(0)
    return Tokenizer(config.tokenizer, 32, 32).eval()


def first_frames(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, 32, 32, 3), dtype=np.uint8)


def test_the_goal_is_the_first_crossing_and_without_one_the_best_frame_marked_as_not_found() -> None:
    tokenizer = make_tokenizer()
    signals = [[0.1, 0.2, 0.8, 0.6, 0.95, 0.1], [0.1, 0.7, 0.3, 0.2, 0.1, 0.1]]
    model = ScriptedTextModel(signals, tokenizer)
    goals = imagine_goals(model, tokenizer, first_frames(2), ["push cube"] * 2, [0, 0], horizon=HORIZON, threshold=0.7)
    assert goals.found.tolist() == [True, False]
    assert goals.lengths.tolist() == [3 + 1, 2 + 1]
    np.testing.assert_array_equal(goals.goals[0], goals.frames[0, 3])
    np.testing.assert_array_equal(goals.goals[1], goals.frames[1, 2])


def test_the_golden_trajectory_begins_with_the_first_frame() -> None:
    tokenizer, frames = make_tokenizer(), first_frames(1)
    model = ScriptedTextModel([[0.9] * HORIZON], tokenizer)
    goals = imagine_goals(model, tokenizer, frames, ["push cube"], [0], horizon=HORIZON, threshold=0.5)
    assert goals.frames.shape == (1, HORIZON + 1, 32, 32, 3)
    np.testing.assert_array_equal(goals.frames[:, 0], frames)
    assert goals.lengths.tolist() == [2]


@pytest.mark.parametrize("instruction", ["push sphere", "", "push " * 13])
def test_an_instruction_outside_the_vocabulary_is_refused(instruction: str) -> None:
    model = ScriptedTextModel([[0.5]], make_tokenizer())
    with pytest.raises(ValueError, match="instruction"):
        model.condition(["push cube", instruction])


def test_the_same_words_in_another_order_are_another_condition() -> None:
    model = ScriptedTextModel([[0.5]], make_tokenizer())
    one, other, capitals = (model.condition([text])[0] for text in ("push cube", "cube push", "Push CUBE"))
    assert not one.equal(other) and capitals.equal(one)
