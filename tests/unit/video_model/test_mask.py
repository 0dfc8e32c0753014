"""Where noise is placed: the dynamics-aware mask, worked by hand and by its symmetries. Ids: spec 4.1."""


import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from video_toys import (
    mask_config,
    randn,
    sampler_config,
    times,
    toy_condition,
)

from wm_nodes.video_model import StepContext, step
from wm_nodes.video_model.kernels import SIGMA_LIMIT
from wm_nodes.video_model.mask import dynamic_mask, quantile, residual
from wm_nodes.video_rl.toy_scene import draw_scenes, opacity_at

BIG = (2, 4, 8, 16, 16)
PAPER = mask_config()
COMBINES = ["gated", "sparse"]


def one_hot_corner() -> Tensor:
    """C = 1, F = 2, 2 x 2: zeros, but 4 in one corner of frame 1."""
    x0 = torch.zeros(1, 1, 2, 2, 2)
    x0[0, 0, 1, 0, 0] = 4
    return x0


def moving_blob() -> tuple[Tensor, Tensor]:
    """A soft disc that crosses a still texture, and where it is: (1, 2, 6, 16, 16) and bool (6, 16, 16)."""
    scenes = draw_scenes(1, seed=0, name="mask_test")
    return scenes.videos(scenes.action), opacity_at(scenes.path(scenes.action))[0] > 0.5


# DD-6 to DD-9, by hand


def test_the_residual_of_one_changed_corner_is_3_there_and_minus_1_elsewhere_in_both_frames() -> None:
    """DD-6: the first frame takes the second one's residual."""
    frame = torch.tensor([[3.0, -1.0], [-1.0, -1.0]])
    assert_close(residual(one_hot_corner()), torch.stack([frame, frame])[None, None])


@pytest.mark.parametrize("combine", COMBINES)
def test_the_mask_of_one_changed_corner_is_the_one_worked_by_hand(combine: str) -> None:
    """Intensity (1, 1/3, 1/3, 1/3) in both frames, threshold 0.5 at q = 0.75."""
    settings = mask_config(m_min=0.2, quantile=0.75, combine=combine)  # type: ignore[arg-type]
    frame = torch.tensor([[1.0, 0.2], [0.2, 0.2]])
    assert_close(
        dynamic_mask(one_hot_corner(), 0, settings), torch.stack([frame, frame])[None, None], atol=1e-6, rtol=0
    )
    intensity = torch.tensor([[1, 1 / 3, 1 / 3, 1 / 3] * 2])
    assert float(quantile(intensity, 0.75)) == pytest.approx(0.5, abs=1e-6)


def test_a_cell_that_reaches_the_threshold_counts_as_dynamic() -> None:
    """DD-8 says >=: with q = 1 the largest cell alone is left."""
    settings = mask_config(quantile=1.0)
    assert dynamic_mask(one_hot_corner(), 0, settings)[0, 0, 1].flatten().tolist() == pytest.approx([1, 0.2, 0.2, 0.2])


@pytest.mark.parametrize("q", [0.0, 0.25, 0.5, 0.8, 0.99, 1.0])
@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_the_quantile_is_torch_s(q: float, count: int) -> None:
    values = randn(3, count, seed=6).abs()
    for some in (values, values.round()):  # and with ties
        assert_close(quantile(some, q), torch.quantile(some, q, dim=1))


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 1, 3, 8])
def test_the_mask_lies_between_its_floor_and_one_and_is_zero_on_given_frames(combine: str, given: int) -> None:
    settings = mask_config(m_min=0.3, combine=combine)  # type: ignore[arg-type]
    mask = dynamic_mask(randn(*BIG), given, settings)
    assert mask.shape == (2, 1, 8, 16, 16) and not mask.requires_grad
    assert not mask[:, :, :given].any()
    if given < 8:
        generated = mask[:, :, given:]
        assert float(generated.min()) >= 0.3 - 1e-7 and float(generated.max()) == pytest.approx(1.0, abs=1e-6)
        assert float(generated.max()) <= 1.0


def test_every_channel_of_a_cell_has_the_same_deviation() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    law = step(x, v, times(0.8, 0.8), times(0.5, 0.5), StepContext(x[:, :, :1], 0.9), sampler_config())
    assert law.std.shape == law.mask.shape == (2, 1, 8, 16, 16)
    assert law.std[:, :, 1:].unique().numel() > 10


@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize("budget", ["literal", "rms"])
def test_a_still_video_and_one_that_only_brightens_explore_everywhere(given: int, budget: str) -> None:
    settings = mask_config(budget=budget)  # type: ignore[arg-type]
    still = randn(2, 3, 1, 8, 8, seed=4).expand(2, 3, 5, 8, 8)
    brighter = still + torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]).view(1, 1, 5, 1, 1)
    for x0 in (still, brighter, torch.zeros_like(still)):
        mask = dynamic_mask(x0, given, settings)
        assert bool((mask[:, :, given:] == 1).all()) and not mask[:, :, :given].any()
    moved = still.clone()
    moved[:, :, 3:] = moved[:, :, 3:].roll(1, 3)
    assert float(dynamic_mask(moved, given, PAPER)[:, :, given:].min()) < 1


def test_stillness_is_judged_video_by_video() -> None:
    x0 = randn(2, 3, 5, 8, 8, seed=4)
    x0[0] = x0[0, :, :1]
    mask = dynamic_mask(x0, 0, PAPER)
    assert bool((mask[0] == 1).all()) and float(mask[1].min()) == pytest.approx(0.2)


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 2])
def test_the_mask_ignores_still_images_and_scale_and_follows_flips_and_shifts(combine: str, given: int) -> None:
    settings = mask_config(combine=combine)  # type: ignore[arg-type]
    x0 = randn(*BIG, seed=8)
    mask = dynamic_mask(x0, given, settings)
    close = {"atol": 1e-5, "rtol": 0.0}
    assert_close(dynamic_mask(x0 + randn(2, 4, 1, 16, 16, seed=9), given, settings), mask, **close)
    assert_close(dynamic_mask(7.5 * x0, given, settings), mask, **close)
    assert_close(dynamic_mask(x0.flip(3), given, settings), mask.flip(3), **close)
    assert_close(dynamic_mask(x0.flip(4), given, settings), mask.flip(4), **close)
    assert_close(dynamic_mask(x0.roll((3, 5), (3, 4)), given, settings), mask.roll((3, 5), (3, 4)), **close)


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 1])
def test_a_moving_blob_is_explored_at_least_1_8_times_as_much_as_its_still_surroundings(
    combine: str, given: int
) -> None:
    """From the exact clean estimate."""
    x0, inside = moving_blob()
    mask = dynamic_mask(x0, given, mask_config(combine=combine))[0, 0, given:]  # type: ignore[arg-type]
    assert float(mask[inside[given:]].mean()) >= 1.8 * float(mask[~inside[given:]].mean())


def test_frames_without_any_motion_are_not_dynamic_even_when_most_frames_have_none() -> None:
    """Ties at zero: 4 of 5 frames do not change, so the 0.8 quantile of the intensity is 0."""
    x0 = randn(1, 1, 1, 8, 8, seed=4).repeat(1, 1, 10, 1, 1)
    x0[:, :, 9] = x0[:, :, 9].roll(1, 2)
    mask = dynamic_mask(x0, 0, mask_config(combine="sparse"))
    assert bool((mask[:, :, :9] == 0.2).all()), "a frame that does not move explores at the floor"
    assert float(mask[:, :, 9].max()) == 1.0


@pytest.mark.parametrize("arm", ["dyndiff"])
def test_what_a_network_says_about_given_frames_does_not_change_the_mask(arm: str) -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    context = StepContext(randn(2, 4, 2, 16, 16, seed=3), 0.9)
    t, s = times(0.8, 0.4), times(0.5, 0.1)
    plain = step(x, v, t, s, context, sampler_config(arm))  # type: ignore[arg-type]
    shouting = v.clone()
    shouting[:, :, :2] = 1e3 * randn(2, 4, 2, 16, 16, seed=4)
    assert torch.equal(step(x, shouting, t, s, context, sampler_config(arm)).mask, plain.mask)  # type: ignore[arg-type]
    shouting[:, :, 2:] *= 1.5
    assert not torch.equal(step(x, shouting, t, s, context, sampler_config(arm)).mask, plain.mask)  # type: ignore[arg-type]


def test_the_first_generated_frame_is_compared_with_the_clean_given_one() -> None:
    """A video that stands still from its given frame on is still, whatever noise the given frame had."""
    clean = randn(1, 2, 4, 8, 8, seed=1)[:, :, :1].expand(1, 2, 4, 8, 8)
    t, x = times(0.5), 0.5 * clean + 0.5 * randn(1, 2, 4, 8, 8, seed=2)
    v = (x - clean) / 0.5
    v[:, :, 0] = 50.0
    mask = step(x, v, t, times(0.4), StepContext(clean[:, :, :1], 0.9), sampler_config()).mask
    assert float(mask[:, :, 1:].mean()) > 0.2
    law = step(
        x.double(),
        ((x - clean) / 0.5).double(),
        t,
        times(0.4),
        StepContext(clean[:, :, :1].double(), 0.9),
        sampler_config(),
    )
    assert bool((law.mask[:, :, 1:] == 1).all())


# shapes and contracts


@pytest.mark.parametrize("shape", [(1, 1, 1, 1, 1), (2, 3, 1, 5, 7)])
def test_an_image_is_explored_everywhere(shape: tuple[int, ...]) -> None:
    assert bool((dynamic_mask(randn(*shape), 0, PAPER) == 1).all())


@pytest.mark.parametrize("shape", [(1, 1, 2, 1, 1), (1, 3, 5, 5, 7), (3, 1, 3, 3, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_odd_sizes_and_other_number_types_give_a_finite_float32_mask(
    shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    mask = dynamic_mask(randn(*shape).to(dtype), 1, PAPER)
    assert mask.dtype == torch.float32 and mask.shape == (shape[0], 1, *shape[2:]) and bool(torch.isfinite(mask).all())


@pytest.mark.parametrize("name", ["m_min", "quantile"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_a_share_outside_zero_to_one_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name}\n.* input_value={value}"):
        mask_config(**{name: value})


def test_a_floor_of_zero_is_refused_because_a_cell_without_noise_has_no_density() -> None:
    with pytest.raises(ValueError, match=r"m_min\n.*greater than 0"):
        mask_config(m_min=0.0)


# budget


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 2])
def test_an_rms_budget_gives_the_generated_cells_a_mean_square_of_one(combine: str, given: int) -> None:
    """The cell ratios stay those of the literal mask."""
    x0 = randn(*BIG, seed=8)
    literal = dynamic_mask(x0, given, mask_config(combine=combine))[:, :, given:]  # type: ignore[arg-type]
    mask = dynamic_mask(x0, given, mask_config(combine=combine, budget="rms"))[:, :, given:]  # type: ignore[arg-type]
    assert_close(mask.square().mean((1, 2, 3, 4)).sqrt(), torch.ones(2), atol=1e-6, rtol=0)
    assert_close(mask / mask.amax(), literal / mask.amax() * (mask.amax() / literal.amax()), rtol=2e-2, atol=0)
    assert float(literal.square().mean()) < 0.5, "the literal mask always spends less"


def test_an_rms_budget_spends_the_noise_of_coefficient_preserving_sampling() -> None:
    """On a step of eta 0.3, where no cell is clamped."""
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    context = StepContext(x[:, :, :1], 0.9)
    t, s = times(0.8, 0.8), times(0.5, 0.5)
    masked = step(x, v, t, s, context, sampler_config("dyndiff", 0.2, mask=mask_config(budget="rms")))
    plain = step(x, v, t, s, context, sampler_config("cps", 0.2))
    assert float(masked.mask.max()) > 1 and float(masked.std.max()) < 0.999 * 0.5
    assert_close(masked.std.square().mean((1, 2, 3, 4)), plain.std.square().mean((1, 2, 3, 4)), rtol=1e-5, atol=0)


def test_a_budget_that_asks_for_more_noise_than_there_is_is_clamped() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    settings = sampler_config("dyndiff", 0.9, mask=mask_config(budget="rms"))
    law = step(x, v, times(0.8, 0.8), times(0.5, 0.5), StepContext(x[:, :, :1], 0.9), settings)
    assert float(law.std.max()) == pytest.approx(SIGMA_LIMIT * 0.5) and bool(torch.isfinite(law.mean).all())


def test_given_frames_do_not_enter_the_intensity_or_its_quantile() -> None:
    """A wild change inside the given frames must not dim the generated ones."""
    x0 = randn(1, 2, 6, 8, 8, seed=4)
    wild = x0.clone()
    wild[:, :, 0] *= 100
    assert torch.equal(dynamic_mask(x0, 2, PAPER), dynamic_mask(wild, 2, PAPER))
    assert toy_condition(1).num_conditioning == 1
