"""The GRPO learner on a tiny network: exact ratios and gradients, anchors, resume, refusals. Ids: spec 4.1."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save
from torch import Tensor
from video_toys import (
    SHAPE,
    Analytic,
    advantage_config,
    grpo_config,
    kl_config,
    mean_logprob,
    times_of,
    tiny_network,
    toy_buffer,
    toy_rollout_settings,
    train_rounds,
    weights,
)

from wm_nodes.config.video import GrpoConfig, RolloutConfig
from wm_nodes.training.weights import WeightsError
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError, StepContext, VideoNetwork, step
from wm_nodes.video_rl.group_advantages import GroupAdvantages
from wm_nodes.video_rl.grpo import BufferReport, GrpoLearner
from wm_nodes.video_rl.ratio_and_kl import Rows

NO_KL = kl_config(beta=0.0)
MODES = ["mean", "logk2"]


def grpo(**changes: Any) -> GrpoConfig:
    """Batches of 8 rows, as at rollout, so that network calls have one shape and the ratio is exactly 1."""
    return grpo_config(**{"learning_rate": 1e-3, "micro_batch": 8, "step_fraction": 0.8, **changes})


def make(
    rollout: RolloutConfig | None = None, *, network: VideoNetwork | None = None, seed: int = 0, **changes: Any
) -> GrpoLearner:
    network = network or tiny_network()
    return GrpoLearner(network, grpo(**changes), rollout or toy_rollout_settings(micro_batch=8), seed=seed)


def buffer_of(learner: GrpoLearner, **changes: Any) -> RolloutBuffer:
    return toy_buffer(learner.model, learner.rollout, version=learner.version, **changes)


def all_rows(buffer: RolloutBuffer) -> Rows:
    count, steps = len(buffer), len(buffer.rollout.steps)
    return Rows(torch.arange(count).repeat_interleave(steps), torch.arange(steps).repeat(count))


def known(values: list[float]) -> GroupAdvantages:
    return GroupAdvantages(torch.tensor(values, dtype=torch.float64), torch.ones(len(values)).bool(), 1, 0, 0)


SIGNAL = known([1.5, -0.5, 0.25, -1.0, 2.0, -2.0, 0.1, 0.7])


def gradient(
    learner: GrpoLearner, buffer: RolloutBuffer, rows: Rows | None = None, signal: GroupAdvantages = SIGNAL
) -> Tensor:
    """Of the learner's loss, all parameters in one row."""
    learner.model.zero_grad(set_to_none=True)
    learner.gradients(buffer, rows or all_rows(buffer), signal)
    return torch.cat([p.grad.flatten() for p in learner.parameters if p.grad is not None])


def assert_equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> None:
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


@pytest.mark.parametrize("arm", ["cps", "dyndiff", "flow", "dance", "sage"])
def test_before_any_update_the_ratio_is_exactly_one_and_the_kl_exactly_zero(arm: str) -> None:
    """The network is called with as many rows as at rollout."""
    learner = make(toy_rollout_settings(micro_batch=8, arm=arm), updates_per_buffer=2)
    first, second = learner.train(buffer_of(learner)).updates
    assert first.transitions == 8 * 4
    assert first.ratio_mean == 1.0 and first.kl == 0.0 and first.clip_low_share == first.clip_high_share == 0.0
    assert second.ratio_mean != 1.0 and second.kl > 0


@pytest.mark.parametrize("size", [1, 3, 5, 1000])
def test_in_micro_batches_of_another_size_the_ratio_is_one_to_five_digits(size: int) -> None:
    """The clip range is the tolerance."""
    learner = make(micro_batch=size, clip=1e-5)
    first = learner.train(buffer_of(learner)).updates[0]
    assert first.ratio_mean == pytest.approx(1.0, abs=1e-5) and first.clip_low_share == first.clip_high_share == 0.0
    assert first.kl < 1e-11


def test_from_noise_kept_in_bfloat16_no_ratio_leaves_the_clip_range_and_the_kl_is_below_3e_6() -> None:
    """D = 8192; a clip range of 1e-6 would be left."""
    settings = toy_rollout_settings(micro_batch=8, storage_dtype="bfloat16")
    for clip, left in ((1e-4, False), (1e-6, True)):
        learner = make(settings, network=tiny_network(8), clip=clip)
        first, second = learner.train(buffer_of(learner, shape=(8, 5, 16, 16))).updates
        assert (first.clip_low_share + first.clip_high_share > 0) == left
        assert 0 < first.kl < 3e-6 < second.kl


def test_the_guidance_of_the_rollout_is_that_of_the_training() -> None:
    learner = make(toy_rollout_settings(micro_batch=8, cfg=2.5))
    buffer = buffer_of(learner)
    assert learner.train(buffer).updates[0].kl == 0.0
    plain = toy_buffer(learner.model, toy_rollout_settings(micro_batch=8), version=learner.version)
    assert not torch.equal(buffer.rollout.latents, plain.rollout.latents)


def logprob_gradient(learner: GrpoLearner, buffer: RolloutBuffer, kind: str) -> Tensor:
    """Of the mean over all transitions of -A l, from the kernel and DD-12, without the learner."""
    model, times, total = learner.model, times_of(learner.rollout), torch.zeros(())
    rows = all_rows(buffer)
    for video, position in zip(rows.videos.tolist(), rows.positions.tolist(), strict=True):
        k = buffer.rollout.steps[position]
        condition = buffer.condition.rows(slice(video, video + 1))
        x_t, x_s = (buffer.rollout.state(i)[video : video + 1].float() for i in (k, k + 1))
        context = StepContext(condition.frames, float(times[1]), buffer.rollout.mask[video : video + 1, position])
        t, s = times[k].expand(1), times[k + 1].expand(1)
        law = step(x_t, model(x_t, t, condition), t, s, context, learner.rollout.sampler)
        x, mean, std = (value.expand_as(x_t)[:, :, 1:].flatten(1) for value in (x_s, law.mean, law.std))
        log = mean_logprob(x, mean, std)
        if kind == "cps":
            log = -(x - mean).square().mean(1)
        total = total - SIGNAL.advantages_N[video].float() * log.sum() / len(rows.videos)
    found = torch.autograd.grad(total, learner.parameters, allow_unused=True)  # the text layer, without a text
    return torch.cat([g.flatten() for g in found if g is not None])


@pytest.mark.parametrize("clip", [1e-8, 1e-4, 0.2])
def test_the_first_gradient_is_the_advantage_times_that_of_the_log_probability_for_every_clip(clip: float) -> None:
    learner = make(clip=clip)
    buffer = buffer_of(learner)
    wanted = logprob_gradient(learner, buffer, "full")
    assert float((gradient(learner, buffer) - wanted).norm() / wanted.norm()) < 1e-5


@pytest.mark.parametrize("arm", ["cps", "dyndiff"])
def test_the_likelihood_weight_of_cps_has_the_first_gradient_of_its_formula(arm: str) -> None:
    """DD-14c."""
    learner = make(toy_rollout_settings(micro_batch=8, arm=arm), logprob_weight="cps")
    buffer = buffer_of(learner)
    wanted, full = logprob_gradient(learner, buffer, "cps"), logprob_gradient(learner, buffer, "full")
    assert float((gradient(learner, buffer) - wanted).norm() / wanted.norm()) < 1e-5
    assert float((wanted - full).norm() / full.norm()) > 0.05, "or it could not fail"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("anchor", ["buffer", "frozen", "dual"])
def test_the_kl_has_no_gradient_at_its_anchor(mode: str, anchor: str) -> None:
    """With no advantage nothing else is left."""
    learner = make(kl=kl_config(mode, 10.0, anchor))  # type: ignore[arg-type]
    buffer = buffer_of(learner)
    assert not gradient(learner, buffer, signal=known([0.0] * 8)).any()
    assert gradient(learner, buffer).any()


def test_training_leaves_no_gradient_on_what_was_stored() -> None:
    learner = make()
    buffer = buffer_of(learner)
    before = buffer.to_bytes()
    learner.train(buffer)
    assert buffer.to_bytes() == before
    for name in ("states", "mask", "zeta", "latents"):
        tensor = getattr(buffer.rollout, name)
        assert not tensor.requires_grad and tensor.grad is None, name


# accumulation


@pytest.mark.parametrize("changes", [{}, {"kl": kl_config("mean", 0.5, "frozen")}])
def test_the_size_of_a_micro_batch_does_not_change_the_gradient(changes: dict[str, Any]) -> None:
    whole = make(micro_batch=1000, clip=0.5, **changes)
    buffer = buffer_of(whole)
    wanted = gradient(whole, buffer)
    for size in (1, 3, 7):
        parts = gradient(make(micro_batch=size, clip=0.5, **changes), buffer)
        assert float((parts - wanted).norm() / wanted.norm()) < 1e-5


# KL modes and anchors


@pytest.mark.parametrize(("mode", "beta"), [*((mode, 0.5) for mode in MODES), ("mean", 0.0)])
def test_every_kl_is_zero_on_the_first_update_of_a_buffer_and_then_its_own_size(mode: str, beta: float) -> None:
    """The log-space form is far weaker."""
    learner = make(kl=kl_config(mode, beta), updates_per_buffer=2)
    for iteration in range(2):
        first, second = learner.train(buffer_of(learner, iteration=iteration)).updates
        assert first.kl == 0.0 and bool(second.kl > 0) == bool(beta)


def kl_by_version(rounds: int = 4, **changes: Any) -> list[float]:
    learner, found = make(updates_per_buffer=2, **changes), []
    for iteration in range(rounds):
        found += [u.kl for u in learner.train(buffer_of(learner, iteration=iteration)).updates]
    return found


@pytest.mark.parametrize("mode", MODES)
def test_each_anchor_is_where_it_says(mode: str) -> None:
    """Versions 0 to 7, two to a buffer. The first KL after an anchor moved to the weights is 0."""
    zero = {
        anchor: [kl == 0.0 for kl in kl_by_version(kl=kl_config(mode, 0.5, anchor, 4))]  # type: ignore[arg-type]
        for anchor in ("buffer", "frozen", "dual")
    }
    assert zero["buffer"] == [True, False] * 4
    assert zero["frozen"] == [True] + [False] * 7
    assert zero["dual"] == [True, False, True, False, False, False, True, False], "frozen at versions 0 and 4"


def test_a_dual_anchor_adds_the_frozen_one_to_the_buffer_s() -> None:
    frozen, dual = make(kl=kl_config(anchor="frozen")), make(kl=kl_config(anchor="dual", dual_every=1))
    buffer = make()
    for learner in (frozen, dual, buffer):
        train_rounds(learner, range(1))
        with torch.no_grad():
            for parameter in learner.parameters:
                parameter.copy_(parameter.round(decimals=3))
    data = buffer_of(buffer)
    for parameter in (*buffer.parameters, *frozen.parameters, *dual.parameters):
        parameter.data.add_(0.01)
    for learner in (frozen, dual):
        learner.model.load_state_dict(buffer.model.state_dict())
    frozen_kl, dual_kl, buffer_kl = (
        learner.gradients(data, all_rows(data), SIGNAL)["kl"] for learner in (frozen, dual, buffer)
    )
    assert dual_kl == pytest.approx(frozen_kl + buffer_kl, rel=1e-5) and min(frozen_kl, buffer_kl) > 0


class Adapted(VideoNetwork):
    """A network with an addition to its velocity that can be switched off, as LoRA's can."""

    def __init__(self) -> None:
        base = tiny_network()
        super().__init__(base.settings)
        self.load_state_dict(base.state_dict())
        self.requires_grad_(False)
        self.adapter = torch.nn.Parameter(torch.zeros(1, SHAPE[0], 1, 1, 1))
        self.enabled = True

    def forward(self, x: Tensor, t: Tensor, condition: Any, drop: Tensor | None = None) -> Tensor:
        out = super().forward(x, t, condition, drop)
        return out + self.adapter * x if self.enabled else out

    @contextmanager
    def disable_adapter(self) -> Iterator[None]:
        self.enabled = False
        yield
        self.enabled = True


def test_with_its_adapter_off_the_model_is_its_own_frozen_anchor() -> None:
    found = []
    for anchor in ("lora_off", "frozen"):
        learner = make(network=Adapted(), kl=kl_config(anchor=anchor), learning_rate=0.05)  # type: ignore[arg-type]
        train_rounds(learner, range(2))
        found.append(learner.train(buffer_of(learner, iteration=2)).updates[0].kl)
        assert list(learner.terms.anchor) == ([] if anchor == "lora_off" else ["adapter"])
        assert [name for name, _ in learner.model.named_parameters() if _.requires_grad] == ["adapter"]
    assert found[0] == pytest.approx(found[1], rel=1e-5) and found[0] > 0


def test_switching_off_an_adapter_that_a_model_does_not_have_is_an_error() -> None:
    with pytest.raises(ValueError, match="lora_off needs a model with a LoRA adapter"):
        make(kl=kl_config(anchor="lora_off"))


def test_training_the_condition_alone_moves_its_layers_and_no_other_weight_by_a_bit(tmp_path: Path) -> None:
    learner = make(trains="condition", kl=kl_config(anchor="dual"), weight_decay=0.1)
    before = weights(learner.model)
    train_rounds(learner, range(2))
    after = weights(learner.model)
    moved = {name.split(".")[0] if "film" not in name else "film" for name in after
             if not torch.equal(after[name], before[name])}
    assert moved == {"action", "time", "film"}, "a network without text has nothing to learn about it"
    condition = ("action.", "text.", "time.", "blocks.0.film.")
    assert set(learner.terms.anchor) == {name for name in before if name.startswith(condition)}
    learner.save(tmp_path / "learner.safetensors")
    resumed = make(trains="condition", kl=kl_config(anchor="dual"), weight_decay=0.1)
    resumed.load(tmp_path / "learner.safetensors")
    assert resumed.iterations == 2
    assert_equal(weights(resumed.model), after)
    with pytest.raises(WeightsError, match=r"learner\.safetensors"):
        make().load(tmp_path / "learner.safetensors")


def test_a_model_that_does_not_say_which_weights_are_its_condition_is_refused_and_keeps_its_gradients() -> None:
    model = Analytic(lambda x, t: x)
    with pytest.raises(ValueError, match=r"embedded video model; Analytic takes grpo\.trains all"):
        GrpoLearner(model, grpo(trains="condition"), toy_rollout_settings(), seed=0)
    assert model.offset.requires_grad


def test_weights_whose_number_format_swallows_the_steps_are_refused() -> None:
    """Of bfloat16 weights of 0.02 few moved in 200 steps of 2e-6; an update that moves nothing is the check's."""
    with pytest.raises(ValueError, match=r"weights of bfloat16 round steps of learning_rate 2e-06 to nothing; load"):
        make(network=tiny_network().bfloat16(), learning_rate=2e-6)
    make(network=tiny_network().bfloat16(), learning_rate=0.0)


def test_a_log_space_kl_measures_against_its_own_anchor() -> None:
    """From DD-12: log r of the weights now to those of the anchor, at the stored x_s; not to those that sampled."""
    learner = make(kl=kl_config("logk2", 0.5, "frozen"))
    anchor = tiny_network()
    with torch.no_grad():
        for parameter in learner.parameters:
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3)))
    buffer = buffer_of(learner)  # sampled by the weights now: against the buffer the KL is 0
    found = learner.gradients(buffer, all_rows(buffer), SIGNAL)["kl"] / 40
    logs = torch.tensor([
        float(_logprob(learner.model, learner, buffer, i) - _logprob(anchor, learner, buffer, i)) for i in range(40)
    ], dtype=torch.float64)
    assert found == pytest.approx(float(logs.square().mean() / 2), rel=1e-2) and found > 1e-9


def _logprob(model: torch.nn.Module, learner: GrpoLearner, buffer: RolloutBuffer, row: int) -> Tensor:
    """DD-14 of one stored transition under `model`, float64."""
    rows, times = all_rows(buffer), times_of(learner.rollout)
    video, position = int(rows.videos[row]), int(rows.positions[row])
    k, one = buffer.rollout.steps[position], slice(video, video + 1)
    condition = buffer.condition.rows(one)
    x_t, x_s = buffer.rollout.state(k)[one], buffer.rollout.state(k + 1)[one]
    context = StepContext(condition.frames, float(times[1]), buffer.rollout.mask[one, position])
    t, s = times[k].expand(1), times[k + 1].expand(1)
    with torch.no_grad():
        law = step(x_t, model(x_t, t, condition), t, s, context, learner.rollout.sampler)
    x, mean, std = (value.expand_as(x_t)[:, :, 1:].flatten(1).double() for value in (x_s, law.mean, law.std))
    return mean_logprob(x, mean, std)


def test_a_larger_kl_weight_keeps_the_model_nearer_to_its_anchor() -> None:
    ends = [
        kl_by_version(6, kl=kl_config("mean", beta, "frozen"), clip=0.2)[-1]
        for beta in (1e-6, 50.0)
    ]
    assert ends[1] < 0.5 * ends[0]


# selection, reports


def test_each_iteration_draws_its_own_steps_and_one_buffer_keeps_its_draw() -> None:
    learner = make(step_fraction=0.4)
    buffer = buffer_of(learner)
    everyone = torch.ones(8).bool()
    first = learner.rows(buffer, everyone)
    assert torch.equal(first.positions, learner.rows(buffer, everyone).positions) and len(first.positions) == 8 * 2
    assert [update.transitions for update in learner.train(buffer).updates] == [16, 16]
    other = learner.rows(replace(buffer, iteration=1), everyone)
    assert not torch.equal(first.positions, other.positions)


def test_a_report_says_what_the_buffer_held() -> None:
    """Group 0: rewards 0, 1, invalid, 3; group 1 has no spread."""
    learner = make(step_fraction=1.0)
    rewards = torch.tensor([0.0, 1, math.nan, 3, 5, 5, 5, 5])
    buffer = buffer_of(learner).with_rewards({"total": rewards})
    report = learner.train(buffer)
    deviation = math.sqrt((16 + 1 + 25) / 27)
    assert report.reward_mean == pytest.approx(24 / 7)
    assert report.advantage_abs_mean == pytest.approx((4 / 3 + 1 / 3 + 5 / 3) / 3 / deviation)
    assert (report.zero_std_ratio, report.invalid, report.kept, report.group_size) == (0.5, 1, 3, 4.0)
    assert [u.transitions for u in report.updates] == [15, 15]
    assert report.noise_share == pytest.approx(float(buffer.rollout.noise_share.square().mean().sqrt()))


def test_videos_that_do_not_train_change_nothing_whatever_they_hold() -> None:
    found = []
    for noise in (0.0, 1e3):
        learner = make()
        buffer = buffer_of(learner)
        rewards = torch.tensor([0.0, 1, math.nan, 3, 5, 5, 5, 5])
        states = buffer.rollout.states.clone()
        states[2] += noise
        states[4:] += noise
        buffer = replace(buffer, rollout=replace(buffer.rollout, states=states)).with_rewards({"total": rewards})
        learner.train(buffer)
        found.append(weights(learner.model))
    assert_equal(found[0], found[1])


def test_best_of_2_trains_the_best_and_the_worst_video_of_each_group() -> None:
    learner = make(advantage=advantage_config(best_of_n=2), step_fraction=1.0)
    buffer = buffer_of(learner).with_rewards({"total": torch.tensor([0.0, 1, 2, 3, 8, 5, 9, 6])})
    report = learner.train(buffer)
    assert report.kept == 4 and report.updates[0].transitions == 4 * 5
    assert report.advantage_abs_mean == pytest.approx((1.5 / math.sqrt(1.25) + 2 / math.sqrt(2.5)) / 2)


@pytest.mark.parametrize("arm", ["cps", "dyndiff", "flow"])
@pytest.mark.parametrize("sign", [1, -1])
def test_updates_move_new_videos_towards_what_is_rewarded(arm: str, sign: int) -> None:
    """One parameter is added to the velocity: a brighter video needs less of it."""
    model = Analytic(lambda x, t: x)
    settings = grpo(learning_rate=0.02, clip=0.02, kl=NO_KL, step_fraction=1.0)
    learner, seen = GrpoLearner(model, settings, toy_rollout_settings(arm=arm), seed=0), []
    for iteration in range(6):
        buffer = buffer_of(learner, iteration=iteration, size=16)
        learner.train(buffer.with_rewards({"total": sign * buffer.rollout.latents.mean((1, 2, 3, 4))}))
        seen.append(-sign * model.offset.item())
    assert seen == sorted(seen) and seen[0] > 0.02 and seen[-1] > 0.1


# reproducible, resumed, undone

STATEFUL = [
    {},
    {"kl": kl_config(anchor="frozen")},
    {"advantage": advantage_config(std_scope="global"), "kl": kl_config("logk2", anchor="dual", dual_every=2)},
]


@pytest.mark.parametrize("changes", STATEFUL)
def test_the_same_seeds_give_the_same_update_bit_for_bit(changes: dict[str, Any]) -> None:
    first, second = make(**changes), make(**changes)
    for learner in (first, second):
        train_rounds(learner, range(2))
    assert_equal(weights(first.model), weights(second.model))
    other = make(seed=1, **changes)
    train_rounds(other, range(2))
    assert any(
        not torch.equal(a, b) for a, b in zip(weights(first.model).values(), weights(other.model).values(), strict=True)
    )


@pytest.mark.parametrize("changes", STATEFUL)
def test_three_rounds_equal_two_a_resume_and_one_bit_for_bit(tmp_path: Path, changes: dict[str, Any]) -> None:
    straight, stopped = make(**changes), make(**changes)
    train_rounds(straight, range(3))
    train_rounds(stopped, range(2))
    stopped.save(tmp_path / "state")
    resumed = make(network=tiny_network(seed=9), **changes)
    resumed.load(tmp_path / "state")
    assert (resumed.iterations, resumed.version) == (2, 4)
    train_rounds(resumed, range(2, 3))
    assert_equal(weights(straight.model), weights(resumed.model))
    assert resumed.version == straight.version == 6


def test_a_checkpoint_of_another_seed_or_architecture_is_refused(tmp_path: Path) -> None:
    make().save(tmp_path / "state")
    with pytest.raises(ValueError, match="seed 0, this run has 4"):
        make(seed=4).load(tmp_path / "state")
    wider = make(network=tiny_network(5))
    before = weights(wider.model)
    with pytest.raises(WeightsError, match="another architecture"):
        wider.load(tmp_path / "state")
    assert_equal(before, weights(wider.model))


def test_a_checkpoint_without_the_anchor_that_a_run_has_is_refused(tmp_path: Path) -> None:
    """An anchor that is missing would be the current weights: a KL of 0 for ever."""
    frozen = make(kl=kl_config(anchor="frozen"))
    for one, other in ((make(), frozen), (frozen, make())):
        one.save(tmp_path / "state")
        with pytest.raises(ValueError, match=r"another grpo\.kl\.anchor"):
            other.load(tmp_path / "state")


def test_a_damaged_checkpoint_and_other_tensors_are_refused(tmp_path: Path) -> None:
    make().save(tmp_path / "state")
    whole = (tmp_path / "state").read_bytes()
    for name, data in (("cut", whole[: len(whole) // 2]), ("short", whole[:4]), ("other", save({"a": torch.ones(1)}))):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(WeightsError, match="no complete checkpoint of GRPO"):
            make().load(tmp_path / name)


@pytest.mark.parametrize("changes", STATEFUL)
@pytest.mark.parametrize(("good_updates", "earlier_rounds"), [(0, 0), (1, 1)])
def test_a_gradient_that_is_not_finite_undoes_the_whole_buffer(
    changes: dict[str, Any], good_updates: int, earlier_rounds: int
) -> None:
    learner, undisturbed = make(**changes), make(**changes)
    for one in (learner, undisturbed):
        train_rounds(one, range(earlier_rounds))
    buffer, before = buffer_of(learner, iteration=7), weights(learner.model)
    calls = iter(range(1000))
    batches = len(learner.rows(buffer, torch.ones(8).bool())) // 8

    def poison(gradient: Tensor) -> Tensor:
        return gradient * (math.nan if next(calls) >= good_updates * batches else 1.0)

    handle = learner.parameters[0].register_hook(poison)
    with pytest.raises(FloatingPointError, match="gradient is not finite"):
        learner.train(buffer)
    handle.remove()
    assert_equal(before, weights(learner.model))
    assert (learner.version, learner.iterations) == (2 * earlier_rounds, earlier_rounds)
    for one in (learner, undisturbed):
        one.train(buffer)
        one.train(buffer_of(one, iteration=8))
    assert_equal(weights(learner.model), weights(undisturbed.model))


# refusals


def test_a_group_with_too_few_valid_videos_trains_nothing_and_is_counted() -> None:
    """Groups of six: the three valid ones of the first are enough, the two of the second are not."""
    nan = math.nan
    rewards = torch.tensor([0.1, nan, 0.5, nan, 0.9, nan, 0.2, nan, nan, nan, 0.8, nan])
    learner, other = make(), make()
    buffer = buffer_of(learner, size=6)
    report = learner.train(buffer.with_rewards({"total": rewards}))
    assert (report.invalid, report.dropped_groups, report.kept, report.zero_std_ratio) == (7, 1, 3, 0.5)
    without = rewards.clone()
    without[6:] = math.nan
    assert other.train(buffer.with_rewards({"total": without})).dropped_groups == 1
    assert_equal(weights(learner.model), weights(other.model))


EQUAL = [0.7] * 8
"""Rewards of two groups of four."""


def train_on(learner: GrpoLearner, *rewards: list[float]) -> list[BufferReport]:
    """One buffer for each list of rewards."""
    reports = []
    for iteration, values in enumerate(rewards):
        buffer = toy_buffer(learner.model, learner.rollout, version=learner.version, iteration=iteration)
        reports.append(learner.train(buffer.with_rewards({"total": torch.tensor(values)})))
    return reports


@pytest.mark.parametrize("rewards", [[math.nan] * 8, [math.nan] * 7 + [2.0]])
def test_a_buffer_without_a_group_of_valid_rewards_is_one_clear_error(rewards: list[float]) -> None:
    learner = make()
    before, invalid = weights(learner.model), sum(math.isnan(reward) for reward in rewards)
    with pytest.raises(
        ValueError,
        match=f"{invalid} of 8 rewards are invalid, 2 of 2 groups have too few valid ones and 0 no spread; 0 buffers",
    ):
        train_on(learner, rewards)
    assert_equal(before, weights(learner.model))
    assert learner.version == 0


@pytest.mark.parametrize(("rewards", "few", "invalid"), [(EQUAL, 0, 0), ([1.0] * 4 + [math.nan] * 3 + [2.0], 1, 3)])
def test_a_buffer_whose_rewards_differ_in_no_group_is_skipped_and_counted(
    rewards: list[float], few: int, invalid: int
) -> None:
    learner = make()
    before = weights(learner.model)
    (report,) = train_on(learner, rewards)
    assert (report.updates, report.kept, report.zero_std_ratio, report.skipped) == ((), 0, 1.0, 1)
    assert (report.dropped_groups, report.invalid, math.isnan(report.advantage_abs_mean)) == (few, invalid, True)
    assert (learner.version, learner.iterations) == (0, 1)
    assert_equal(before, weights(learner.model))


def test_skipped_buffers_change_no_later_update_and_too_many_in_a_row_are_an_error() -> None:
    learner, other = make(), make()
    spread = [float(i) for i in range(8)]
    reports = train_on(learner, EQUAL, EQUAL, EQUAL, EQUAL, spread, EQUAL)
    assert [report.skipped for report in reports] == [1, 2, 3, 4, 0, 1]
    buffer = toy_buffer(other.model, other.rollout, iteration=4)
    other.train(buffer.with_rewards({"total": torch.tensor(spread)}))
    assert_equal(weights(learner.model), weights(other.model))
    with pytest.raises(ValueError, match="2 no spread; 4 buffers before it were skipped; look at the reward"):
        train_on(learner, EQUAL, EQUAL, EQUAL, EQUAL)
    assert learner.version == 2 and learner.skipped == 4


def test_the_count_of_skipped_buffers_is_resumed(tmp_path: Path) -> None:
    learner, resumed = make(), make()
    train_on(learner, EQUAL, EQUAL)
    learner.save(tmp_path / "state")
    resumed.load(tmp_path / "state")
    assert (resumed.iterations, resumed.skipped) == (2, 2)


def test_a_buffer_of_videos_that_are_given_whole_is_one_clear_error() -> None:
    learner = make()
    buffer = buffer_of(learner, given=4).with_rewards({"total": torch.arange(8)})
    with pytest.raises(ValueError, match=r"all 4 frames .*given"):
        learner.train(buffer)
    assert learner.version == 0


def test_buffers_of_other_weights_and_those_of_another_sampler_are_refused() -> None:
    learner = make(updates_per_buffer=2)
    buffer = buffer_of(learner)
    learner.train(buffer)
    with pytest.raises(RolloutBufferError, match="comes from version 0, the learner is at 2; sample again"):
        learner.train(buffer)
    with pytest.raises(RolloutBufferError, match="its ratios would be wrong"):
        make(toy_rollout_settings(eta=0.5)).train(buffer)


@pytest.mark.parametrize("changes", [{"arm": "ode"}, {"arm": "cps", "eta": 0.0}])
def test_a_sampler_without_noise_has_nothing_to_train_on(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="an ODE rollout has no likelihood"):
        make(toy_rollout_settings(**changes))


# shapes


@pytest.mark.parametrize("shape", [(3, 1, 1, 1), (1, 1, 5, 7), (3, 5, 3, 7), (1, 3, 7, 5)])
@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize("storage", ["float32", "bfloat16"])
def test_odd_and_single_sizes_train(shape: tuple[int, int, int, int], given: int, storage: str) -> None:
    if given == shape[1]:
        given = 0
    learner = make(toy_rollout_settings(micro_batch=8, storage_dtype=storage), network=tiny_network(shape[0]))
    report = learner.train(buffer_of(learner, shape=shape, given=given))
    limit = 1e-12 if storage == "float32" else 1e-5  # of few cells, kept in bfloat16
    assert report.updates[0].kl < limit and report.updates[1].kl > 0 and report.updates[0].grad_norm > 0


def test_an_instruction_changes_the_video_and_an_empty_one_is_none() -> None:
    learner = make(network=tiny_network(text_dim=4))
    buffer = buffer_of(learner, text_dim=4)
    learner.train(buffer)
    x, t = buffer.rollout.state(1)[:1], torch.tensor([0.5], dtype=torch.float64)
    condition = buffer.condition.rows(slice(0, 1))
    told = learner.model(x, t, condition)
    assert not torch.equal(told, learner.model(x, t, replace(condition, text=condition.text + 1)))
    empty = replace(condition, text=torch.zeros(1, 0, 4))
    assert torch.equal(learner.model(x, t, empty), learner.model(x, t, replace(condition, text=torch.zeros(1, 3, 4))))
    dropped = learner.model(x, t, condition, torch.tensor([True]))
    assert torch.equal(
        dropped, learner.model(x, t, replace(condition, actions=condition.actions + 1), torch.tensor([True]))
    )


def test_a_network_names_latents_and_actions_of_another_size() -> None:
    learner = make()
    buffer = buffer_of(learner)
    x, t = buffer.rollout.latents, torch.full((8,), 0.5, dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"3 latent channels and 2 action values .*got 2 channels, 2 values, 3 actions"
    ):
        learner.model(x[:, :2], t, buffer.condition)
    with pytest.raises(ValueError, match=r"3 actions for 4 frames.*got 3 channels, 2 values, 2 actions"):
        learner.model(x, t, replace(buffer.condition, actions=buffer.condition.actions[:, 1:]))
