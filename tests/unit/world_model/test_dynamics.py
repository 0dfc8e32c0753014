"""The action model: what its predictions may depend on, and the done signal."""

import pytest
import torch
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.world_model.dynamics import ActionModel, done_signal

BATCH, STEPS, TOKENS, LATENT = 2, 5, 6, 8


def make_model() -> ActionModel:
    config = load_config("base", {"world_model.width": 32, "world_model.depth": 2, "world_model.num_heads": 2})
    torch.manual_seed(0)
    model = ActionModel(
        config.world_model, num_tokens=TOKENS, latent_dim=LATENT, action_dim=3, state_dim=3, num_tasks=2
    )
    torch.nn.init.normal_(model.change.weight, std=0.1)
    return model.eval()


def inputs() -> dict[str, Tensor]:
    torch.manual_seed(1)
    states = torch.randn(BATCH, STEPS + 1, 3)
    return {
        "latents_BTSD": torch.randn(BATCH, STEPS, TOKENS, LATENT),
        "actions_BTA": torch.rand(BATCH, STEPS, 3) * 2 - 1,
        "states_BTP": states[:, :-1],
        "next_states_BTP": states[:, 1:],
    }


def test_shapes() -> None:
    prediction = make_model()(**inputs())
    assert prediction.change_BTSD.shape == (BATCH, STEPS, TOKENS, LATENT)
    assert prediction.done_logits_BTKJ.shape == (BATCH, STEPS, 3, 2)


@torch.no_grad()
@pytest.mark.parametrize("name", ["latents_BTSD", "actions_BTA", "states_BTP", "next_states_BTP"])
def test_step_t_changes_the_prediction_of_frame_t_plus_1_and_later_only(name: str) -> None:
    model, given = make_model(), inputs()
    changed = given | {name: given[name].clone()}
    changed[name][:, 2] += 0.3
    before, after = model(**given), model(**changed)
    assert before.change_BTSD[:, :2].equal(after.change_BTSD[:, :2])
    assert before.done_logits_BTKJ[:, :2].equal(after.done_logits_BTKJ[:, :2])
    for t in range(2, STEPS):
        assert not before.change_BTSD[:, t].equal(after.change_BTSD[:, t])


@torch.no_grad()
def test_an_untrained_model_predicts_that_nothing_changes() -> None:
    config = load_config("base", {"world_model.width": 32, "world_model.depth": 1, "world_model.num_heads": 2})
    sizes = {"num_tokens": TOKENS, "latent_dim": LATENT, "action_dim": 3, "state_dim": 3, "num_tasks": 1}
    assert ActionModel(config.world_model, **sizes)(**inputs()).change_BTSD.abs().max() == 0


def test_the_done_signal_is_the_most_doubtful_head_and_the_uncertainty_their_spread() -> None:
    probabilities = torch.tensor([[[0.9, 0.5], [0.7, 0.5]]])
    signal, spread = done_signal(torch.logit(probabilities))
    torch.testing.assert_close(signal, torch.tensor([[0.7, 0.5]]))
    torch.testing.assert_close(spread, torch.tensor([[0.1, 0.0]]))
