"""Behaviour cloning of a scripted expert in the toy: learns it, exactly repeatable, expert data only."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from graph.toy import GOAL_M, ReachToy
from rl_toys import toy_policy

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import SftConfig
from wm_nodes.core.types import RECOVERY, TAKEN_OVER, Episode, UInt8Array
from wm_nodes.policy_rl import behaviour_cloning
from wm_nodes.policy_rl.behaviour_cloning import demonstrations, train_sft
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.validation.evaluation import evaluate


def settings(**changes: float) -> SftConfig:
    return load_config("base").sft.model_copy(update={"num_iterations": 300, "batch_size": 64, **changes})


def expert_episode(seed: int, extra_steps: int = 0) -> Episode:
    env = ReachToy(1, 0)
    observation = env.reset(None, np.array([seed], np.uint64))
    images, states, actions, success = [observation.image[0]], [observation.state[0]], [], [False]
    while not success[-1]:
        action = np.clip((GOAL_M - states[-1]) / 0.03, -1, 1).astype(np.float32)
        result = env.step(action[None])
        images.append(result.observation.image[0])
        states.append(result.observation.state[0])
        actions.append(action)
        success.append(bool(result.terminated[0]))
    for _ in range(extra_steps):
        images.append(images[-1])
        states.append(states[-1])
        actions.append(np.full(3, -1, np.float32))
        success.append(True)
    steps = len(actions)
    return Episode(
        images=np.stack(images), states=np.stack(states), actions=np.stack(actions),
        ground_truth=np.zeros((steps + 1, 2), np.float32), success=np.array(success),
        rewards=np.zeros(steps, np.float32), terminated=True, truncated=False, task="reach",
        instruction="reach the dot", behaviour="expert", seed=seed, episode_id=seed, source=1,
    )


DEMOS = [expert_episode(seed) for seed in range(100, 130)]


def test_cloning_raises_success_and_leaves_critic_and_log_std_alone() -> None:
    policy = toy_policy()
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    start = evaluate(policy, ReachToy(10, 0), 40, 1_000_000).success_rate
    result = train_sft(policy, DEMOS, settings(), 0)
    assert evaluate(policy, ReachToy(10, 0), 40, 1_000_000).success_rate > start + 0.4
    assert result.losses[-len(result.losses) // 10 :].mean() < 0.3 * float(result.losses[0])
    after = policy.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert all(name.startswith(("actor.", "feature_")) for name in changed)
    assert any(name.startswith("actor.") for name in changed)


def test_one_seed_gives_the_same_weights_bit_for_bit() -> None:
    policies = [toy_policy() for _ in range(3)]
    for policy, seed in zip(policies, (0, 0, 1), strict=True):
        train_sft(policy, DEMOS[:4], settings(num_iterations=20), seed)
    same, equal, other = (policy.state_dict() for policy in policies)
    assert all(torch.equal(same[name], equal[name]) for name in same)
    assert not torch.equal(same["actor.output.weight"], other["actor.output.weight"])


def test_reconstructed_frames_are_trained_on_beside_the_raw_ones() -> None:
    seen: list[int] = []

    def darker(images: UInt8Array) -> UInt8Array:
        seen.append(len(images))
        return images // 2

    plain = train_sft(toy_policy(), DEMOS[:4], settings(num_iterations=2), 0)
    both = train_sft(toy_policy(), DEMOS[:4], settings(num_iterations=2), 0, reconstruct=darker)
    assert seen == [plain.num_samples] and both.num_samples == 2 * plain.num_samples


def test_steps_after_the_first_success_are_left_out() -> None:
    short, long = ([expert_episode(7, extra), expert_episode(8, extra)] for extra in (0, 5))
    results = [train_sft(toy_policy(), demos, settings(num_iterations=5), 0) for demos in (short, long)]
    assert results[0].num_samples == results[1].num_samples
    np.testing.assert_array_equal(results[0].losses, results[1].losses)


def test_only_successful_expert_episodes_are_demonstrations() -> None:
    failed = replace(DEMOS[0], success=np.zeros_like(DEMOS[0].success))
    noisy = replace(DEMOS[1], behaviour="noisy")
    done = replace(DEMOS[0], success=np.ones_like(DEMOS[0].success))  # the rest of a try that a gap has cut
    found = demonstrations([failed, noisy, done, *DEMOS[2:6]], 3)
    assert [episode.seed for episode in found] == [102, 103, 104]
    with pytest.raises(ValueError, match=r"sft\.num_demonstrations is 3, but the data hold 1"):
        demonstrations([failed, noisy, DEMOS[2]], 3)


def test_the_weights_with_the_least_error_on_held_out_demonstrations_are_kept() -> None:
    rng = np.random.default_rng(0)
    wrong = [replace(d, actions=rng.uniform(-1, 1, d.actions.shape).astype(np.float32)) for d in DEMOS[:8]]
    policy, longer = toy_policy(), settings(num_iterations=200, heldout=0.25)
    result = train_sft(policy, wrong, longer, 0)  # nothing carries over: the longer, the worse
    best = min(result.heldout_losses, key=lambda step: result.heldout_losses[step])
    assert best < 200 and result.heldout_losses[200] > result.heldout_losses[best]
    assert result.num_samples == sum(demo.num_steps for demo in wrong[:6])
    stopped = toy_policy()
    train_sft(stopped, wrong[:6], longer.model_copy(update={"num_iterations": best, "heldout": 0.0}), 0)
    assert all(torch.equal(policy.state_dict()[name], value) for name, value in stopped.state_dict().items())
    with pytest.raises(ValueError, match=r"sft\.heldout 0.1 of 2 expert demonstrations is 0"):
        train_sft(toy_policy(), DEMOS[:2], settings(heldout=0.1), 0)


def test_of_each_behaviour_a_share_is_held_out_and_twins_stay_on_one_side(monkeypatch: pytest.MonkeyPatch) -> None:
    sides, frames = list[list[tuple[int, str]]](), behaviour_cloning._frames

    def noted(policy: ImagePolicy, demos: list[Episode], *rest: Any) -> Any:
        sides.append([(demo.seed, demo.behaviour) for demo in demos])
        return frames(policy, demos, *rest)

    monkeypatch.setattr(behaviour_cloning, "_frames", noted)
    recoveries = [replace(demo, behaviour=RECOVERY, extra={TAKEN_OVER: 1}) for demo in DEMOS[10:14]]
    once = settings(num_iterations=1, heldout=0.25)
    train_sft(toy_policy(), [*DEMOS[:8], *recoveries], once, 0, twin=replace)
    held = [(106, "expert"), (107, "expert"), (113, RECOVERY)]
    assert sides[1] == [each for each in held for _ in range(2)]
    assert len(sides[0]) == 18 and not set(sides[0]) & set(sides[1])
    with pytest.raises(ValueError, match=r"sft\.heldout 0.25 of 1 recovery demonstrations is 0"):
        train_sft(toy_policy(), [*DEMOS[:8], recoveries[0]], once, 0)


def test_weight_decay_and_dropout_change_the_weights_and_are_repeatable() -> None:
    def weights(dropout: float, **changes: float) -> torch.Tensor:
        policy = toy_policy()
        policy.config = policy.config.model_copy(update={"dropout": dropout})
        train_sft(policy, DEMOS[:4], settings(num_iterations=20, **changes), 0)
        assert policy.actor.kept is None
        return policy.state_dict()["actor.output.weight"]

    assert not torch.equal(weights(0.0), weights(0.0, weight_decay=0.1))
    assert not torch.equal(weights(0.0), weights(0.5)) and torch.equal(weights(0.5), weights(0.5))


def test_other_data_are_refused() -> None:
    with pytest.raises(ValueError, match="noisy"):
        train_sft(toy_policy(), [replace(DEMOS[0], behaviour="noisy")], settings(), 0)
    with pytest.raises(ValueError, match="got 0"):
        train_sft(toy_policy(), [], settings(), 0)


def test_of_a_recovery_only_what_the_expert_acted_is_learned_and_only_where_the_success_is_his() -> None:
    taken_over = [replace(demo, behaviour=RECOVERY, extra={TAKEN_OVER: 1}) for demo in DEMOS[:3]]
    early = np.zeros_like(DEMOS[0].success)
    early[0] = True
    won_before = replace(taken_over[0], success=early)
    assert demonstrations([DEMOS[0], won_before, *taken_over[1:]], 2, RECOVERY, "sft.recoveries") == taken_over[1:]
    with pytest.raises(ValueError, match=r"sft\.recoveries is 2, but the data hold 1 successful recovery episodes"):
        demonstrations([won_before, taken_over[1]], 2, RECOVERY, "sft.recoveries")
    wrong = replace(taken_over[0], actions=np.concatenate([-DEMOS[0].actions[:1], DEMOS[0].actions[1:]]))
    steps = [int(demo.success.argmax()) for demo in DEMOS[:2]]
    results = [train_sft(toy_policy(), [one, DEMOS[1]], settings(num_iterations=5), 0)
               for one in (taken_over[0], wrong)]
    assert [result.num_samples for result in results] == [steps[0] - 1 + steps[1]] * 2
    np.testing.assert_array_equal(results[0].losses, results[1].losses)


def test_a_policy_relies_less_on_a_value_that_has_noise() -> None:
    dark = [replace(demo, images=np.zeros_like(demo.images)) for demo in DEMOS]
    moved, states = list[float](), np.concatenate([demo.states[:-1] for demo in dark])
    images, beside = np.concatenate([demo.images[:-1] for demo in dark]), states + np.array([0.03, 0, 0])
    for noise in (0.0, 0.5):
        policy = toy_policy()
        train_sft(policy, dark, settings(state_noise_m=noise), 0, noisy=[0])
        here, there = (policy.act(images, seen.astype(np.float32)).actions for seen in (states, beside))
        moved.append(float(np.abs(there - here)[:, 0].mean()))
    assert moved[1] < 0.5 * moved[0]


def test_without_noise_the_values_that_would_have_it_change_nothing() -> None:
    first, second = toy_policy(), toy_policy()
    train_sft(first, DEMOS[:4], settings(num_iterations=5), 0)
    train_sft(second, DEMOS[:4], settings(num_iterations=5), 0, noisy=[0, 1])
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
