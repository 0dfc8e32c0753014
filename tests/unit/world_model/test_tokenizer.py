"""The frame codec and its quantiser."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from wm_nodes.config.load import load_config
from wm_nodes.world_model.quantizer import bits_to_indices, entropy_loss, indices_to_bits, quantize
from wm_nodes.world_model.tokenizer import Tokenizer


def make_tokenizer(kind: str = "continuous", **settings: object) -> Tokenizer:
    overrides = {"tokenizer.kind": kind, "tokenizer.width": 16, "tokenizer.depth": 1, "tokenizer.latent_dim": 6}
    config = load_config("base", overrides | {f"tokenizer.{key}": value for key, value in settings.items()})
    torch.manual_seed(0)
    return Tokenizer(config.tokenizer, 32, 64).eval()


def images(count: int = 2) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, 32, 64, 3), dtype=np.uint8)


def test_an_image_becomes_a_grid_of_tokens_and_an_image_of_the_same_size_again() -> None:
    tokenizer = make_tokenizer()
    latents = tokenizer.encode(images())
    assert latents.shape == (2, 2 * 4, 6)
    decoded = tokenizer.decode(latents)
    assert decoded.shape == (2, 32, 64, 3)
    assert decoded.dtype == torch.uint8


@pytest.mark.parametrize("patch_px", [4, 8, 16])
def test_a_token_stands_for_a_square_patch(patch_px: int) -> None:
    assert make_tokenizer(patch_px=patch_px).encode(images()).shape[1] == (32 // patch_px) * (64 // patch_px)


def test_continuous_tokens_have_zero_mean_and_unit_variance_and_normalising_twice_changes_nothing() -> None:
    tokenizer = make_tokenizer()
    latents = tokenizer.encode(images())
    torch.testing.assert_close(latents.mean(-1), torch.zeros(2, 8), atol=1e-5, rtol=0)
    torch.testing.assert_close(tokenizer.normalise(latents), latents, atol=1e-3, rtol=0)


def test_lfq_tokens_are_signs() -> None:
    assert set(make_tokenizer("lfq").encode(images()).unique().tolist()) <= {-1.0, 1.0}


def test_the_sign_of_zero_is_minus_one_and_the_gradient_passes_straight_through() -> None:
    values = torch.tensor([-2.0, 0.0, 0.5], requires_grad=True)
    quantised = quantize(values)
    assert quantised.tolist() == [-1.0, -1.0, 1.0]
    (quantised * torch.tensor([1.0, 2.0, 3.0])).sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [1.0, 2.0, 3.0]


@given(st.integers(1, 16), st.data())
def test_codes_and_indices_are_one_to_one(num_bits: int, data: st.DataObject) -> None:
    indices = torch.tensor(data.draw(st.lists(st.integers(0, 2**num_bits - 1), min_size=1, max_size=32)))
    assert bits_to_indices(indices_to_bits(indices, num_bits)).equal(indices)


def test_every_code_of_a_small_vocabulary_has_its_own_bits() -> None:
    bits = indices_to_bits(torch.arange(64), 6)
    assert bits.unique(dim=0).shape == (64, 6)
    assert bits[1].tolist() == [1, -1, -1, -1, -1, -1]


def test_entropy_rewards_confident_and_diverse_codes() -> None:
    confident = 10 * indices_to_bits(torch.arange(16), 4).unsqueeze(0)
    undecided = torch.zeros(1, 16, 4)
    collapsed = confident[:, :1].expand(1, 16, 4)
    ln2 = float(np.log(2))
    assert entropy_loss(confident).item() == pytest.approx(-ln2, abs=1e-2)
    assert entropy_loss(undecided).item() == pytest.approx(0, abs=1e-4)
    assert entropy_loss(collapsed).item() == pytest.approx(0, abs=1e-2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [(np.zeros((1, 32, 32, 3), np.uint8), "uint8"), (np.zeros((1, 32, 64, 3), np.float32), "float32")],
)
def test_images_of_another_size_or_type_are_refused(wrong: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_tokenizer().encode(wrong)


def test_a_patch_that_does_not_divide_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="patch_px"):
        make_tokenizer(patch_px=24)
