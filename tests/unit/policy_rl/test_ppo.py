"""PPO on a toy: it learns, resumes and cancels exactly, keeps to the reference, and several ranks equal one."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from graph.toy import ReachToy
from rl_toys import learner_rank, paying_for_the_first_axis, toy_policy, toy_ppo, toy_rollout

from wm_nodes.config.schema import PpoConfig
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import Canceled, collect_rollout, rollout_statistics
from wm_nodes.reward import RuleReward
from wm_nodes.training.weights import load_weights, pack_weights, unpack_weights


def weights(policy: ImagePolicy) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}


def assert_equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


def test_updates_move_the_actions_towards_the_reward() -> None:
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(learning_rate=3e-3, kl_reference_weight=0.0), seed=0)
    before = float(toy_rollout(policy, 99).actions_TN[..., 0].mean())
    for version in range(1, 16):
        learner.update(paying_for_the_first_axis(toy_rollout(policy, version)))
    assert float(toy_rollout(policy, 99).actions_TN[..., 0].mean()) > before + 0.2


def grouped(**changes: Any) -> PpoConfig:
    """GRPO in groups of three."""
    return toy_ppo(advantage="group", group_size=3, num_steps=12, **changes)


@pytest.mark.slow
def test_groups_learn_to_reach_without_a_critic() -> None:
    policy, env = toy_policy(), ReachToy(108, 0)
    settings = grouped(learning_rate=3e-3, kl_reference_weight=0.0, value_warmup_updates=9, minibatch_size=64)
    learner = PpoLearner(policy, settings, seed=0)
    before, rates = weights(policy), []
    for version in range(1, 31):
        rollout = collect_rollout(env, policy, RuleReward(), 12, 0, version, envs_per_start=3)
        metrics = learner.update(rollout)
        rates.append(rollout_statistics(rollout).success_rate)
    assert np.mean(rates[-5:]) > np.mean(rates[:5]) + 0.3, rates
    assert math.isnan(metrics.loss_value) and math.isnan(metrics.explained_variance)
    for name, tensor in policy.named_parameters():
        assert torch.equal(tensor, before[name]) == name.startswith("critic."), name


def test_groups_that_began_at_different_starts_or_hold_several_episodes_are_refused() -> None:
    policy = toy_policy()
    learner = PpoLearner(policy, grouped(), seed=0)
    with pytest.raises(ValueError, match="3 neighbouring environments began at different starts; collect with"):
        learner.update(toy_rollout(policy))
    rollout = collect_rollout(ReachToy(3, 0), policy, RuleReward(), 13, 0, 1, envs_per_start=3)
    with pytest.raises(ValueError, match=r"of 13 lock-steps most .*; step ppo.num_envs \(64\) environments at a time"):
        learner.update(rollout)
    with pytest.raises(ValueError, match="3 environments are not whole groups of 2"):
        PpoLearner(policy, toy_ppo(advantage="group", group_size=2), seed=0).update(rollout)


def test_groups_leave_out_episodes_without_a_return_and_need_no_values() -> None:
    policy = toy_policy()
    rollout = collect_rollout(ReachToy(6, 0), policy, RuleReward(), 12, 0, 1, envs_per_start=3)
    valid = rollout.valid_TN.copy()
    valid[1, 2] = False
    given = replace(rollout, valid_TN=valid, values_TN=np.full_like(rollout.values_TN, np.nan))
    metrics = PpoLearner(policy, grouped(), seed=0).update(given)
    ends = np.argmax(rollout.terminated_TN | rollout.truncated_TN, 0) + 1
    assert (metrics.episodes_without_return, metrics.samples) == (1, ends.sum() - ends[2])
    valid[1] = False
    with pytest.raises(ValueError, match="no first episode with every reward"):
        PpoLearner(policy, grouped(), seed=0).update(replace(given, valid_TN=valid))


def test_a_large_reference_weight_holds_the_policy_near_the_reference() -> None:
    distances = []
    for weight in (0.0, 10.0):
        policy = toy_policy()
        learner = PpoLearner(policy, toy_ppo(learning_rate=3e-3, kl_reference_weight=weight), seed=0)
        for version in range(1, 9):
            metrics = learner.update(paying_for_the_first_axis(toy_rollout(policy, version)))
        distances.append(metrics.kl_reference)
    assert 0 <= distances[1] < 0.2 * distances[0]


def test_the_first_update_starts_at_the_acting_policy_and_at_the_reference() -> None:
    policy = toy_policy()
    with torch.no_grad():
        policy.log_std_A.fill_(-3.0)  # the limits are far
    metrics = PpoLearner(policy, toy_ppo(epochs=1, minibatch_size=10_000), seed=0).update(toy_rollout(policy))
    assert metrics.approx_kl == pytest.approx(0.0, abs=1e-6)
    assert metrics.kl_reference == pytest.approx(0.0, abs=1e-6)
    assert metrics.clip_fraction == 0.0
    assert metrics.loss_policy == pytest.approx(0.0, abs=1e-5), "normalised advantages have mean 0"
    assert metrics.entropy == pytest.approx(3 * (-3.0 + 0.5 * math.log(2 * math.pi * math.e)), rel=1e-5)


def test_value_warmup_trains_the_critic_only() -> None:
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(value_warmup_updates=1), seed=0)
    before = weights(policy)
    learner.update(toy_rollout(policy))
    after = weights(policy)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("critic.") for name in changed)
    learner.update(toy_rollout(policy, 2))
    assert not torch.equal(after["log_std_A"], policy.log_std_A)


def test_beyond_target_kl_the_update_ends_early() -> None:
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(epochs=8, learning_rate=0.05, target_kl=1e-4), seed=0)
    assert learner.update(toy_rollout(policy)).epochs < 8


def test_a_step_beyond_target_kl_is_not_made() -> None:
    """A rollout of quite another policy than the one that learns from it is read once, and moves nothing."""
    policy, other = toy_policy(), toy_policy()
    with torch.no_grad():
        other.actor.output.bias.fill_(0.3)
    before = weights(policy)
    metrics = PpoLearner(policy, toy_ppo(target_kl=1e-6), seed=0).update(toy_rollout(other))
    assert metrics.epochs == 0 and metrics.approx_kl > 1e-6
    assert_equal(before, weights(policy))


def test_the_standard_deviation_keeps_its_floor() -> None:
    policy = toy_policy()
    floor = float(policy.log_std_A.detach().max()) + 0.1
    PpoLearner(policy, toy_ppo(min_log_std=floor), seed=0).update(toy_rollout(policy))
    assert (policy.log_std_A >= floor).all()


@pytest.mark.slow
def test_a_policy_beyond_the_limits_learns_on_with_finite_weights() -> None:
    """The mean of one action lies 0.2 beyond the limit, as a gripper's does after demonstrations."""
    policy = toy_policy()
    with torch.no_grad():
        policy.log_std_A.fill_(-3.0)
        policy.actor.output.bias[0] = 1.2
    learner, env = PpoLearner(policy, toy_ppo(target_kl=0.03, kl_reference_weight=0.0), seed=0), ReachToy(8, 0)
    for version in range(1, 101):
        metrics = learner.update(collect_rollout(env, policy, RuleReward(), 8, 0, version))
    assert metrics.kl_reference < 3 and metrics.grad_norm < 100


@pytest.mark.parametrize("column", ["states_TN", "actions_TN"])
def test_a_valid_transition_that_is_not_finite_is_refused(column: str) -> None:
    policy = toy_policy()
    rollout = toy_rollout(policy)
    numbers = getattr(rollout, column).copy()
    numbers[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"a valid transition has a .* that is not finite"):
        PpoLearner(policy, toy_ppo(), seed=0).update(replace(rollout, **{column: numbers}))


@pytest.mark.parametrize("lost", [(4,), (1, 6), (0,)])
def test_the_step_before_a_lost_one_bootstraps_from_what_it_reached(lost: tuple[int, ...]) -> None:
    """A critic that says 5 everywhere is right where rewards are 0 and nothing is discounted."""
    policy = toy_policy()
    with torch.no_grad():
        for parameter in policy.critic.parameters():
            parameter.zero_()
        policy.critic.output.bias.fill_(5.0)
    rollout = toy_rollout(policy)
    valid = np.ones_like(rollout.valid_TN)
    valid[list(lost)] = False
    none, steps = np.zeros_like(valid), np.where(valid, 0.0, np.nan).astype(np.float32)
    values = np.where(valid, 5.0, 0.0).astype(np.float32)
    whole = replace(rollout, rewards_TN=steps, values_TN=values, valid_TN=valid, terminated_TN=none, truncated_TN=none)
    metrics = PpoLearner(policy, toy_ppo(gamma=1.0, epochs=1, minibatch_size=10_000), seed=0).update(whole)
    assert metrics.loss_value < 1e-6


def test_invalid_transitions_change_nothing_whatever_they_hold() -> None:
    found = []
    for reward in (math.nan, 1e6):
        policy = toy_policy()
        rollout = toy_rollout(policy)
        valid, rewards = rollout.valid_TN.copy(), rollout.rewards_TN.copy()
        valid[3, 2], rewards[3, 2] = False, reward
        PpoLearner(policy, toy_ppo(), seed=0).update(replace(rollout, valid_TN=valid, rewards_TN=rewards))
        found.append(weights(policy))
    assert_equal(found[0], found[1])


def test_a_rollout_without_a_valid_transition_is_an_error() -> None:
    policy = toy_policy()
    rollout = toy_rollout(policy)
    with pytest.raises(ValueError, match="no valid transition"):
        PpoLearner(policy, toy_ppo(), seed=0).update(replace(rollout, valid_TN=np.zeros_like(rollout.valid_TN)))


@pytest.mark.parametrize("field", ["logprobs_TN", "values_TN"])
def test_a_rollout_of_unknown_log_probs_or_values_is_refused(field: str) -> None:
    policy = toy_policy()
    rollout = toy_rollout(policy)
    numbers = getattr(rollout, field).copy()
    numbers[np.nonzero(rollout.valid_TN)[0][0], np.nonzero(rollout.valid_TN)[1][0]] = np.nan
    with pytest.raises(ValueError, match=r"1 of .* valid transitions have no log_prob or value"):
        PpoLearner(policy, toy_ppo(), seed=0).update(replace(rollout, **{field: numbers}))


def twins(updates: int) -> tuple[PpoLearner, PpoLearner]:
    """Two learners of equal policies after the same updates."""
    learners = PpoLearner(toy_policy(), toy_ppo(), seed=0), PpoLearner(toy_policy(), toy_ppo(), seed=0)
    for learner in learners:
        for version in range(1, updates + 1):
            learner.update(toy_rollout(learner.policy, version))
    return learners


@pytest.mark.parametrize("earlier_updates", [0, 1])
@pytest.mark.parametrize("good_minibatches", [0, 2])
def test_a_gradient_that_is_not_finite_undoes_the_whole_update(earlier_updates: int, good_minibatches: int) -> None:
    learner, undisturbed = twins(earlier_updates)
    policy, straight = learner.policy, undisturbed.policy
    rollout, before = toy_rollout(policy, 9), weights(policy)
    calls = iter(range(1000))

    def poison(gradient: torch.Tensor) -> torch.Tensor:
        return gradient * (math.nan if next(calls) >= good_minibatches else 1.0)

    handle = next(policy.critic.parameters()).register_hook(poison)
    with pytest.raises(FloatingPointError, match=r"gradient is not finite.*undone"):
        learner.update(rollout)
    handle.remove()
    assert next(calls) == good_minibatches + 1
    assert_equal(before, weights(policy))
    assert learner.updates == earlier_updates
    learner.update(rollout)
    undisturbed.update(rollout)
    assert_equal(weights(policy), weights(straight))


@pytest.mark.parametrize("earlier_updates", [0, 1])
def test_a_canceled_update_leaves_weights_and_optimiser_as_they_were(earlier_updates: int) -> None:
    learner, undisturbed = twins(earlier_updates)
    policy, straight = learner.policy, undisturbed.policy
    rollout, before = toy_rollout(policy, 9), weights(policy)
    answers = iter([False, False, True])
    with pytest.raises(Canceled):
        learner.update(rollout, should_stop=lambda: next(answers))
    assert_equal(before, weights(policy))
    assert learner.updates == earlier_updates
    learner.update(rollout)
    undisturbed.update(rollout)
    assert_equal(weights(policy), weights(straight))


@pytest.mark.parametrize("make", [toy_ppo, grouped])
def test_four_updates_equal_two_a_resume_and_two_bit_for_bit(make: Callable[..., PpoConfig], tmp_path: Path) -> None:
    settings = make(value_warmup_updates=1, kl_reference_weight=0.1)

    def collect(policy: ImagePolicy, version: int) -> Rollout:
        rollout = toy_rollout(policy, version, envs_per_start=settings.envs_per_start)
        return rollout if make is toy_ppo else paying_for_the_first_axis(rollout)

    straight = toy_policy()
    learner = PpoLearner(straight, settings, seed=3)
    for version in range(1, 5):
        learner.update(collect(straight, version))
    stopped = toy_policy()
    learner = PpoLearner(stopped, settings, seed=3)
    for version in (1, 2):
        learner.update(collect(stopped, version))
    learner.save(tmp_path / "state")
    packed = pack_weights(stopped)
    resumed = toy_policy()
    load_weights(resumed, packed.data)
    learner = PpoLearner(resumed, settings, seed=3)
    learner.load(tmp_path / "state")
    for version in (3, 4):
        learner.update(collect(resumed, version))
    assert_equal(weights(straight), weights(resumed))


def test_a_checkpoint_of_another_seed_is_refused(tmp_path: Path) -> None:
    policy = toy_policy()
    PpoLearner(policy, toy_ppo(), seed=3).save(tmp_path / "state")
    with pytest.raises(ValueError, match="seed 3, this run has 4"):
        PpoLearner(policy, toy_ppo(), seed=4).load(tmp_path / "state")


@pytest.mark.slow
def test_two_gloo_ranks_give_the_update_of_one(tmp_path: Path) -> None:
    changes = {"value_warmup_updates": 1, "minibatch_size": 7}
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(**changes), seed=5)
    for version in range(1, 4):
        learner.update(toy_rollout(policy, version))
    mp.spawn(learner_rank, args=(2, str(tmp_path), changes, 3), nprocs=2)
    ranks = [unpack_weights((tmp_path / f"rank{rank}.safetensors").read_bytes())[0] for rank in (0, 1)]
    assert_equal(ranks[0], ranks[1])
    for name, tensor in weights(policy).items():
        torch.testing.assert_close(ranks[0][name], tensor, rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
