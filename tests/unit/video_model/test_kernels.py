"""Times and one step of every sampler: limits, hand-worked noise powers, each repository's own form. Ids: spec 4.1."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from video_toys import (
    Analytic,
    mask_config,
    randn,
    rollout_config,
    sampler_config,
    swirl,
    times,
    times_of,
    tiny_network,
    towards,
    toy_condition,
    toy_rollout_settings,
)

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import RolloutConfig
from wm_nodes.video_model import StepContext, flow_times, initial_noise, sample_videos, select_steps, step
from wm_nodes.video_model.kernels import SIGMA_LIMIT, estimates, sage_variance, with_conditioning

BIG = (1, 4, 8, 16, 16)
"""D = 8192."""
PAIRS = [(1.0, 0.9), (0.9, 0.5), (0.5, 0.4), (0.3, 0.02), (0.2, 0.0), (1.0, 0.0)]
NOISY = ["cps", "dyndiff", "flow", "dance", "sage"]


def nothing_given(x: Tensor, **changes: object) -> StepContext:
    return replace(StepContext(x[:, :, :0], first_time=0.9), **changes)  # type: ignore[arg-type]


def cells(shape: tuple[int, ...] = BIG) -> tuple[Tensor, Tensor]:
    return randn(*shape, seed=1), randn(*shape, seed=2)


# times


def test_without_a_shift_the_times_are_equally_spaced_and_a_shift_of_3_lifts_one_half_to_three_quarters() -> None:
    assert_close(flow_times(4), times(1, 0.75, 0.5, 0.25, 0))
    assert_close(flow_times(2, 3.0), times(1, 0.75, 0))


@pytest.mark.parametrize("shift", [1.0, 3.0, 5.0])
def test_times_fall_from_exactly_one_to_exactly_zero_for_every_number_of_steps(shift: float) -> None:
    for num_steps in range(1, 51):
        found = flow_times(num_steps, shift)
        assert found.dtype == torch.float64 and found.shape == (num_steps + 1,)
        assert found[0] == 1 and found[-1] == 0 and bool((found[1:] < found[:-1]).all())


@pytest.mark.parametrize(
    ("setting", "value"),
    [("rollout.num_steps", 0), ("rollout.shift", 0.0), ("grpo.advantage.best_of_n", -1), ("evaluation.window", 2)],
)
def test_numbers_that_no_formula_takes_are_refused_where_they_are_set(setting: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{setting}.*{value}"):
        load_video_config("base", {setting: value})


# algebra of one step


@pytest.mark.parametrize("t", [1.0, 0.7, 0.2, 0.01])
def test_clean_and_noise_estimate_mix_back_to_the_state(t: float) -> None:
    x, v = cells()
    x0, eps = estimates(x, v, times(t))
    assert_close((1 - t) * x0 + t * eps, x, atol=1e-6, rtol=0)
    assert_close(eps - x0, v, atol=1e-6, rtol=0)


@pytest.mark.parametrize("arm", NOISY)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_without_noise_every_arm_takes_the_euler_step(arm: str, dtype: torch.dtype, tolerance: float) -> None:
    """Values stay within [-1, 1], where the tolerance is a few units in the last place."""
    x, v = torch.tanh(randn(*BIG, seed=1, dtype=dtype)), torch.tanh(randn(*BIG, seed=2, dtype=dtype))
    for t, s in PAIRS:
        law = step(x, v, times(t), times(s), nothing_given(x), sampler_config(arm, eta=0.0))  # type: ignore[arg-type]
        assert_close(law.mean, x + (s - t) * v, atol=tolerance, rtol=0)
        assert not law.std.any()


def test_the_ode_arm_equals_every_arm_without_noise_and_has_no_spread() -> None:
    x, v = cells()
    law = step(x, v, times(0.5), times(0.4), nothing_given(x), sampler_config("ode"))
    assert_close(law.mean, x - 0.1 * v, atol=1e-6, rtol=0)
    assert not law.std.any()


def test_at_full_noise_only_the_clean_estimate_survives_a_step() -> None:
    """(x, v) and (x + a, v + a / t) have one clean estimate, so they share x_s for the same noise."""
    x, v, z = randn(*BIG, seed=1), randn(*BIG, seed=2), randn(*BIG, seed=3)
    a = 0.5 * randn(*BIG, seed=4)
    for t, s in [(0.9, 0.5), (0.5, 0.4), (0.8, 0.1)]:
        settings, context = sampler_config("cps", eta=1.0), nothing_given(x)
        one = step(x, v, times(t), times(s), context, settings)
        two = step(x + a, v + a / t, times(t), times(s), context, settings)
        assert_close(one.mean + one.std * z, two.mean + two.std * z, atol=1e-6, rtol=1e-6)
        assert_close(one.std, torch.full_like(one.std, s))
    half = sampler_config("cps", eta=0.5)
    apart = step(x, v, times(0.5), times(0.4), context, half).mean
    assert not torch.allclose(apart, step(x + a, v + a / 0.5, times(0.5), times(0.4), context, half).mean, atol=1e-2)


def test_kept_and_fresh_noise_have_the_power_of_s_in_every_cell_for_any_mask() -> None:
    """The kept coefficient is read off the mean: (mean - (1 - s) x0) / eps."""
    x, v = cells()
    mask = torch.rand(1, 1, *BIG[2:], generator=torch.Generator().manual_seed(0))
    mask[0, 0, 0, 0, :2] = torch.tensor([0.0, 1.0])
    for eta in (0.0, 0.3, 0.6, 1.0):
        settings = sampler_config("dyndiff", eta)
        for t, s in [(0.9, 0.5), (0.5, 0.4)]:
            x64, v64 = x.double(), v.double()
            law = step(x64, v64, times(t), times(s), nothing_given(x, mask=mask), settings)
            x0, eps = estimates(x64, v64, times(t))
            kept = (law.mean - (1 - s) * x0) / eps
            assert_close(kept.square() + law.std.square(), torch.full_like(kept, s * s), rtol=1e-6, atol=0)
            law32 = step(x, v, times(t), times(s), nothing_given(x, mask=mask), settings)
            kept32 = (s * s - law32.std.double().square()).clamp_min(0).sqrt()
            assert_close(law32.mean.double(), (1 - s) * x0 + kept32 * eps, rtol=1e-5, atol=2e-4 if eta == 1 else 2e-6)


def test_a_mask_of_one_fifth_scales_the_deviation() -> None:
    """DD-5 at eta = 0.6: 0.162 s."""
    x, v = cells((1, 1, 2, 2, 2))
    settings = sampler_config("dyndiff", 0.6)
    law = step(x, v, times(0.8), times(0.5), nothing_given(x, mask=torch.full((1, 1, 2, 2, 2), 0.2)), settings)
    assert_close(law.std, torch.full((1, 1, 2, 2, 2), 0.5 * 0.2 * 0.80902), rtol=1e-4, atol=0)


def test_a_mask_above_one_never_takes_all_of_the_noise() -> None:
    x, v = cells((1, 1, 2, 2, 2))
    settings = sampler_config("dyndiff", 0.9)
    law = step(x, v, times(0.8), times(0.5), nothing_given(x, mask=torch.full((1, 1, 2, 2, 2), 7.0)), settings)
    assert_close(law.std, torch.full((1, 1, 2, 2, 2), 0.5 * SIGMA_LIMIT))


# noise power with an exact model


@pytest.mark.parametrize(
    ("arm", "eta", "excess"),
    [("cps", 0.6, 0.0), ("flow", 0.7, 0.01220), ("sage", 0.7, 0.00969), ("dance", 0.25, 0.00129)],
)
def test_a_preserving_step_keeps_the_noise_power_and_an_euler_sde_step_exceeds_it_by_the_known_amount(
    arm: str, eta: float, excess: float
) -> None:
    """Exactly: all data is 0, x = t eps, v = eps; t = 0.5, s = 0.4. DD-21."""
    eps = torch.ones(1, 1, 2, 1, 1, dtype=torch.float64)
    settings = sampler_config(arm, eta)  # type: ignore[arg-type]
    law = step(0.5 * eps, eps, times(0.5), times(0.4), nothing_given(eps), settings)
    power = float(law.mean[0, 0, 0, 0, 0]) ** 2 + float(law.std[0, 0, 0, 0, 0]) ** 2
    assert power == pytest.approx(0.16 + excess, abs=6e-6)


@pytest.mark.parametrize(("arm", "eta"), [("cps", 0.6), ("dyndiff", 0.6), ("flow", 0.7), ("sage", 0.7), ("dance", 0.6)])
def test_the_variance_of_400_000_sampled_cells_is_the_predicted_one(arm: str, eta: float) -> None:
    """Sampled; the masked arm keeps it in every cell because its two coefficients do."""
    shape, t, s = (1, 1, 10, 200, 200), 0.5, 0.4
    eps, z = randn(*shape, seed=1), randn(*shape, seed=2)
    mask = 0.2 + 0.8 * torch.rand(shape, generator=torch.Generator().manual_seed(3))
    settings = sampler_config(arm, eta)  # type: ignore[arg-type]
    law = step(t * eps, eps, times(t), times(s), nothing_given(eps, mask=mask if arm == "dyndiff" else None), settings)
    variance = float(law.std.max()) ** 2
    excess = 0.0 if arm in ("cps", "dyndiff") else variance * (1 - s / t) + variance**2 / (4 * t * t)
    assert float((law.mean + law.std * z).var()) == pytest.approx(s * s + excess, rel=0.01)
    assert arm not in ("flow", "sage", "dance") or excess > 0.03 * s * s, "or the check could not fail"


# the baselines in their own words


def flow_grpo(x: Tensor, v: Tensor, t: float, s: float, level: float, first: float) -> tuple[Tensor, float]:
    """sd3_sde_with_logprob of yifan123/flow_grpo."""
    dt = s - t
    deviation = math.sqrt(t / (1 - (first if t == 1 else t))) * level
    mean = x * (1 + deviation**2 / (2 * t) * dt) + v * (1 + deviation**2 * (1 - t) / (2 * t)) * dt
    return mean, deviation * math.sqrt(-dt)


def dance_grpo(x: Tensor, v: Tensor, t: float, s: float, level: float, first: float) -> tuple[Tensor, float]:
    """flux_step of XueZeyue/DanceGRPO: the drift is the score of the clean estimate."""
    clean = x - t * v
    score = -(x - clean * (1 - t)) / t**2
    return x + (s - t) * v - 0.5 * level**2 * score * (s - t), level * math.sqrt(t - s)


def sage_grpo(x: Tensor, v: Tensor, t: float, s: float, level: float, first: float) -> tuple[Tensor, float]:
    variance = level**2 * (math.log((1 - s) / (1 - min(t, 0.997))) - (t - s))
    mean = (1 - variance / (2 * t)) * x + ((s - t) - variance * (1 - t) / (2 * t)) * v
    return mean, math.sqrt(variance)


@pytest.mark.parametrize(
    ("arm", "own", "eta"), [("flow", flow_grpo, 0.7), ("dance", dance_grpo, 0.3), ("sage", sage_grpo, 0.5)]
)
@pytest.mark.parametrize(("t", "s"), [(1.0, 0.9), (0.9, 0.5), (0.5, 0.4), (0.3, 0.05)])
def test_the_common_euler_sde_form_equals_the_repository_s_own(
    arm: str, own: object, eta: float, t: float, s: float
) -> None:
    x, v = cells()
    mean, std = own(x.double(), v.double(), t, s, eta, 0.9)  # type: ignore[operator]
    law = step(x, v, times(t), times(s), nothing_given(x), sampler_config(arm, eta))  # type: ignore[arg-type]
    assert_close(law.mean.double(), mean, atol=2e-6, rtol=0)
    assert_close(law.std.double(), torch.full_like(law.std.double(), std), rtol=2e-6, atol=0)


@pytest.mark.parametrize(("t", "s"), [(0.997, 0.9), (0.9, 0.5), (0.5, 0.4), (0.3, 0.01)])
def test_the_variance_of_sage_is_the_integral_of_its_diffusion(t: float, s: float) -> None:
    nodes, quadrature = np.polynomial.legendre.leggauss(200)
    tau = (t - s) / 2 * nodes + (t + s) / 2
    integral = 0.5**2 * float((quadrature * tau / (1 - tau)).sum()) * (t - s) / 2
    x = torch.zeros(1, 1, 1, 1, 1, dtype=torch.float64)
    law = step(x, x, times(t), times(s), nothing_given(x), sampler_config("sage", 0.5))
    assert float(law.std.square()) == pytest.approx(integral, rel=1e-6)


# what carries gradient


@pytest.mark.parametrize("arm", ["ode", *NOISY])
@pytest.mark.parametrize("given", [0, 1])
def test_only_the_mean_carries_gradient_and_its_slope_in_v_is_the_closed_form(arm: str, given: int) -> None:
    x, v = randn(2, 3, 4, 5, 7, seed=1), randn(2, 3, 4, 5, 7, seed=2).requires_grad_()
    context = StepContext(randn(2, 3, given, 5, 7, seed=3), first_time=0.9)
    t, s = times(1.0, 0.4), times(0.9, 0.1)
    law = step(x, v, t, s, context, sampler_config(arm))  # type: ignore[arg-type]
    for name in ("std", "mask"):
        assert not getattr(law, name).requires_grad, name
    (gradient,) = torch.autograd.grad(law.mean.sum(), v)
    generated = slice(given, None)
    if arm in ("cps", "dyndiff"):
        rows_t, rows_s = t.view(-1, 1, 1, 1, 1), s.view(-1, 1, 1, 1, 1)
        kept = (rows_s.square() - law.std.double().square()).clamp_min(0).sqrt()
        closed = -(1 - rows_s) * rows_t + (1 - rows_t) * kept
        assert_close(gradient.double()[:, :, generated], closed.expand_as(x)[:, :, generated], rtol=1e-5, atol=1e-6)


def test_at_full_noise_the_gradient_stays_finite() -> None:
    """sqrt(s^2 - sigma^2) has an infinite slope at sigma = s."""
    x, v = randn(1, 1, 3, 4, 4, seed=1), randn(1, 1, 3, 4, 4, seed=2).requires_grad_()
    law = step(x, v, times(0.8), times(0.5), nothing_given(x), sampler_config("dyndiff", 1.0))
    (gradient,) = torch.autograd.grad(law.mean.sum(), v)
    assert bool(torch.isfinite(gradient).all())


# whole samplings


def sampled(settings: RolloutConfig, shape: tuple[int, int, int, int] = (2, 3, 4, 4), given: int = 1, count: int = 1):  # type: ignore[no-untyped-def]
    seeds = torch.arange(count)
    return sample_videos(
        Analytic(swirl), toy_condition(count, shape, given), initial_noise(shape, seeds), seeds, settings
    )


def assert_finite_and_trainable(settings: RolloutConfig) -> None:
    rollout = sampled(settings)
    T = settings.num_steps
    assert T - 1 not in rollout.steps and bool(torch.isfinite(rollout.latents).all())
    assert rollout.zeta is not None and bool(torch.isfinite(rollout.zeta).all())
    assert rollout.steps == tuple(range(T - 1))
    if T > 1:
        chosen = select_steps(len(rollout.steps), 1, fraction=1.0, seed=0, iteration=0)
        assert chosen.shape == (1, T - 1), "every step but the last"
        assert bool((times_of(settings)[torch.tensor(rollout.steps) + 1] > 0).all())


@pytest.mark.parametrize(("shift", "m_min"), [(1.0, 0.05), (3.0, 0.2), (5.0, 1.0)])
def test_every_number_of_steps_from_1_to_50_samples_finite_videos_and_never_trains_the_last_step(
    shift: float, m_min: float
) -> None:
    for num_steps in range(1, 51):
        mask = mask_config(m_min=m_min)
        assert_finite_and_trainable(toy_rollout_settings(num_steps=num_steps, shift=shift, mask=mask))


@pytest.mark.parametrize("arm", NOISY)
@pytest.mark.parametrize("shift", [1.0, 3.0, 5.0])
def test_every_arm_samples_finite_videos_from_few_steps_to_many(arm: str, shift: float) -> None:
    for num_steps in (1, 2, 3, 10, 50):
        assert_finite_and_trainable(toy_rollout_settings(num_steps=num_steps, shift=shift, arm=arm))


@pytest.mark.parametrize("shift", [1.0, 3.0, 5.0])
@pytest.mark.parametrize("m_min", [0.05, 0.2, 0.5, 1.0])
def test_every_shift_and_floor_of_the_mask_samples_finite_videos(shift: float, m_min: float) -> None:
    for num_steps in (1, 2, 3, 16, 50):
        mask = mask_config(m_min=m_min)
        assert_finite_and_trainable(toy_rollout_settings(num_steps=num_steps, shift=shift, mask=mask))


@pytest.mark.parametrize("combine", ["gated", "sparse"])
@pytest.mark.parametrize("given", [0, 1])
def test_a_mask_floor_of_one_is_coefficient_preserving_sampling_bit_for_bit(combine: str, given: int) -> None:
    mask = mask_config(m_min=1.0, combine=combine)  # type: ignore[arg-type]
    masked = sampled(toy_rollout_settings(arm="dyndiff", mask=mask), given=given, count=3)
    plain = sampled(toy_rollout_settings(arm="cps"), given=given, count=3)
    for name in ("latents", "states", "mask", "zeta", "noise_share"):
        assert torch.equal(getattr(masked, name), getattr(plain, name)), name
    lower = sampled(toy_rollout_settings(arm="dyndiff", mask=mask.with_values(m_min=0.5)), given=given, count=3)
    assert not torch.equal(lower.latents, plain.latents)


# contracts


@pytest.mark.parametrize("arm", ["cps", "dyndiff"])
@pytest.mark.parametrize("eta", [1.2, 1.8])
def test_a_noise_level_at_which_the_sine_map_folds_is_refused(arm: str, eta: float) -> None:
    with pytest.raises(ValueError, match=rf"eta must be in \[0, 1\] for {arm}, got {eta}"):
        sampler_config(arm, eta)  # type: ignore[arg-type]


@pytest.mark.parametrize(("shift", "most"), [(5.0, 67), (3.0, 111), (1.0, 332)])
def test_a_schedule_whose_first_step_by_sage_has_no_noise_is_refused_by_its_numbers(shift: float, most: int) -> None:
    sage = sampler_config("sage", 0.5)
    times = flow_times(rollout_config(num_steps=most, shift=shift, sampler=sage).num_steps, shift)
    assert sage_variance(times[:1], times[1:2], 0.25, 0.0) > 0
    times = flow_times(most + 1, shift)
    assert sage_variance(times[:1], times[1:2], 0.25, 0.0) == 0
    words = f"arm sage has no noise with num_steps {most + 1} and shift {shift:g},.*lower num_steps or shift"
    with pytest.raises(ValueError, match=words):
        rollout_config(num_steps=most + 1, shift=shift, sampler=sage)


def test_the_euler_sde_arms_take_a_noise_level_above_one_and_an_unknown_arm_is_named() -> None:
    assert sampler_config("flow", 1.2).eta == 1.2
    with pytest.raises(ValueError, match=r"arm\n.*'ode', 'cps', 'dyndiff', 'flow', 'dance' or 'sage'"):
        sampler_config("ddpm")  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [(1, 2, 3, 4, 4), (1, 1, 2, 4, 4), (1, 1, 3, 4, 5), (2, 1, 3, 4, 4)])
def test_a_cached_mask_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    x, v = cells((1, 2, 3, 4, 4))
    with pytest.raises(ValueError, match=r"mask must be \(1, 1, 3, 4, 4\) for latents \(1, 2, 3, 4, 4\), got"):
        step(x, v, times(0.8), times(0.5), nothing_given(x, mask=torch.ones(shape)), sampler_config())


@pytest.mark.parametrize("shape", [(3, 1, 1, 1), (1, 1, 5, 7), (3, 5, 3, 7), (1, 2, 1, 3)])
@pytest.mark.parametrize("given", [0, 1, "all"])
@pytest.mark.parametrize("arm", ["ode", *NOISY])
def test_odd_and_single_sizes_sample_and_given_frames_stay_as_given(
    shape: tuple[int, int, int, int], given: int | str, arm: str
) -> None:
    K = shape[1] if given == "all" else int(given)
    settings = toy_rollout_settings(num_steps=3, arm=arm)
    rollout, condition = sampled(settings, shape, K, count=2), toy_condition(2, shape, K)
    assert rollout.latents.shape == (2, *shape)
    assert torch.equal(rollout.latents[:, :, :K], condition.frames)
    for index in range(len(rollout.state_steps)):
        assert torch.equal(rollout.states[:, index, :, :K], condition.frames)
    assert bool(torch.isfinite(rollout.latents).all()) and bool(torch.isfinite(rollout.noise_share).all())
    if arm != "ode":
        assert rollout.mask.shape == (2, 2, 1, *shape[1:]) and not rollout.mask[:, :, :, :K].any()
        assert rollout.zeta is not None and rollout.zeta.shape == (2, 2, shape[0], shape[1] - K, *shape[2:])


def test_given_frames_have_no_noise_in_any_arm() -> None:
    x, v = cells((1, 2, 3, 4, 4))
    context = StepContext(randn(1, 2, 2, 4, 4), first_time=0.9)
    for arm in NOISY:
        law = step(x, v, times(0.8), times(0.5), context, sampler_config(arm))  # type: ignore[arg-type]
        assert not law.std[:, :, :2].any() and bool((law.std[:, :, 2:] > 0).all()), arm
    assert torch.equal(with_conditioning(x, context.conditioning)[:, :, :2], context.conditioning)
    assert torch.equal(with_conditioning(x, context.conditioning)[:, :, 2:], x[:, :, 2:])


@pytest.mark.parametrize("arm", ["cps", "dyndiff"])
def test_an_exact_model_reaches_its_data_whatever_the_noise(arm: str) -> None:
    clean = randn(1, 2, 3, 4, 4, seed=9)
    settings, seeds = toy_rollout_settings(num_steps=7, arm=arm), torch.tensor([4])
    condition = toy_condition(1, (2, 3, 4, 4), given=0)
    rollout = sample_videos(Analytic(towards(clean)), condition, initial_noise((2, 3, 4, 4), seeds), seeds, settings)
    assert_close(rollout.latents, clean, atol=1e-5, rtol=0)


def test_the_last_step_cannot_be_asked_to_be_stochastic_and_an_empty_list_is_the_ode() -> None:
    settings, seeds, shape = toy_rollout_settings(num_steps=4), torch.tensor([4]), (2, 3, 4, 4)
    condition, noise, model = toy_condition(1, shape), initial_noise(shape, seeds), Analytic(swirl)
    with pytest.raises(ValueError, match=r"steps \[3\] cannot be stochastic; of 4 steps .* 0 to 2, can"):
        sample_videos(model, condition, noise, seeds, settings, [1, 3])
    plain = sample_videos(model, condition, noise, seeds, settings, [])
    ode = sample_videos(model, condition, noise, seeds, toy_rollout_settings(num_steps=4, arm="ode"))
    assert torch.equal(plain.latents, ode.latents) and plain.steps == ode.steps == ()


def test_a_window_keeps_the_states_on_both_sides_of_each_of_its_steps() -> None:
    settings, seeds, shape = toy_rollout_settings(num_steps=6), torch.tensor([4, 5]), (2, 3, 4, 4)
    condition, noise = toy_condition(2, shape), initial_noise(shape, seeds)
    rollout = sample_videos(Analytic(swirl), condition, noise, seeds, settings, [3, 1])
    assert rollout.steps == (1, 3) and rollout.state_steps == (1, 2, 3, 4)
    assert rollout.mask.shape[:2] == (2, 2)
    x_t, x_s = rollout.state(3), rollout.state(4)
    t, s = (times_of(settings)[k].expand(2) for k in (3, 4))
    context = StepContext(condition.frames, float(times_of(settings)[1]))
    law = step(x_t, Analytic(swirl)(x_t, t, condition), t, s, context, settings.sampler)
    assert rollout.zeta is not None
    assert_close((x_s - law.mean)[:, :, 1:], law.std[:, :, 1:] * rollout.zeta[:, 1])


def test_a_video_does_not_depend_on_the_batch_it_is_sampled_in() -> None:
    small, large = (sampled(toy_rollout_settings(micro_batch=size), count=5) for size in (2, 16))
    assert_close(small.latents, large.latents)
    assert_close(small.noise_share, large.noise_share)


def test_equal_initial_noise_with_own_step_noise_gives_different_videos() -> None:
    shape, condition = (2, 3, 4, 4), toy_condition(2, (2, 3, 4, 4)).rows(torch.tensor([0, 0]))
    noise = initial_noise(shape, torch.tensor([7, 7]))
    assert torch.equal(noise[0], noise[1])
    videos = sample_videos(Analytic(swirl), condition, noise, torch.tensor([1, 2]), toy_rollout_settings()).latents
    assert not torch.equal(videos[0, :, 1:], videos[1, :, 1:])


@pytest.mark.parametrize("arm", ["ode", *NOISY])
def test_nothing_of_a_sampling_stays_behind_on_the_cpu(arm: str) -> None:
    """Times are made on the CPU and must follow the state, here to meta, which computes shapes only."""
    network, shape, seeds = tiny_network().to("meta"), (3, 4, 5, 7), torch.arange(2)
    condition = toy_condition(2, shape)
    condition = type(condition)(condition.frames.to("meta"), condition.actions.to("meta"), condition.text.to("meta"))
    rollout = sample_videos(
        network, condition, initial_noise(shape, seeds).to("meta"), seeds, toy_rollout_settings(arm=arm)
    )
    assert rollout.latents.is_meta


def test_the_noise_share_is_the_part_of_the_noise_that_is_fresh() -> None:
    """Coefficient-preserving sampling spends sin(pi eta / 2) = 0.809 on every step, whatever is given."""
    for given in (0, 1):
        found = sampled(toy_rollout_settings(arm="cps", eta=0.6), given=given, count=3).noise_share
        assert_close(found, torch.full((5,), math.sin(0.3 * math.pi)))
