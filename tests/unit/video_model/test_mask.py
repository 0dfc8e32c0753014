"""Where noise is placed: the dynamics-aware mask, worked by hand and by its symmetries. Ids: spec 4.1."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from video_toys import (
    Analytic,
    grpo_config,
    kl_config,
    randn,
    times,
    toy_buffer,
    toy_condition,
    toy_rollout_settings,
)

from wm_nodes.video_model import MaskSettings, SamplerSettings, StepContext, dynamic_mask, step
from wm_nodes.video_model.kernels import SIGMA_LIMIT
from wm_nodes.video_model.mask import quantile, residual
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.toy_scene import draw_scenes, opacity_at

BIG = (2, 4, 8, 16, 16)
PAPER = MaskSettings()
COMBINES = ["gated", "sparse", "convex", "max"]


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


@pytest.mark.parametrize(
    ("combine", "corner", "elsewhere"),
    [("gated", 1.0, 0.2), ("sparse", 1.0, 0.2), ("convex", 1.0, 0.2 + 0.8 * 0.5 / 3), ("max", 1.0, 0.2)],
)
def test_the_mask_of_one_changed_corner_is_the_one_worked_by_hand(
    combine: str, corner: float, elsewhere: float
) -> None:
    """Intensity (1, 1/3, 1/3, 1/3) in both frames, threshold 0.5 at q = 0.75."""
    settings = MaskSettings(m_min=0.2, quantile=0.75, combine=combine)  # type: ignore[arg-type]
    frame = torch.tensor([[corner, elsewhere], [elsewhere, elsewhere]])
    assert_close(
        dynamic_mask(one_hot_corner(), 0, settings), torch.stack([frame, frame])[None, None], atol=1e-6, rtol=0
    )
    intensity = torch.tensor([[1, 1 / 3, 1 / 3, 1 / 3] * 2])
    assert float(quantile(intensity, 0.75)) == pytest.approx(0.5, abs=1e-6)


def test_a_cell_that_reaches_the_threshold_counts_as_dynamic() -> None:
    """DD-8 says >=: with q = 1 the largest cell alone is left."""
    settings = MaskSettings(quantile=1.0)
    assert dynamic_mask(one_hot_corner(), 0, settings)[0, 0, 1].flatten().tolist() == pytest.approx([1, 0.2, 0.2, 0.2])


def test_channels_become_one_intensity_by_root_mean_square_mean_or_maximum() -> None:
    """Residual (3, -1, -1, -1) in one channel and 0 in the other: intensities relative to the corner stay 1/3."""
    x0 = torch.cat([one_hot_corner(), 2 * one_hot_corner().flip(3)], 1)  # channel 1: twice as much, in another corner
    settings = {kind: MaskSettings(0.0001, 0.0, channel_norm=kind) for kind in ("rms", "l1", "max")}  # type: ignore[arg-type]
    first = {
        kind: dynamic_mask(x0, 0, s)[0, 0, 1, 0, 0] / dynamic_mask(x0, 0, s)[0, 0, 1, 1, 0]
        for kind, s in settings.items()
    }
    assert float(first["rms"]) == pytest.approx(((9 + 4) / (1 + 36)) ** 0.5, rel=1e-3)
    assert float(first["l1"]) == pytest.approx((3 + 2) / (1 + 6), rel=1e-3)
    assert float(first["max"]) == pytest.approx(3 / 6, rel=1e-3)


def test_the_central_difference_looks_to_both_sides() -> None:
    """A pulse in frame 1 of 4: backward differences are +, -, 0; central ones +, 0 (both halves cancel), -/2, 0."""
    x0 = torch.zeros(1, 1, 4, 2, 2)
    x0[0, 0, 1, 0, 0] = 4
    assert residual(x0)[0, 0, :, 0, 0].tolist() == [3, 3, -3, 0]
    assert residual(x0, "central")[0, 0, :, 0, 0].tolist() == [3, 0, -1.5, 0]


def test_one_hot_cell_does_not_dim_the_rest_when_the_99th_percentile_normalises() -> None:
    x0 = 0.1 * randn(1, 1, 4, 16, 16, seed=3)
    x0[0, 0, 2, 0, 0] = 100
    dim, bright = (dynamic_mask(x0, 0, MaskSettings(norm=norm)).mean() for norm in ("max", "q99"))  # type: ignore[arg-type]
    assert float(dim) < 0.21 and float(bright) > 0.25
    assert float(dynamic_mask(x0, 0, MaskSettings(norm="q99")).max()) == pytest.approx(1.0)


def test_a_frame_by_frame_norm_gives_every_frame_its_own_full_exploration() -> None:
    x0 = randn(1, 1, 4, 8, 8, seed=3)
    x0[:, :, 3] = x0[:, :, 2] + 1e-3 * randn(1, 1, 8, 8, seed=4)
    sample, frame = (dynamic_mask(x0, 0, MaskSettings(norm_scope=scope)) for scope in ("sample", "frame"))  # type: ignore[arg-type]
    assert float(sample[0, 0, 3].max()) == pytest.approx(0.2) and float(frame[0, 0, 3].max()) == pytest.approx(1.0)


@pytest.mark.parametrize("q", [0.0, 0.25, 0.5, 0.8, 0.99, 1.0])
@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_the_quantile_is_torch_s(q: float, count: int) -> None:
    values = randn(3, count, seed=6).abs()
    for some in (values, values.round()):  # and with ties
        assert_close(quantile(some, q), torch.quantile(some, q, dim=1))


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 1, 3, 8])
def test_the_mask_lies_between_its_floor_and_one_and_is_zero_on_given_frames(combine: str, given: int) -> None:
    settings = MaskSettings(m_min=0.3, combine=combine)  # type: ignore[arg-type]
    mask = dynamic_mask(randn(*BIG), given, settings)
    assert mask.shape == (2, 1, 8, 16, 16) and not mask.requires_grad
    assert not mask[:, :, :given].any()
    if given < 8:
        generated = mask[:, :, given:]
        assert float(generated.min()) >= 0.3 - 1e-7 and float(generated.max()) == pytest.approx(1.0, abs=1e-6)
        assert float(generated.max()) <= 1.0


def test_every_channel_of_a_cell_has_the_same_deviation() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    law = step(x, v, times(0.8, 0.8), times(0.5, 0.5), StepContext(x[:, :, :1], 0.9), SamplerSettings())
    assert law.std.shape == law.mask.shape == (2, 1, 8, 16, 16)
    assert law.std[:, :, 1:].unique().numel() > 10


@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize("budget", ["literal", "rms", "peak"])
def test_a_still_video_and_one_that_only_brightens_explore_everywhere(given: int, budget: str) -> None:
    settings = MaskSettings(budget=budget)  # type: ignore[arg-type]
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
    settings = MaskSettings(combine=combine)  # type: ignore[arg-type]
    x0 = randn(*BIG, seed=8)
    mask = dynamic_mask(x0, given, settings)
    close = {"atol": 1e-5, "rtol": 0.0}
    assert_close(dynamic_mask(x0 + randn(2, 4, 1, 16, 16, seed=9), given, settings), mask, **close)
    assert_close(dynamic_mask(7.5 * x0, given, settings), mask, **close)
    assert_close(dynamic_mask(x0.flip(3), given, settings), mask.flip(3), **close)
    assert_close(dynamic_mask(x0.flip(4), given, settings), mask.flip(4), **close)
    assert_close(dynamic_mask(x0.roll((3, 5), (3, 4)), given, settings), mask.roll((3, 5), (3, 4)), **close)


@pytest.mark.parametrize("combine", ["gated", "sparse", "max"])
@pytest.mark.parametrize("given", [0, 1])
def test_a_moving_blob_is_explored_at_least_1_8_times_as_much_as_its_still_surroundings(
    combine: str, given: int
) -> None:
    """From the exact clean estimate."""
    x0, inside = moving_blob()
    mask = dynamic_mask(x0, given, MaskSettings(combine=combine))[0, 0, given:]  # type: ignore[arg-type]
    assert float(mask[inside[given:]].mean()) >= 1.8 * float(mask[~inside[given:]].mean())


def test_frames_without_any_motion_are_not_dynamic_even_when_most_frames_have_none() -> None:
    """Ties at zero: 4 of 5 frames do not change, so the 0.8 quantile of the intensity is 0."""
    x0 = randn(1, 1, 1, 8, 8, seed=4).repeat(1, 1, 10, 1, 1)
    x0[:, :, 9] = x0[:, :, 9].roll(1, 2)
    mask = dynamic_mask(x0, 0, MaskSettings(combine="sparse"))
    assert bool((mask[:, :, :9] == 0.2).all()), "a frame that does not move explores at the floor"
    assert float(mask[:, :, 9].max()) == 1.0


@pytest.mark.parametrize("arm", ["dyndiff"])
def test_what_a_network_says_about_given_frames_does_not_change_the_mask(arm: str) -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    context = StepContext(randn(2, 4, 2, 16, 16, seed=3), 0.9)
    t, s = times(0.8, 0.4), times(0.5, 0.1)
    plain = step(x, v, t, s, context, SamplerSettings(arm))  # type: ignore[arg-type]
    shouting = v.clone()
    shouting[:, :, :2] = 1e3 * randn(2, 4, 2, 16, 16, seed=4)
    assert torch.equal(step(x, shouting, t, s, context, SamplerSettings(arm)).mask, plain.mask)  # type: ignore[arg-type]
    shouting[:, :, 2:] *= 1.5
    assert not torch.equal(step(x, shouting, t, s, context, SamplerSettings(arm)).mask, plain.mask)  # type: ignore[arg-type]


def test_the_first_generated_frame_is_compared_with_the_clean_given_one() -> None:
    """A video that stands still from its given frame on is still, whatever noise the given frame had."""
    clean = randn(1, 2, 4, 8, 8, seed=1)[:, :, :1].expand(1, 2, 4, 8, 8)
    t, x = times(0.5), 0.5 * clean + 0.5 * randn(1, 2, 4, 8, 8, seed=2)
    v = (x - clean) / 0.5
    v[:, :, 0] = 50.0
    mask = step(x, v, t, times(0.4), StepContext(clean[:, :, :1], 0.9), SamplerSettings()).mask
    assert float(mask[:, :, 1:].mean()) > 0.2
    law = step(
        x.double(),
        ((x - clean) / 0.5).double(),
        t,
        times(0.4),
        StepContext(clean[:, :, :1].double(), 0.9),
        SamplerSettings(),
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


@pytest.mark.parametrize("name", ["m_min", "quantile", "convex_share"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_a_share_outside_zero_to_one_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name} must be in .*got {value}"):
        MaskSettings(**{name: value})


def test_a_floor_of_zero_is_refused_because_a_cell_without_noise_has_no_density() -> None:
    with pytest.raises(ValueError, match="m_min must be"):
        MaskSettings(m_min=0.0)


def test_above_its_time_limit_the_mask_is_one() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    settings = SamplerSettings(mask=MaskSettings(time_limit=0.95))
    mask = step(x, v, times(0.96, 0.95), times(0.5, 0.5), StepContext(x[:, :, :1], 0.9), settings).mask
    assert bool((mask[0, :, 1:] == 1).all()) and not mask[0, :, :1].any() and float(mask[1, :, 1:].min()) < 0.3


def test_a_mask_kept_in_half_precision_is_rounded_before_it_is_used() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    context, t, s = StepContext(x[:, :, :1], 0.9), times(0.8, 0.8), times(0.5, 0.5)
    law = step(x, v, t, s, context, SamplerSettings(mask_dtype="float16"))
    assert torch.equal(law.mask, law.mask.half().float())
    again = step(x, v, t, s, replace(context, mask=law.mask.half()), SamplerSettings(mask_dtype="float16"))
    assert torch.equal(again.std, law.std) and torch.equal(again.mean, law.mean)


# budget


@pytest.mark.parametrize("combine", COMBINES)
@pytest.mark.parametrize("given", [0, 2])
def test_an_rms_budget_gives_the_generated_cells_a_mean_square_of_one(combine: str, given: int) -> None:
    """The cell ratios stay those of the literal mask."""
    x0 = randn(*BIG, seed=8)
    literal = dynamic_mask(x0, given, MaskSettings(combine=combine))[:, :, given:]  # type: ignore[arg-type]
    mask = dynamic_mask(x0, given, MaskSettings(combine=combine, budget="rms"))[:, :, given:]  # type: ignore[arg-type]
    assert_close(mask.square().mean((1, 2, 3, 4)).sqrt(), torch.ones(2), atol=1e-6, rtol=0)
    assert_close(mask / mask.amax(), literal / mask.amax() * (mask.amax() / literal.amax()), rtol=2e-2, atol=0)
    assert float(literal.square().mean()) < 0.5, "the literal mask always spends less"


def test_an_rms_budget_spends_the_noise_of_coefficient_preserving_sampling() -> None:
    """On a step of eta 0.3, where no cell is clamped."""
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    context = StepContext(x[:, :, :1], 0.9)
    t, s = times(0.8, 0.8), times(0.5, 0.5)
    masked = step(x, v, t, s, context, SamplerSettings("dyndiff", 0.2, mask=MaskSettings(budget="rms")))
    plain = step(x, v, t, s, context, SamplerSettings("cps", 0.2))
    assert float(masked.mask.max()) > 1 and float(masked.std.max()) < 0.999 * 0.5
    assert_close(masked.std.square().mean((1, 2, 3, 4)), plain.std.square().mean((1, 2, 3, 4)), rtol=1e-5, atol=0)


def test_a_budget_that_asks_for_more_noise_than_there_is_is_clamped() -> None:
    x, v = randn(*BIG, seed=1), randn(*BIG, seed=2)
    settings = SamplerSettings("dyndiff", 0.9, mask=MaskSettings(budget="rms"))
    law = step(x, v, times(0.8, 0.8), times(0.5, 0.5), StepContext(x[:, :, :1], 0.9), settings)
    assert float(law.std.max()) == pytest.approx(SIGMA_LIMIT * 0.5) and bool(torch.isfinite(law.mean).all())


def test_a_peak_budget_gives_dynamic_cells_the_noise_of_coefficient_preserving_sampling() -> None:
    x0, _ = moving_blob()
    sparse = dynamic_mask(x0, 0, MaskSettings(combine="sparse", budget="peak"))
    assert float(sparse.max()) == pytest.approx(1.0) and float(sparse.min()) == pytest.approx(0.2)
    gated, literal = (dynamic_mask(x0, 0, MaskSettings(budget=budget)) for budget in ("peak", "literal"))  # type: ignore[arg-type]
    dynamic = sparse > 0.5
    assert float(gated[dynamic].square().mean()) == pytest.approx(1.0, rel=1e-5)
    assert float(literal[dynamic].square().mean()) < 0.95


# why the mask is cached


@pytest.mark.parametrize(("source", "low", "high"), [("recompute", 0.5, 1.0), ("cached", 0.0, 0.1)])
@pytest.mark.parametrize("combine", ["gated", "sparse"])
def test_a_recomputed_mask_throws_most_ratios_out_of_the_clip_range_and_a_cached_one_few(
    source: str, low: float, high: float, combine: str
) -> None:
    """The velocity changes by 1e-3 at random, t >= 0.5, D = 8192."""
    shape = (1, 33, 16, 16)
    settings = toy_rollout_settings(num_steps=10, mask=MaskSettings(combine=combine))  # type: ignore[arg-type]
    change = [0.0]
    model = Analytic(lambda x, t: torch.sin(x.roll(1, 3)) + 0.3 * x + change[0] * randn(*shape, seed=11))
    buffer = toy_buffer(model, settings, groups=2, size=4, shape=shape, given=1)
    change[0] = 1e-3
    grpo = grpo_config(
        mask_source=source, step_select="tmin", step_fraction=0.5, updates_per_buffer=1, kl=kl_config("none"),  # type: ignore[arg-type]
        learning_rate=0.0,
    )
    report = GrpoLearner(model, grpo, settings, seed=0).train(buffer).updates[0]
    assert report.transitions == 8 * sum(float(t) >= 0.5 for t in settings.times[:9])
    assert low <= report.clip_low_share + report.clip_high_share <= high


@pytest.mark.parametrize("mask_on", ["std", "var", "eta"])
@pytest.mark.parametrize("budget", ["literal", "rms"])
def test_a_recomputed_mask_of_unchanged_weights_leaves_the_ratio_at_one(mask_on: str, budget: str) -> None:
    settings = toy_rollout_settings(eta=0.8, mask_on=mask_on, mask=MaskSettings(budget=budget))  # type: ignore[arg-type]
    model = Analytic(lambda x, t: torch.sin(x.roll(1, 3)) + 0.3 * x)
    buffer = toy_buffer(model, settings)
    grpo = grpo_config(mask_source="recompute", updates_per_buffer=1, learning_rate=0.0)
    report = GrpoLearner(model, grpo, settings, seed=0).train(buffer).updates[0]
    assert report.ratio_mean == pytest.approx(1.0, abs=1e-6) and report.kl < 1e-12


@pytest.mark.parametrize("mask_on", ["std", "var", "eta"])
@pytest.mark.parametrize("budget", ["literal", "rms"])
def test_a_recomputed_ratio_and_kl_are_those_of_the_two_normal_distributions(mask_on: str, budget: str) -> None:
    """The old density has the cached mask, the new one its own; the KL is DD-17 with the anchor's deviation."""
    settings = toy_rollout_settings(num_steps=2, shift=1.0, eta=0.8, mask_on=mask_on, mask=MaskSettings(budget=budget))  # type: ignore[arg-type]
    speed = [0.3]
    model = Analytic(lambda x, t: torch.sin(x.roll(1, 3)) + speed[0] * x)
    buffer = toy_buffer(model, settings, groups=1, size=2)
    t, s = times(1.0, 1.0), times(0.5, 0.5)
    x_t, x_s = buffer.rollout.states[:, 0], buffer.rollout.states[:, 1]
    context = StepContext(buffer.condition.frames, 0.5)
    laws = []
    for value in (0.3, 0.32):
        speed[0] = value
        laws.append(step(x_t, model(x_t, t, buffer.condition).detach(), t, s, context, settings.sampler))
    logps, gap = [], (laws[0].mean - laws[1].mean)[:, :, 1:]
    for law in laws:
        std = law.std[:, :, 1:].expand_as(gap)
        logps.append(torch.distributions.Normal(law.mean[:, :, 1:], std).log_prob(x_s[:, :, 1:]).mean((1, 2, 3, 4)))
    grpo = grpo_config(mask_source="recompute", updates_per_buffer=1, learning_rate=0.0, step_fraction=1.0)
    report = GrpoLearner(model, grpo, settings, seed=0).train(buffer).updates[0]
    assert report.ratio_mean == pytest.approx(float((logps[1] - logps[0]).exp().mean()), rel=1e-4)
    assert report.kl == pytest.approx(float((gap / laws[0].std[:, :, 1:]).square().mean() / 2), rel=1e-3)


def test_given_frames_do_not_enter_the_intensity_or_its_quantile() -> None:
    """A wild change inside the given frames must not dim the generated ones."""
    x0 = randn(1, 2, 6, 8, 8, seed=4)
    wild = x0.clone()
    wild[:, :, 0] *= 100
    assert torch.equal(dynamic_mask(x0, 2, PAPER), dynamic_mask(wild, 2, PAPER))
    assert toy_condition(1).num_conditioning == 1
