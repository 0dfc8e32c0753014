"""DiffusionNFT (DD-31) against its formula in numpy, its limits, and the learner's contracts with it."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from video_toys import (
    SHAPE,
    Analytic,
    grpo_config,
    kl_config,
    tiny_network,
    toy_buffer,
    toy_rollout_settings,
    train_rounds,
    weights,
)

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig
from wm_nodes.reports.clip_report import clip_panels
from wm_nodes.reports.curves import curves
from wm_nodes.training import checkpoint
from wm_nodes.training.metrics import FILE_NAME, read_metrics
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_rl.checks import examine
from wm_nodes.video_rl.group_advantages import GroupAdvantages
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.nft import NftTerms
from wm_nodes.video_rl.ratio_and_kl import Rows
from wm_nodes.video_rl.training_run import VideoRun

ODE = toy_rollout_settings(micro_batch=8, arm="ode", eta=0.0)
NO_KL = kl_config(beta=0.0)
ADVANTAGES = [1.5, -0.5, 0.25, -1.0, 2.5, -2.5, 0.0, 0.7]


def nft_config(beta: float = 1.0, *, times: int = 3, **changes: Any) -> GrpoConfig:
    nft = grpo_config().nft.with_values(beta=beta, times=times)
    return grpo_config(**{
        "objective": "nft", "nft": nft, "kl": NO_KL, "learning_rate": 1e-3, "micro_batch": 8, **changes
    })


def make(
    network: torch.nn.Module | None = None, *, seed: int = 0, rollout: Any = ODE, **changes: Any
) -> GrpoLearner:
    return GrpoLearner(network or tiny_network(), nft_config(**changes), rollout, seed=seed)


def buffer_of(learner: GrpoLearner, **changes: Any) -> RolloutBuffer:
    return toy_buffer(learner.model, learner.rollout, version=learner.version, **changes)


def signal(values: list[float]) -> GroupAdvantages:
    return GroupAdvantages(torch.tensor(values, dtype=torch.float64), torch.ones(len(values)).bool(), 1, 0, 0)


def all_rows(count: int, times: int = 3) -> Rows:
    return Rows(torch.arange(count).repeat_interleave(times), torch.arange(times).repeat(count))


def gradient(learner: GrpoLearner, buffer: RolloutBuffer, values: list[float], rows: Rows | None = None) -> Tensor:
    """Of the learner's loss, all parameters in one row."""
    learner.model.zero_grad(set_to_none=True)
    rows = rows or all_rows(len(buffer), learner.settings.nft.times)
    learner.gradients(buffer, rows, signal(values))
    return torch.cat([p.grad.flatten() for p in learner.parameters if p.grad is not None])


class Line(torch.nn.Module):
    """v = slope x + offset; the condition says nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.slope, self.offset = (torch.nn.Parameter(torch.tensor(value)) for value in (0.3, -0.2))

    def forward(self, x: Tensor, t: Tensor, condition: Any, drop: Tensor | None = None) -> Tensor:
        return self.slope * x + self.offset


def drawn(learner: GrpoLearner, buffer: RolloutBuffer, rows: Rows) -> tuple[np.ndarray, ...]:
    """x_0, eps and x_t of the rows, (M, C, F, H, W) without the given frame, and t, float64."""
    assert isinstance(learner.terms, NftTerms)
    t, noise = learner.terms._draw(buffer, rows, learner.version)
    x_0 = buffer.rollout.latents[rows.videos].double().numpy()[:, :, 1:]
    eps, times = noise.double().numpy()[:, :, 1:], t.numpy().reshape(-1, 1, 1, 1, 1)
    return x_0, eps, (1 - times) * x_0 + times * eps, times


# the formula


@pytest.mark.parametrize("beta", [1.0, 0.1, 2.5])
def test_loss_and_gradient_of_a_linear_velocity_are_those_worked_out_by_hand(beta: float) -> None:
    """v = a x + b now at a = 0.5, b = 0.1, old at a = 0.3, b = -0.2; c = 2.5."""
    learner = make(Line(), beta=beta, micro_batch=5)
    buffer, rows = buffer_of(learner), all_rows(8)
    with torch.no_grad():
        learner.model.slope.fill_(0.5)
        learner.model.offset.fill_(0.1)
    x_0, _, x_t, t = drawn(learner, buffer, rows)
    new, old, c = 0.5 * x_t + 0.1, 0.3 * x_t - 0.2, 2.5
    r = np.clip(np.array(ADVANTAGES)[rows.videos] / c / 2 + 0.5, 0, 1)
    axes, loss, slope, offset = (1, 2, 3, 4), 0.0, 0.0, 0.0
    for share, sign in ((r, 1), (1 - r, -1)):
        v = beta * new + (1 - beta) * old if sign == 1 else (1 + beta) * old - beta * new
        error = x_t - t * v - x_0
        scale = np.maximum(np.abs(error).mean(axes), 1e-5)
        loss = loss + c * share * (error**2).mean(axes) / scale / beta
        down = -2 * sign * t * error * beta  # d error^2 / d v, by the chain rule through v+ or v-
        slope = slope + c * share * (down * x_t).mean(axes) / scale / beta
        offset = offset + c * share * down.mean(axes) / scale / beta
    learner.model.zero_grad(set_to_none=True)
    sums = learner.gradients(buffer, rows, signal(ADVANTAGES))
    assert -sums["objective"] / 24 == pytest.approx(np.mean(loss), rel=1e-5)
    assert float(learner.model.slope.grad) == pytest.approx(np.mean(slope), rel=1e-4)
    assert float(learner.model.offset.grad) == pytest.approx(np.mean(offset), rel=1e-4)


@pytest.mark.parametrize("beta", [1.0, 0.1])
def test_clips_without_an_advantage_have_no_gradient_while_the_weights_are_the_old_ones(beta: float) -> None:
    learner = make(beta=beta)
    buffer = buffer_of(learner)
    assert not gradient(learner, buffer, [0.0] * 8).any()
    assert gradient(learner, buffer, ADVANTAGES).norm() > 0.1
    with torch.no_grad():
        for parameter in learner.parameters:
            parameter.add_(0.01)
    assert gradient(learner, buffer, [0.0] * 8).any(), "then it draws back to them"


def test_the_best_clips_with_beta_1_are_learned_by_flow_matching_in_the_space_of_clean_clips() -> None:
    """A = c: r = 1, v+ = v; the error x^_0 - x_0 is t times that of the velocity."""
    learner = make()
    buffer, rows = buffer_of(learner), all_rows(8)
    found = gradient(learner, buffer, [2.5] * 8)
    _, noise = learner.terms._draw(buffer, rows, 0)
    t, x_0 = torch.from_numpy(drawn(learner, buffer, rows)[3]).float(), buffer.rollout.latents[rows.videos]
    condition = buffer.condition.rows(rows.videos)
    x_t = torch.cat([condition.frames, ((1 - t) * x_0 + t * noise)[:, :, 1:]], 2)
    error = (learner.model(x_t, t.flatten().double(), condition) - (noise - x_0))[:, :, 1:]
    errors = (t * error).flatten(1)
    loss = 2.5 * (errors.square().mean(1) / errors.detach().abs().mean(1)).mean()
    wanted = torch.autograd.grad(loss, learner.parameters, allow_unused=True)  # the text layer, without a text
    wanted = torch.cat([g.flatten() for g in wanted if g is not None])
    assert float((found - wanted).norm() / wanted.norm()) < 1e-5


@pytest.mark.parametrize("good", [0, 1])
def test_a_step_moves_the_velocity_towards_that_of_the_good_clip_and_away_from_that_of_the_bad_one(good: int) -> None:
    """Clips of ones and of minus ones; v is a constant. The velocity eps - x_0 to the clip of ones is the lower one."""
    model = Analytic(lambda x, t: torch.zeros_like(x))
    learner = GrpoLearner(model, nft_config(), ODE, seed=0)
    buffer = buffer_of(learner, groups=1, size=2)
    values = torch.tensor([1.0, -1.0]).view(2, 1, 1, 1, 1).expand_as(buffer.rollout.latents)
    buffer = replace(buffer, rollout=replace(buffer.rollout, latents=values.contiguous()))
    for advantages, both in (([2.5, -2.5], True), ([2.5, 0.0], False), ([0.0, -2.5], False)):
        found = float(gradient(learner, buffer, advantages if good == 0 else advantages[::-1]))
        assert math.copysign(1, found) == (1 if good == 0 else -1) and abs(found) > (1.0 if both else 0.5)


def test_updates_move_new_videos_towards_what_is_rewarded() -> None:
    """One parameter is added to the velocity: a brighter video needs less of it."""
    for sign in (1, -1):
        model = Analytic(lambda x, t: x)
        learner, seen = GrpoLearner(model, nft_config(learning_rate=0.02), ODE, seed=0), []
        for iteration in range(6):
            buffer = buffer_of(learner, iteration=iteration, size=16)
            learner.train(buffer.with_rewards({"total": sign * buffer.rollout.latents.mean((1, 2, 3, 4))}))
            seen.append(-sign * model.offset.item())
        assert seen == sorted(seen) and seen[0] > 0.01 and seen[-1] > 0.05


def test_given_frames_stay_clean_and_count_nothing() -> None:
    """Other latents where frames are given change no bit."""
    learner = make()
    buffer = buffer_of(learner)
    latents = buffer.rollout.latents.clone()
    latents[:, :, 0] += 100
    other = replace(buffer, rollout=replace(buffer.rollout, latents=latents))
    assert torch.equal(gradient(learner, buffer, ADVANTAGES), gradient(learner, other, ADVANTAGES))


def test_times_lie_one_in_each_part_of_the_sampler_s_range_and_every_update_draws_anew() -> None:
    learner = make(times=4)
    buffer, rows = buffer_of(learner), all_rows(8, 4)
    times, noise = learner.terms._draw(buffer, rows, 0)
    uniform = times / (3 - 2 * times)  # the inverse of shift 3
    assert (uniform * 4).floor().int().tolist() == [0, 1, 2, 3] * 8 and len(set(times.tolist())) == 32
    assert float(times.mean()) > 0.6, "shifted towards the noise"
    again, later = learner.terms._draw(buffer, rows, 0), learner.terms._draw(buffer, rows, 1)
    assert torch.equal(again[1], noise) and torch.equal(again[0], times)
    assert not (later[1] == noise).any() and not (later[0] == times).any()
    part = rows.part(torch.tensor([17, 3]))
    assert torch.equal(learner.terms._draw(buffer, part, 0)[1], noise[[17, 3]])


# the learner's contracts


@pytest.mark.parametrize("rollout", [ODE, toy_rollout_settings(micro_batch=8, arm="cps")])
def test_clips_of_any_sampler_train_and_what_does_not_exist_is_not_a_number(rollout: Any) -> None:
    learner = make(rollout=rollout)
    before = weights(learner.model)
    report = learner.train(buffer_of(learner))
    assert [update.transitions for update in report.updates] == [24, 24] and report.kept == 8
    for update in report.updates:
        missing = (update.ratio_mean, update.clip_low_share, update.clip_high_share)
        assert all(map(math.isnan, missing)) and update.objective < 0 == update.kl < update.grad_norm
    assert any(not torch.equal(value, before[name]) for name, value in weights(learner.model).items())
    if rollout is ODE:
        assert report.noise_share == 0.0


def test_every_update_trains_the_kept_videos_alone() -> None:
    learner = make()
    buffer = buffer_of(learner)
    rewards = torch.tensor([0.0, 1, math.nan, 3, 5, 5, 5, 5])
    report = learner.train(buffer.with_rewards({"total": rewards}))
    assert report.kept == 3 and [update.transitions for update in report.updates] == [9, 9]


def test_the_size_of_a_micro_batch_does_not_change_the_gradient() -> None:
    whole = make(micro_batch=1000)
    buffer = buffer_of(whole)
    wanted = gradient(whole, buffer, ADVANTAGES)
    for size in (1, 5):
        parts = gradient(make(micro_batch=size), buffer, ADVANTAGES)
        assert float((parts - wanted).norm() / wanted.norm()) < 1e-5


# old weights


def test_the_old_weights_are_those_that_sampled_the_buffer() -> None:
    learner = make()
    for iteration in range(2):
        start = weights(learner.model)
        learner.train(buffer_of(learner, iteration=iteration))
        assert all(torch.equal(value, start[name]) for name, value in learner.terms.old.items())
    assert any(not torch.equal(value, start[name]) for name, value in weights(learner.model).items())


def test_three_rounds_equal_two_a_resume_and_one_bit_for_bit(tmp_path: Path) -> None:
    straight, stopped, other = make(), make(), make(seed=1)
    train_rounds(straight, range(3))
    train_rounds(other, range(3))
    train_rounds(stopped, range(2))
    stopped.save(tmp_path / "state")
    resumed = make(tiny_network(seed=9))
    resumed.load(tmp_path / "state")
    assert (resumed.iterations, resumed.version) == (2, 4)
    train_rounds(resumed, range(2, 3))
    for name, value in weights(straight.model).items():
        assert torch.equal(value, weights(resumed.model)[name]), name
    assert any(not torch.equal(value, weights(other.model)[name]) for name, value in weights(straight.model).items())


def test_a_checkpoint_of_the_other_objective_is_refused(tmp_path: Path) -> None:
    rollout = toy_rollout_settings()
    ratio = GrpoLearner(tiny_network(), grpo_config(), rollout, seed=0)
    nft = make(rollout=rollout)
    for one, other in ((ratio, nft), (nft, ratio)):
        one.save(tmp_path / "state")
        with pytest.raises(ValueError, match=r"another grpo\.objective; resume with its settings"):
            other.load(tmp_path / "state")


def test_a_checkpoint_with_the_old_weights_and_without_its_objective_is_still_continued(tmp_path: Path) -> None:
    learner, resumed, path = make(), make(tiny_network(seed=9)), tmp_path / "state"
    train_rounds(learner, range(1))
    learner.save(path)
    tensors, metadata = checkpoint.read_checkpoint(path)
    header = json.loads(metadata["grpo"])
    del header["objective"]
    parts = {part: checkpoint.section(tensors, f"{part}.") for part in ("model", "optimizer")}
    checkpoint.write_checkpoint(path, {**parts, "old": parts["model"]}, {"grpo": json.dumps(header)})
    resumed.load(path)
    for one in (learner, resumed):
        train_rounds(one, range(1, 2))
    for name, value in weights(learner.model).items():
        assert torch.equal(value, weights(resumed.model)[name]), name


def test_a_gradient_that_is_not_finite_undoes_the_whole_buffer() -> None:
    """In the second update of the second buffer."""
    learner, undisturbed = make(), make()
    for one in (learner, undisturbed):
        train_rounds(one, range(1))
    buffer, before = buffer_of(learner, iteration=7), weights(learner.model)
    calls = iter(range(1000))
    first = len(learner.rows(buffer, torch.ones(8).bool())) // 8 + 1
    handle = learner.parameters[0].register_hook(lambda g: g * (math.nan if next(calls) >= first else 1.0))
    with pytest.raises(FloatingPointError, match="gradient is not finite"):
        learner.train(buffer)
    handle.remove()
    assert learner.version == 2
    assert all(torch.equal(value, before[name]) for name, value in weights(learner.model).items())
    for one in (learner, undisturbed):
        one.train(buffer)
        one.train(buffer_of(one, iteration=8))
    for name, value in weights(learner.model).items():
        assert torch.equal(value, weights(undisturbed.model)[name]), name


# refusals


def test_a_kl_is_refused() -> None:
    with pytest.raises(ValueError, match=r"objective nft has no KL, got kl\.beta 0\.5; set kl\.beta 0"):
        nft_config(kl=kl_config(beta=0.5))


def test_the_ratio_still_needs_a_sampler_with_noise_and_names_this_objective() -> None:
    with pytest.raises(ValueError, match=r"no likelihood to train on; .* or grpo\.objective nft"):
        GrpoLearner(tiny_network(), grpo_config(), ODE, seed=0)


# around the learner


def test_a_run_folder_of_ode_clips_resumes_and_writes_null_for_what_does_not_exist(tmp_path: Path) -> None:
    plain = load_video_config("smoke")
    config = plain.with_values(rollout=ODE, grpo=nft_config())

    def train(run: VideoRun, rounds: int) -> VideoRun:
        for _ in range(rounds):
            buffer = buffer_of(run.learner, iteration=run.iterations)
            again = RolloutBuffer.from_bytes(buffer.to_bytes())
            assert again.to_bytes() == buffer.to_bytes() and again.rollout.steps == ()
            run.train(again)
        run.close()
        return run

    straight = train(VideoRun(tiny_network(), config, tmp_path / "straight"), 3)
    train(VideoRun(tiny_network(), config, tmp_path / "stopped"), 2)
    resumed = train(VideoRun(tiny_network(seed=3), config, tmp_path / "stopped"), 1)
    assert (resumed.version, resumed.iterations) == (straight.version, straight.iterations) == (6, 3)
    for name, value in weights(straight.network).items():
        assert torch.equal(value, weights(resumed.network)[name]), name
    first, *_ = read_metrics(tmp_path / "stopped", "grpo")
    assert {name for name, value in first.items() if value is None} == {
        f"{name}_{k}" for name in ("ratio_mean", "clip_low_share", "clip_high_share") for k in (1, 2)
    }
    assert curves(tmp_path / "stopped" / FILE_NAME, tmp_path / "curves.png", clip_panels(2)) is not None


def test_the_check_of_a_video_model_makes_no_update() -> None:
    config, network = load_video_config("base").with_values(rollout=ODE, grpo=nft_config()), tiny_network()
    (found,) = examine(network, toy_buffer(network, ODE).condition, SHAPE, config)
    assert found.passed and found.name == "the mask is not flat"
