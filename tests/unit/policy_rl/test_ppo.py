"""PPO on a toy: it learns, resumes and cancels exactly, keeps to the reference, and several ranks equal one."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from rl_toys import learner_rank, paying_for_the_first_axis, toy_policy, toy_ppo, toy_rollout

from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import Canceled
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
    metrics = PpoLearner(policy, toy_ppo(epochs=1, minibatch_size=10_000), seed=0).update(toy_rollout(policy))
    assert metrics.approx_kl == pytest.approx(0.0, abs=1e-6)
    assert metrics.kl_reference == pytest.approx(0.0, abs=1e-6)
    assert metrics.clip_fraction == 0.0
    assert metrics.loss_policy == pytest.approx(0.0, abs=1e-5), "normalised advantages have mean 0"
    assert metrics.entropy == pytest.approx(3 * (-1.2 + 0.5 * math.log(2 * math.pi * math.e)), rel=1e-5)


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


def test_four_updates_equal_two_a_resume_and_two_bit_for_bit(tmp_path: Path) -> None:
    settings = toy_ppo(value_warmup_updates=1, kl_reference_weight=0.1)
    straight = toy_policy()
    learner = PpoLearner(straight, settings, seed=3)
    for version in range(1, 5):
        learner.update(toy_rollout(straight, version))
    stopped = toy_policy()
    learner = PpoLearner(stopped, settings, seed=3)
    for version in (1, 2):
        learner.update(toy_rollout(stopped, version))
    learner.save(tmp_path / "state")
    packed = pack_weights(stopped)
    resumed = toy_policy()
    load_weights(resumed, packed.data)
    learner = PpoLearner(resumed, settings, seed=3)
    learner.load(tmp_path / "state")
    for version in (3, 4):
        learner.update(toy_rollout(resumed, version))
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
