"""What a rollout that stays on the device costs it: kernels, waits and copies."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from pretended_device import Device

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.policy_rl.device_rollout import DeviceCollector
from wm_nodes.policy_rl.factories import (
    make_device_environment,
    make_endogenous_reward,
    make_policy,
    make_training_environment,
    models_of,
)
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.rollouts import TensorRollout, rollout_statistics
from wm_nodes.world_model import DeviceEnvironment

MODEL = shipped_model("reach")
MOST_KERNELS = 530
"""Of a lock-step of the shipped model (4 blocks): 499 in bfloat16, fewer in float32; and 14 that hand over its noise,
starts and results."""


pytestmark = pytest.mark.filterwarnings("ignore:imagined lock-steps run without a CUDA graph")


@pytest.fixture(autouse=True)
def own_models() -> Iterator[None]:
    """Models on a pretended device are of no use after its test."""
    models_of.cache_clear()
    yield
    models_of.cache_clear()


def collected(device: str) -> TensorRollout:
    config = load_config("cpu", {"task": "reach", "device": device, "simulation.max_episode_steps": 3})
    env = make_device_environment(config, MODEL, MODEL / STARTS, num_envs=4)
    collector = DeviceCollector(env, make_policy(config, MODEL), make_endogenous_reward(config, MODEL))
    return collector.collect(7, 0, 1)


def test_the_devices_rollout_has_the_cpus_numbers(device: Device) -> None:
    expected, found = collected("cpu"), collected(device.name)
    for name in ("states_TN", "actions_TN", "rewards_TN", "logprobs_TN"):
        ours, theirs = getattr(expected, name), getattr(found, name).cpu()
        torch.testing.assert_close(theirs, ours, atol=0.02, rtol=0, equal_nan=True, msg=name)  # bfloat16, other batches
    assert torch.equal(found.valid_TN.cpu(), expected.valid_TN) and not expected.valid_TN.all()
    assert rollout_statistics(found).episodes == rollout_statistics(expected).episodes == 4
    assert (np.abs(found.pictures().astype(int) - expected.pictures()).mean()) < 1.0


@pytest.mark.slow
def test_a_lock_step_waits_for_nothing_and_a_rollout_copies_the_same_however_long(device: Device) -> None:
    config = load_config("cpu", {"task": "reach", "device": device.name, "reward.dense_weight": 1.0})
    policy = make_policy(config, MODEL)
    env = make_training_environment(config, MODEL, num_envs=4, seed=0)
    assert isinstance(env, DeviceEnvironment)
    collector = DeviceCollector(env, policy, make_endogenous_reward(config, MODEL))
    assert collector.collect(1, 0, 1).features_TN.device.type == "cuda"
    if device.counts is None:
        return
    counts, costs = device.counts, {}
    for steps in (1, 2, 9):
        counts.reset()
        rollout = collector.collect(steps, 0, 1)
        assert (counts.waits, counts.copies_up, counts.copies_down) == (1, 2, 0), counts.report()
        costs[steps] = counts.kernels
    each = costs[2] - costs[1]
    assert costs[9] - costs[2] == 7 * each
    assert 300 < each <= MOST_KERNELS, counts.report()

    counts.reset()
    rollout_statistics(rollout)
    assert (counts.waits, counts.copies) == (1, 1)
    waits = {}
    for epochs in (1, 3):
        ppo = config.ppo.model_copy(update={"epochs": epochs, "target_kl": 0.0, "minibatch_size": 9})
        learner = PpoLearner(policy, ppo, seed=0)
        counts.reset()
        metrics = learner.update(rollout)
        assert metrics.samples == 36
        waits[epochs] = counts.waits
    assert waits[3] - waits[1] <= 2 * 4, counts.report()
