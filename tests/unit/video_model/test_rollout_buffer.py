"""What a rollout keeps: exact means from small storage, one file, refusals. Ids: spec 4.1."""

import json
import math
from dataclasses import fields, replace

import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.testing import assert_close
from video_toys import (
    SHAPE,
    Analytic,
    grpo_config,
    mask_config,
    randn,
    sampler_config,
    swirl,
    times,
    times_of,
    tiny_network,
    toy_buffer,
    toy_condition,
    toy_rollout_settings,
)

from wm_nodes.config.video import RolloutConfig
from wm_nodes.video_model import (
    Condition,
    RolloutBuffer,
    RolloutBufferError,
    StepContext,
    config_hash,
    step,
)
from wm_nodes.video_model.sampling import normalised_noise
from wm_nodes.video_rl.ratio_and_kl import GaussianTransition, GrpoTerms, Rows, log_ratio, mean_kl

WIDE = (8, 5, 16, 16)
"""D = 8192 with one given frame."""


def assert_same(first: RolloutBuffer, second: RolloutBuffer) -> None:
    """Bit for bit, types and shapes included."""
    parts: list[tuple[object, object]] = [
        (first, second),
        (first.rollout, second.rollout),
        (first.condition, second.condition),
    ]
    for one, two in parts:
        for f in fields(one):  # type: ignore[arg-type]
            a, b = getattr(one, f.name), getattr(two, f.name)
            if isinstance(a, Tensor):
                assert a.dtype == b.dtype and torch.equal(a.nan_to_num(7.5), b.nan_to_num(7.5)), f.name
            elif f.name == "rewards":
                assert sorted(a) == sorted(b)
                assert all(torch.equal(a[name].nan_to_num(7.5), b[name].nan_to_num(7.5)) for name in a)
            elif f.name not in ("rollout", "condition"):
                assert a == b, f.name


def first_transition(
    buffer: RolloutBuffer, settings: RolloutConfig, position: int, model: nn.Module
) -> GaussianTransition:
    """What `model` says about stored step `position` of every video."""
    rows = Rows(torch.arange(len(buffer)), torch.full((len(buffer),), position))
    return GrpoTerms(model, grpo_config(), settings, seed=0).transition(model, buffer, rows)


# what gives the mean back


@pytest.mark.parametrize("arm", ["cps", "dyndiff"])
def test_the_stored_noise_gives_the_mean_of_every_step_back(arm: str) -> None:
    """The mean is x_s - sigma zeta."""
    settings, model = toy_rollout_settings(arm=arm), Analytic(swirl)
    buffer = toy_buffer(model, settings, groups=1, size=2, shape=WIDE)
    for position, k in enumerate(buffer.rollout.steps):
        x_t, x_s = buffer.rollout.state(k), buffer.rollout.state(k + 1)
        t, s = times_of(settings)[k].expand(2), times_of(settings)[k + 1].expand(2)
        context = StepContext(buffer.condition.frames, float(times_of(settings)[1]), buffer.rollout.mask[:, position])
        law = step(x_t, model(x_t, t, buffer.condition).detach(), t, s, context, settings.sampler)
        found = x_s[:, :, 1:] - law.std[:, :, 1:] * buffer.rollout.zeta[:, position]
        assert_close(found, law.mean[:, :, 1:], atol=5e-7 * float(x_s.abs().max().clamp_min(1)), rtol=0)


@pytest.mark.parametrize("t", [0.9, 0.5, 0.2])
def test_noise_kept_in_bfloat16_costs_a_kl_below_3e_6_and_a_mean_kept_so_more_than_ten_times_that(t: float) -> None:
    """The noise is that of a step whose end was rounded to bfloat16 first."""
    x, v, z = (randn(1, 8, 4, 16, 16, seed=seed) for seed in (2, 3, 1))
    law = step(x, v, times(t), times(0.8 * t), StepContext(x[:, :, :0], 0.9), sampler_config())
    zeta = normalised_noise((law.mean + law.std * z).bfloat16().float(), law, 0).flatten(1)
    assert float((zeta - z.flatten(1)).abs().max()) > 1e-4, "rounding the state has changed its noise"
    assert float(mean_kl(zeta, zeta.bfloat16().float())) < 3e-6
    off = (law.mean - law.mean.bfloat16().float()) / law.std
    assert float(off.square().mean() / 2) > 3e-5


# bf16 storage


@pytest.mark.parametrize("arm", ["cps", "dyndiff", "flow"])
def test_what_is_stored_in_bfloat16_has_the_noise_it_had_at_rollout(arm: str) -> None:
    """The state is rounded before its density is taken, so training sees the same numbers."""
    settings = toy_rollout_settings(arm=arm, storage_dtype="bfloat16")
    model = tiny_network()
    buffer = toy_buffer(model, settings)
    kept = buffer.rollout
    assert kept.states.dtype == kept.zeta.dtype == torch.bfloat16 and kept.latents.dtype == torch.float32
    buffer = RolloutBuffer.from_bytes(buffer.to_bytes())
    for position in range(len(buffer.rollout.steps)):
        with torch.no_grad():
            new = first_transition(buffer, settings, position, model)
        old = buffer.rollout.zeta[:, position].flatten(1)
        assert torch.equal(new.zeta.bfloat16(), old), "the state was rounded before its noise was"
        unrounded = new.zeta + 2**-9 * randn(*old.shape)
        assert not torch.equal(unrounded.bfloat16(), old), "or the check could not fail"


# reproducible


def test_the_same_seeds_give_the_same_buffer_bit_for_bit_and_others_another() -> None:
    settings, model = toy_rollout_settings(), tiny_network()
    first, second = toy_buffer(model, settings), toy_buffer(model, settings)
    assert_same(first, second)
    assert first.to_bytes() == second.to_bytes()
    assert not torch.equal(first.rollout.latents, toy_buffer(model, settings, iteration=1).rollout.latents)


# files


@pytest.mark.parametrize("storage", ["float32", "bfloat16"])
@pytest.mark.parametrize("given", [0, 1, 4])
def test_a_buffer_survives_its_bytes_bit_for_bit(storage: str, given: int) -> None:
    settings = toy_rollout_settings(storage_dtype=storage)
    buffer = toy_buffer(Analytic(swirl), settings, given=given, version=3, iteration=2)
    rewards = torch.arange(8, dtype=torch.float64)
    rewards[5] = math.nan
    buffer = buffer.with_rewards({"task": rewards, "smooth/ness": -rewards, "total": 2 * rewards})
    again = RolloutBuffer.from_bytes(buffer.to_bytes())
    assert_same(buffer, again)
    assert list(again.rewards) == sorted(again.rewards), "in one order"
    assert again.valid.tolist() == [True] * 5 + [False] + [True] * 2
    assert (again.policy_version, again.iteration, again.rollout.steps) == (3, 2, (0, 1, 2, 3, 4))


@pytest.mark.parametrize("changes", [{"arm": "ode"}, {"num_steps": 1}, {"arm": "cps"}])
def test_a_buffer_of_another_arm_or_without_any_step_survives_its_bytes(changes: dict[str, object]) -> None:
    buffer = toy_buffer(Analytic(swirl), toy_rollout_settings(**changes))
    assert_same(buffer, RolloutBuffer.from_bytes(buffer.to_bytes()))


def test_one_tensor_under_two_names_can_be_written() -> None:
    """A total of one reward is often that reward itself."""
    buffer = toy_buffer(Analytic(swirl), toy_rollout_settings())
    reward = torch.arange(8, dtype=torch.float64)
    again = RolloutBuffer.from_bytes(buffer.with_rewards({"task": reward, "total": reward}).to_bytes())
    assert torch.equal(again.rewards["task"], reward) and torch.equal(again.rewards["total"], reward)
    same = replace(buffer, sample_ids=buffer.group_ids)
    assert torch.equal(RolloutBuffer.from_bytes(same.to_bytes()).sample_ids, buffer.group_ids)


def test_bytes_cut_short_anywhere_are_refused() -> None:
    data = toy_buffer(Analytic(swirl), toy_rollout_settings()).to_bytes()
    for length in (0, 1, 7, 8, 100, len(data) // 2, len(data) - 1):
        with pytest.raises(RolloutBufferError, match=f"these {length} bytes are no complete rollout buffer"):
            RolloutBuffer.from_bytes(data[:length])


def test_other_bytes_and_files_that_lack_a_part_are_refused() -> None:
    for data in (b"x" * 5000, save({"a": torch.zeros(2)}), save({"a": torch.zeros(2)}, {"rollout_buffer": "{}"})):
        with pytest.raises(RolloutBufferError, match="no complete rollout buffer"):
            RolloutBuffer.from_bytes(data)


@pytest.mark.parametrize("name", ["rollout.latents", "rollout.states", "condition.text", "group_ids", "rollout.zeta"])
def test_a_file_that_lacks_one_tensor_is_refused_by_its_name(name: str) -> None:
    buffer = toy_buffer(Analytic(swirl), toy_rollout_settings())
    data = buffer.to_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    tensors = {key: value.clone() for key, value in load(buffer.to_bytes()).items() if key != name}
    with pytest.raises(RolloutBufferError, match=name.split(".")[-1]):
        RolloutBuffer.from_bytes(save(tensors, header))


# refusals


CHANGES = [
    {"num_steps": 7}, {"shift": 5.0}, {"cfg": 2.0}, {"eta": 0.5}, {"arm": "cps"},
    {"mask": mask_config(m_min=0.3)}, {"mask": mask_config(budget="rms")},
]


@pytest.mark.parametrize("changes", CHANGES)
def test_a_buffer_of_another_sampler_is_refused(changes: dict[str, object]) -> None:
    settings, other = toy_rollout_settings(), toy_rollout_settings(**changes)
    buffer = toy_buffer(Analytic(swirl), settings)
    buffer.check(settings, 0)
    assert config_hash(settings) != config_hash(other)
    with pytest.raises(
        RolloutBufferError, match=f"settings {config_hash(settings)[:12]}, .* has {config_hash(other)[:12]}"
    ):
        buffer.check(other, 0)


def test_how_a_rollout_is_batched_or_where_it_is_kept_does_not_make_it_another_one() -> None:
    plain = config_hash(toy_rollout_settings())
    assert (
        config_hash(toy_rollout_settings(micro_batch=3))
        == config_hash(toy_rollout_settings(buffer_device="cpu"))
        == plain
    )


@pytest.mark.parametrize(("made", "now"), [(0, 1), (4, 3)])
def test_a_buffer_of_older_or_newer_weights_is_refused(made: int, now: int) -> None:
    settings = toy_rollout_settings()
    buffer = toy_buffer(Analytic(swirl), settings, version=made)
    with pytest.raises(RolloutBufferError, match=f"comes from version {made}, the learner is at {now}"):
        buffer.check(settings, now)
    buffer.check(settings, made)


@pytest.mark.parametrize("name", ["latents", "states", "zeta"])
def test_a_buffer_with_a_value_that_is_no_number_is_refused_by_video_and_name(name: str) -> None:
    settings = toy_rollout_settings()
    buffer = toy_buffer(Analytic(swirl), settings)
    getattr(buffer.rollout, name)[1].view(-1)[3] = torch.nan
    with pytest.raises(RolloutBufferError, match=f"video 1 of the buffer has a value in rollout.{name}"):
        RolloutBuffer.from_bytes(buffer.to_bytes())


# rewards and parts


def test_the_reward_that_trains_is_the_total_and_a_video_without_it_is_not_valid() -> None:
    buffer = toy_buffer(Analytic(swirl), toy_rollout_settings(), groups=1, size=4)
    some, total = torch.tensor([1.0, math.nan, 3, 4]), torch.tensor([1.0, 2, math.inf, 4])
    assert buffer.with_rewards({"total": some}).valid.tolist() == [True, False, True, True]
    both = buffer.with_rewards({"a": some, "total": total})
    assert torch.equal(both.reward, total.double()) and both.valid.tolist() == [True, True, False, True]
    for rewards, named in (({}, "[(]none[)]"), ({"a": some}, "a")):
        with pytest.raises(ValueError, match=f"holds rewards {named} and no `total`"):
            _ = buffer.with_rewards(rewards).reward
    with pytest.raises(RolloutBufferError, match=r"reward a has shape \(3,\), the buffer 4 videos"):
        buffer.with_rewards({"a": torch.zeros(3)})


def test_rows_of_a_condition_are_repeated_in_groups() -> None:
    condition = toy_condition(2)
    repeated = condition.repeat_interleave(3)
    assert isinstance(repeated, Condition) and len(repeated.frames) == 6
    assert torch.equal(repeated.frames[:3], condition.frames[:1].expand(3, -1, -1, -1, -1))
    assert torch.equal(repeated.rows(slice(3, 4)).actions, condition.actions[1:])
    assert repeated.frames.shape[1] == SHAPE[0]


# the transition


def test_a_transition_carries_gradient_in_its_noise_only() -> None:
    settings, model = toy_rollout_settings(), tiny_network()
    buffer = toy_buffer(model, settings)
    new = first_transition(buffer, settings, 1, model)
    assert new.zeta.requires_grad and new.zeta.shape == (8, 3 * 3 * 5 * 7)
    assert not new.std.requires_grad and new.std.shape == new.zeta.shape
    assert not buffer.rollout.states.requires_grad and not buffer.rollout.mask.requires_grad


@pytest.mark.parametrize("shape", [(3, 1, 1, 1), (1, 1, 5, 7), (3, 5, 3, 7)])
@pytest.mark.parametrize("arm", ["cps", "dyndiff", "flow", "dance", "sage"])
def test_odd_and_single_sizes_have_a_ratio_of_one_before_any_update(shape: tuple[int, int, int, int], arm: str) -> None:
    settings, model = toy_rollout_settings(arm=arm), tiny_network(shape[0])
    buffer = toy_buffer(model, settings, shape=shape, given=0)
    new = first_transition(buffer, settings, 2, model)
    assert torch.equal(log_ratio(new.zeta, buffer.rollout.zeta[:, 2].flatten(1)), torch.zeros(8))


def test_a_stored_mask_of_another_shape_is_refused() -> None:
    settings, model = toy_rollout_settings(), Analytic(swirl)
    buffer = toy_buffer(model, settings)
    wrong = replace(buffer, rollout=replace(buffer.rollout, mask=buffer.rollout.mask[..., :-1]))
    with pytest.raises(ValueError, match="mask must be"):
        first_transition(wrong, settings, 0, model)
