"""Rollouts that stay on the device: the numbers of collect_rollout, and a lock-step that a GPU can capture."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import make_model_folder

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import Rollout
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.policy_rl.device_rollout import DeviceCollector, Step, make_collector, rollout_starts
from wm_nodes.policy_rl.factories import (
    make_device_environment,
    make_endogenous_reward,
    make_imagined_environment,
    make_policy,
    make_reward,
    models_of,
)
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.rollouts import TensorRollout, collect_rollout, rollout_statistics, tensors_of
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.reward import RewardInput, RewardModel, RuleReward
from wm_nodes.world_model import DeviceEnvironment, load_starts, precision

STEPS = 9
MODEL = shipped_model("reach")
COLUMNS = ("states_TN", "actions_TN", "logprobs_TN", "values_TN", "rewards_TN", "terminated_TN", "truncated_TN",
           "valid_TN")
SHORT = {"task": "reach", "simulation.max_episode_steps": 4, "reward.success_threshold": 1e-6}
"""Episodes of the shipped model and an untrained policy that end both ways within a few steps."""


def config_of(preset: str = "cpu", **values: object) -> RunConfig:
    return load_config(preset, SHORT | {name.replace("__", "."): value for name, value in values.items()})


def device_environment(config: RunConfig, num_envs: int, *, fixed: bool | None = None) -> DeviceEnvironment:
    spec = simulation_spec(config.task, config.simulation, num_envs)
    return DeviceEnvironment(
        models_of(MODEL, config.device), spec, load_starts(MODEL / STARTS), config.reward, num_envs=num_envs,
        fixed=fixed,
    )


def collector_of(
    config: RunConfig, num_envs: int, folder: Path = MODEL, reward: RewardModel | None = None
) -> DeviceCollector:
    env = make_device_environment(config, folder, MODEL / STARTS, num_envs=num_envs)
    return DeviceCollector(env, make_policy(config, folder), reward or make_endogenous_reward(config, folder))


def both(config: RunConfig, num_envs: int, folder: Path = MODEL) -> tuple[Rollout, TensorRollout]:
    env = make_imagined_environment(config, folder, MODEL / STARTS, num_envs=num_envs, seed=3)
    reward = make_endogenous_reward(config, folder)
    lockstep = collect_rollout(env, make_policy(config, folder), reward, STEPS, 5, 2)
    return lockstep, collector_of(config, num_envs, folder).collect(STEPS, 5, 2)


def assert_same(lockstep: Rollout, found: TensorRollout) -> None:
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(lockstep, name), err_msg=name)
    pictures, made = found.pictures(), lockstep.valid_TN
    np.testing.assert_array_equal(pictures[:-1], lockstep.images_TN)
    np.testing.assert_array_equal(pictures[1:][made], lockstep.next_images_TN[made])
    np.testing.assert_array_equal(found.next_states_TN.numpy()[made], lockstep.next_states_TN[made])
    np.testing.assert_equal(rollout_statistics(found), rollout_statistics(lockstep))


@pytest.mark.parametrize("fast", [False, True])
def test_a_device_rollout_is_the_lock_step_rollout_bit_for_bit(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "cpu_has_fast_bfloat16", lambda: fast)
    lockstep, found = both(config_of(), 24)
    assert lockstep.terminated_TN.any() and lockstep.truncated_TN.any() and not lockstep.valid_TN.all()
    assert_same(lockstep, found)


def test_too_much_disagreement_truncates_and_pays_nothing() -> None:
    lockstep, found = both(config_of(reward__uncertainty_limit=1e-8), 24)
    assert lockstep.truncated_TN[:2].any()
    assert_same(lockstep, found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "inputs"), [("delta", "latents"), ("abs", "latents"), ("delta", "both"), ("delta", "positions")]
)
def test_the_dense_reward_is_that_of_the_reward_model_and_a_missing_goal_is_missing(mode: str, inputs: str) -> None:
    config = config_of(reward__dense_weight=0.5, reward__mode=mode, reward__goal_threshold=0.99995,
                       reward__dense_clip=0.1, simulation__max_episode_steps=2, policy__inputs=inputs)
    lockstep, found = both(config, 32)
    rewards = lockstep.rewards_TN[lockstep.valid_TN]
    assert len(np.unique(rewards)) > 10
    assert np.isnan(lockstep.rewards_TN[0]).any() and np.isfinite(lockstep.rewards_TN[0]).any()
    assert_same(lockstep, found)


def test_progress_is_that_of_the_reward_model_along_the_golden_trajectory_of_the_start() -> None:
    config = config_of(reward__dense_weight=1.0, reward__mode="progress", reward__goal_threshold=0.5,
                       reward__sparse_weight=0.0, simulation__max_episode_steps=6, reward__success_threshold=1.0)
    reward, policy = make_endogenous_reward(config, MODEL), make_policy(config, MODEL)
    env = make_imagined_environment(config, MODEL, MODEL / STARTS, num_envs=8, seed=3)
    found = make_collector(env, policy, reward)(5, 5, 2)
    assert isinstance(found, TensorRollout) and env.episodes.golden is not None
    golden, starts = env.episodes.golden, rollout_starts(5, 2, 1, 8, 64)[0]
    pictures, valid = found.pictures(), np.ones(8, np.bool_)
    for step in range(5):
        told = reward.evaluate(RewardInput(
            pictures[step], pictures[step + 1], np.zeros(8, np.float32), valid, np.zeros(8, np.float32),
            goals=golden.goals[starts], goal_found=golden.found[starts], golden=golden.frames[starts],
            golden_lengths=golden.lengths[starts],
        ))
        np.testing.assert_allclose(found.rewards_TN[step].numpy(), told.total, atol=1e-6)
    paid = found.rewards_TN[torch.isfinite(found.rewards_TN)]
    assert (paid != 0).any() and paid.max() <= config.reward.dense_clip


def test_progress_is_refused_where_every_step_is_paid_by_itself() -> None:
    config = config_of(reward__dense_weight=1.0, reward__mode="progress")
    with pytest.raises(ValueError, match=r"reward\.mode progress compares with golden .* or choose delta"):
        make_reward(config, MODEL)
    other = device_environment(config_of(reward__dense_weight=1.0), 2)
    with pytest.raises(ValueError, match="this environment was made for another mode"):
        DeviceCollector(other, make_policy(config, MODEL), make_endogenous_reward(config, MODEL))


def test_token_models_take_the_same_path(tmp_path: Path) -> None:
    config = config_of("smoke", tokenizer__kind="lfq", reward__success_threshold=0.1295)
    lockstep, found = both(config, 8, make_model_folder(tmp_path / "model", config))
    assert lockstep.terminated_TN.any() and lockstep.truncated_TN.any()
    assert_same(lockstep, found)


@pytest.mark.slow
@pytest.mark.parametrize("advantage", ["gae", "group"])
def test_training_from_device_rollouts_gives_the_weights_of_the_lock_step_loop(advantage: str) -> None:
    config = config_of(ppo__num_envs=32, ppo__num_steps=STEPS, ppo__updates=2, ppo__value_warmup_updates=0,
                       ppo__advantage=advantage)
    reward, weights, metrics = make_endogenous_reward(config, MODEL), [], []
    for env in (
        make_imagined_environment(config, MODEL, MODEL / STARTS, num_envs=32, seed=0), device_environment(config, 32)
    ):
        policy = make_policy(config, MODEL)
        metrics.append([m for _, m in train_policy(policy, env, reward, config)])
        weights.append(policy.state_dict())
    np.testing.assert_equal([asdict(m) for m in metrics[0]], [asdict(m) for m in metrics[1]])
    assert metrics[0][0].groups_without_signal in (None, 1, 2, 3)
    assert metrics[0][1].epochs > 0 and not torch.equal(
        weights[0]["actor.output.weight"], make_policy(config, MODEL).actor.output.weight
    )
    for name, weight in weights[0].items():
        assert torch.equal(weight, weights[1][name]), name


def test_numpy_and_device_rollouts_become_the_same_tensors_where_they_count() -> None:
    lockstep, found = both(config_of(), 32)
    converted = tensors_of(lockstep, make_policy(config_of(), MODEL))
    needed = converted.needs_bootstrap()
    assert torch.equal(needed, found.needs_bootstrap()) and needed[:-1].any() and needed[-1].any()
    assert torch.equal(converted.features_TN, found.features_TN)
    torch.testing.assert_close(converted.next_features_TN[needed], found.next_features_TN[needed])


def test_memory_of_fixed_shape_gives_the_numbers_of_the_growing_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "cpu_has_fast_bfloat16", lambda: False)
    config = config_of(reward__success_threshold=1.0)
    reward, policy = make_endogenous_reward(config, MODEL), make_policy(config, MODEL)
    fixed, growing = (
        DeviceCollector(device_environment(config, 8, fixed=fixed), policy, reward).collect(STEPS, 5, 2)
        for fixed in (True, False)
    )
    torch.testing.assert_close(fixed.features_TN, growing.features_TN, atol=1e-3, rtol=0)
    torch.testing.assert_close(fixed.actions_TN, growing.actions_TN, atol=1e-5, rtol=0)
    assert torch.equal(fixed.valid_TN, growing.valid_TN)


def test_a_rollout_repeats_and_keeps_its_numbers_while_the_next_is_made() -> None:
    collector = collector_of(config_of(), 8)
    first = collector.collect(STEPS, 5, 2)
    kept = {name: getattr(first, name).clone() for name in COLUMNS}
    assert not torch.equal(collector.collect(STEPS, 5, 3).actions_TN, kept["actions_TN"])
    again = collector.collect(STEPS, 5, 2)
    for name in COLUMNS:
        torch.testing.assert_close(getattr(first, name), kept[name], rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(getattr(again, name), kept[name], rtol=0, atol=0, equal_nan=True)


def test_a_rollout_begins_at_all_starts_and_groups_at_one() -> None:
    many = rollout_starts(0, 1, 2, 1024, 64)
    assert many.shape == (2, 1024) and set(np.unique(many)) == set(range(64))
    np.testing.assert_array_equal(many, rollout_starts(0, 1, 2, 1024, 64))
    assert (many != rollout_starts(0, 2, 2, 1024, 64)).any()
    groups = rollout_starts(0, 1, 2, 1024, 64, 2).reshape(2, -1, 2)
    assert (groups == groups[..., :1]).all() and set(np.unique(groups)) == set(range(64))


def test_given_starts_are_where_episodes_begin() -> None:
    collector = collector_of(config_of(), 2)
    starts = np.full((STEPS, 2), 7)
    starts[:, 1] = 9
    images = load_starts(MODEL / STARTS)[0]
    np.testing.assert_array_equal(collector.collect(STEPS, 0, 1, starts_TN=starts).pictures()[0], images[[7, 9]])
    with pytest.raises(ValueError, match=r"starts_TN must be \(9, 2\) numbers of 0\.\.63, got .* in 0\.\.64"):
        collector.collect(STEPS, 0, 1, starts_TN=np.where(starts == 7, 64, 0))


def test_a_capture_that_fails_is_told_once_and_the_lock_step_runs_as_it_is() -> None:
    def refuse(step: Step) -> Step:
        step()  # as a warm-up leaves the state
        raise RuntimeError("operation not permitted when stream is capturing\nmore lines")

    config = config_of()
    reward, policy, plain = make_endogenous_reward(config, MODEL), make_policy(config, MODEL), collector_of(config, 8)
    with pytest.warns(UserWarning, match="without a CUDA graph, more slowly: operation not permitted .* capturing$"):
        refused = DeviceCollector(device_environment(config, 8), policy, reward, capture=refuse)
    assert torch.equal(refused.collect(STEPS, 5, 2).actions_TN, plain.collect(STEPS, 5, 2).actions_TN)


def test_what_a_capture_returns_is_what_runs() -> None:
    config, runs = config_of(), list[int]()

    def counted(step: Step) -> Step:
        def run() -> None:
            runs.append(1)
            step()

        return run

    DeviceCollector(
        device_environment(config, 2), make_policy(config, MODEL), make_endogenous_reward(config, MODEL),
        capture=counted,
    ).collect(STEPS, 5, 2)
    assert len(runs) == STEPS


@pytest.mark.slow
def test_a_lock_step_is_one_graph_without_breaks() -> None:
    config = config_of()
    collector = DeviceCollector(
        device_environment(config, 2, fixed=True), make_policy(config, MODEL), make_endogenous_reward(config, MODEL)
    )
    collector.collect(1, 0, 1)
    explained = torch._dynamo.explain(collector._step)()
    assert (explained.graph_count, explained.graph_break_count) == (1, 0), explained.break_reasons


def test_a_model_that_predicts_nan_ends_the_rollout() -> None:
    config, (images, states) = config_of(), load_starts(MODEL / STARTS)
    env = DeviceEnvironment(
        models_of(MODEL), simulation_spec("reach", config.simulation, 2), (images, states * np.float32("nan")),
        config.reward, num_envs=2, with_goals=False,
    )
    collector = DeviceCollector(env, make_policy(config, MODEL), make_endogenous_reward(config, MODEL))
    with pytest.raises(FloatingPointError, match="predicted NaN"):
        collector.collect(2, 0, 1)


def test_what_cannot_be_computed_on_the_device_is_refused_with_the_remedy(tmp_path: Path) -> None:
    config = config_of()
    with pytest.raises(ValueError, match="reward rule cannot be computed on the device; use collect_rollout"):
        collector_of(config, 2, reward=RuleReward())
    other = make_policy(config_of("smoke"), make_model_folder(tmp_path / "model", config_of("smoke")))
    with pytest.raises(ValueError, match="encoder is not the tokenizer of the world model; use collect_rollout"):
        DeviceCollector(device_environment(config, 2), other, make_endogenous_reward(config, MODEL))
    with pytest.raises(ValueError, match="steps must be >= 1, got 0"):
        collector_of(config, 2).collect(0, 0, 1)
    env = make_device_environment(config, MODEL, MODEL / STARTS, num_envs=2)
    dense = config_of(reward__dense_weight=1.0)
    with pytest.raises(ValueError, match="dense_weight needs goals"):
        DeviceCollector(env, make_policy(config, MODEL), make_endogenous_reward(dense, MODEL))
