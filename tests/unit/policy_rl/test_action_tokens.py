"""Actions as tokens of a language model."""

import numpy as np
import pytest

from wm_nodes.policy_rl.action_tokens import ActionTokenizer


def test_the_round_trip_stays_within_half_a_bin() -> None:
    tokenizer = ActionTokenizer()
    actions = np.linspace(-1, 1, 20001, dtype=np.float32).reshape(-1, 3)
    tokens = tokenizer.encode(actions)
    np.testing.assert_array_equal(tokenizer.encode(tokenizer.decode(tokens)), tokens)
    error = np.abs(tokenizer.decode(tokenizer.encode(actions)) - actions).max()
    assert 0.9 / 255 < error <= 1 / 255 + 1e-7


def test_the_ids_are_openvlas() -> None:
    """By hand: edges at -1 + 2 k / 255; id = 32000 - digitize; 0 lies in bin 127, whose centre is 0. But 31744 of 1,
    which decodes as 31745, is 31745."""
    tokenizer = ActionTokenizer()
    assert tokenizer.encode(np.array([[-1.0, 0.0, 1.0]], np.float32)).tolist() == [[31999, 31872, 31745]]
    np.testing.assert_allclose(
        tokenizer.decode(np.array([31999, 31872, 31745, 31744])), [-254 / 255, 0, 254 / 255, 254 / 255], atol=1e-7
    )


def test_an_id_of_no_action_gives_the_nearest_bin() -> None:
    tokenizer = ActionTokenizer(vocabulary=1000)
    np.testing.assert_allclose(tokenizer.decode(np.array([1500, 3])), [-254 / 255, 254 / 255], atol=1e-7)


@pytest.mark.parametrize("wrong", [1.01, -2.0, np.nan])
def test_an_action_outside_the_normalised_range_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match=r"outside \[-1, 1\].*action_scale"):
        ActionTokenizer().encode(np.array([[0.0, wrong]], np.float32))
