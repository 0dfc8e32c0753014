"""Training rollouts made for a GPU against those of the CPU: the same predictions and gradients, to rounding."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from wm_nodes.config.load import load_config
from wm_nodes.world_model.dynamics import ActionModel, Prediction
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training import device_rollout
from wm_nodes.world_model.training.device_rollout import _Normalise, _Past, roll_out_on_device
from wm_nodes.world_model.training.dynamics import RolloutTerms, roll_out

BATCH, STEPS, WINDOW = 3, 7, 4
Inputs = tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]


def make_models() -> tuple[ActionModel, Tokenizer]:
    """Weights at random everywhere: first weights hide mistakes in biases and in the norms' scales and shifts."""
    config = load_config("base", {
        "tokenizer.width": 16, "tokenizer.depth": 1, "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8,
        "world_model.width": 32, "world_model.depth": 2, "world_model.num_heads": 2, "world_model.window": WINDOW,
        "world_model.condition_map": 16,
    })
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer, 16, 32)
    model = ActionModel(
        config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=8, action_dim=3, state_dim=3, num_tasks=2,
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model, tokenizer


def make_inputs(tokenizer: Tokenizer) -> Inputs:
    """Real frames, anchors that differ between the episodes, and what the condition is made of."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    anchors = torch.zeros(BATCH, STEPS, dtype=torch.bool)
    anchors[:, 0], anchors[1, 3], anchors[2, 5] = True, True, True
    states = normal(BATCH, STEPS + 1, 3)
    real = tokenizer.normalise(normal(BATCH, STEPS, tokenizer.num_tokens, 8))
    return real, anchors, (normal(BATCH, STEPS, 3), states[:, :-1], states[:, 1:])


def roll_out_on_cpu(model: ActionModel, tokenizer: Tokenizer, inputs: Inputs) -> RolloutTerms:
    real, anchors, given = inputs
    condition, caches = model.condition(*given), model.trunk.new_caches()

    def predict(t: int, latents: Tensor) -> Prediction:
        return model.predict(latents, condition[:, t : t + 1], caches)

    def choose_input(t: int, frame: Tensor) -> Tensor:
        return torch.where(anchors[:, t, None, None, None], real[:, t : t + 1], frame)

    return roll_out(predict, tokenizer, real[:, :1], STEPS, choose_input)


def results(terms: RolloutTerms, model: ActionModel) -> dict[str, Tensor]:
    """What is predicted, and the gradients of a sum of all of it with weights of both signs."""
    found = {"latents": terms.next_latents, "positions": terms.positions, "logits": terms.done_logits}
    generator = torch.Generator().manual_seed(2)
    torch.stack([(value * torch.randn(value.shape, generator=generator)).mean() for value in found.values()]).sum() \
        .backward()
    found |= {f"gradient of {name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
    return {name: value.detach() for name, value in found.items()}


def both(dtype: torch.dtype) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    model, tokenizer = make_models()
    inputs = make_inputs(tokenizer)
    on_cpu = results(roll_out_on_cpu(model, tokenizer, inputs), model)
    model.zero_grad()
    real, anchors, given = inputs
    condition = model.condition(*given)
    terms = RolloutTerms(
        *roll_out_on_device(model, tokenizer, real, anchors, condition, dtype)
    )
    return on_cpu, results(terms, model)


@pytest.mark.parametrize("most_rows", [device_rollout.MOST_ROWS, 10])
def test_predictions_and_all_gradients_are_those_of_the_plain_rollout(
    most_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_rollout, "MOST_ROWS", most_rows)
    on_cpu, for_device = both(torch.float32)
    assert on_cpu.keys() == for_device.keys()
    assert len(on_cpu) == 3 + sum(1 for _ in make_models()[0].parameters())
    for name, value in on_cpu.items():
        largest = float(value.abs().max())
        assert_close(for_device[name], value, rtol=0, atol=2e-4 * largest, msg=f"{name}, largest {largest}")


def test_in_bfloat16_they_are_close() -> None:
    on_cpu, for_device = both(torch.bfloat16)
    for name, value in on_cpu.items():
        found, wanted = for_device[name].flatten(), value.flatten()
        assert torch.cosine_similarity(found, wanted, dim=0) > 0.98, name
        assert 0.9 < found.norm() / wanted.norm() < 1.1, name


def test_the_norm_has_the_gradient_that_autograd_finds() -> None:
    torch.manual_seed(0)
    x = torch.randn(4, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: sum(_Normalise.apply(x, torch.float64)), x, check_undefined_grad=False)


def test_gradients_of_the_past_that_come_in_another_order_are_refused() -> None:
    past = _Past(torch.empty(3, 2, 3, 1, 4), window=3)

    def add(t: int) -> Tensor:
        return past.add_gradients(t, torch.ones(2, 1, 1, 4), *(torch.ones(2, 1, t + 1, 4) for _ in range(2)))

    assert add(2).tolist() == [[1.0] * 12] * 2
    assert add(1).tolist() == [[1.0] * 4 + [2.0] * 8] * 2
    with pytest.raises(RuntimeError, match="reached step 2 of the past before step 0"):
        add(2)
