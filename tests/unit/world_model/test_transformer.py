"""The spatio-temporal transformer: causality, caches, cross-attention."""

import pytest
import torch
from torch import Tensor

from wm_nodes.world_model.transformer import CrossAttention, SpatioTemporalTransformer

BATCH, FRAMES, TOKENS, WIDTH, CONDITIONS = 3, 7, 5, 24, 4


def make(window: int = 16) -> SpatioTemporalTransformer:
    torch.manual_seed(0)
    return SpatioTemporalTransformer(WIDTH, 2, 2, window).eval()


def inputs() -> tuple[Tensor, Tensor]:
    torch.manual_seed(1)
    return torch.randn(BATCH, FRAMES, TOKENS, WIDTH), torch.randn(BATCH, FRAMES, CONDITIONS, WIDTH)


@torch.no_grad()
def step_by_step(model: SpatioTemporalTransformer, x: Tensor, condition: Tensor) -> Tensor:
    caches = model.new_ring_caches(BATCH, x.device)
    return torch.cat([model(x[:, t : t + 1], condition[:, t : t + 1], caches) for t in range(x.shape[1])], 1)


@pytest.mark.parametrize("window", [3, 16])
def test_frame_by_frame_with_a_cache_equals_the_whole_clip_at_once(window: int) -> None:
    model, (x, condition) = make(window), inputs()
    with torch.no_grad():
        torch.testing.assert_close(step_by_step(model, x, condition), model(x, condition), atol=1e-5, rtol=0)


@pytest.mark.parametrize("window", [3, 16])
def test_the_training_cache_equals_the_whole_clip_at_once(window: int) -> None:
    model, (x, condition) = make(window), inputs()
    caches = model.new_caches()
    with torch.no_grad():
        pieces = [model(x[:, a:b], condition[:, a:b], caches) for a, b in ((0, 3), (3, 4), (4, 7))]
        torch.testing.assert_close(torch.cat(pieces, 1), model(x, condition), atol=1e-5, rtol=0)


@torch.no_grad()
def test_a_later_frame_leaves_earlier_outputs_bit_equal() -> None:
    model, (x, condition) = make(), inputs()
    changed = x.clone()
    changed[:, 4] += 1
    before, after = model(x, condition), model(changed, condition)
    assert before[:, :4].equal(after[:, :4])
    assert not before[:, 4:].equal(after[:, 4:])


@torch.no_grad()
def test_a_condition_changes_its_own_frame_and_later_ones_only() -> None:
    model, (x, condition) = make(), inputs()
    changed = condition.clone()
    changed[:, 3] += 1
    before, after = model(x, condition), model(x, changed)
    assert before[:, :3].equal(after[:, :3])
    assert all(not before[:, t].equal(after[:, t]) for t in range(3, FRAMES))


@torch.no_grad()
def test_frames_beyond_the_window_are_forgotten() -> None:
    model, (x, condition) = make(window=2), inputs()
    changed = x.clone()
    changed[:, 0] += 1
    depth = 2
    assert model(x, condition)[:, depth + 1 :].equal(model(changed, condition)[:, depth + 1 :])


@torch.no_grad()
def test_only_time_differences_matter() -> None:
    model, (x, condition) = make(window=3), inputs()
    late = step_by_step(model, torch.cat((x, x), 1), torch.cat((condition, condition), 1))[:, FRAMES + 4 :]
    once = step_by_step(model, x, condition)[:, 4:]
    torch.testing.assert_close(late, once, atol=1e-5, rtol=0)


@torch.no_grad()
def test_restarting_one_environment_is_bit_equal_to_starting_fresh_and_leaves_the_others_alone() -> None:
    model, (x, condition) = make(), inputs()
    plain = step_by_step(model, x, condition)
    caches = model.new_ring_caches(BATCH, x.device)
    for t in range(4):
        model(x[:, t : t + 1], condition[:, t : t + 1], caches)
    for cache in caches:
        cache.restart(torch.tensor([True, False, False]))
    frame, tokens = x[:, 4:5].clone(), condition[:, 4:5].clone()
    frame[0], tokens[0] = x[0, :1], condition[0, :1]
    mixed = model(frame, tokens, caches)
    assert mixed[0].equal(plain[0, :1])
    assert mixed[1:].equal(plain[1:, 4:5])


@torch.no_grad()
def test_attending_to_a_single_condition_token_is_only_a_bias() -> None:
    torch.manual_seed(0)
    attention = CrossAttention(WIDTH, 2)
    x, condition = inputs()
    single = attention(x, condition[:, :, :1])
    torch.testing.assert_close(single, single[:, :, :1].expand_as(single))
    several = attention(x, condition)
    assert (several - several[:, :, :1]).abs().max() > 1e-3


def test_a_width_that_the_heads_do_not_divide_is_refused() -> None:
    with pytest.raises(ValueError, match="num_heads"):
        SpatioTemporalTransformer(20, 1, 3, 4)
