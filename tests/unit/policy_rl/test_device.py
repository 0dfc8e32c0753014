"""Runs go on across devices, too little memory undoes the update, and what collects stays on the CPU."""

from pathlib import Path

import numpy as np
import pytest
import torch
from graph.toy import SIDE_PX
from model_folders import make_model_folder
from pretended_device import Device
from rl_toys import toy_policy, toy_ppo, toy_rollout

from wm_nodes.config.load import load_config
from wm_nodes.core.device import DeviceError
from wm_nodes.core.types import Observation
from wm_nodes.nodes.policy.weights import PolicyHolder
from wm_nodes.policy_rl.factories import make_policy, policy_actor
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.training_run import PolicyTraining
from wm_nodes.training.weights import pack_weights, save_weights

ROLLOUTS = 3


def run_on(device: str, run_dir: Path) -> PolicyTraining:
    """A run of the folder on a device, taken up where it stopped."""
    policy = toy_policy().to(device)
    return PolicyTraining(
        policy, PpoLearner(policy, toy_ppo(), seed=0), run_dir, resume=True, keep_versions=20, metadata={}
    )


@pytest.mark.slow
def test_a_run_goes_on_on_the_other_device_as_if_it_had_stayed(device: Device, tmp_path: Path) -> None:
    rollouts = [toy_rollout(toy_policy(), version) for version in range(ROLLOUTS)]
    weights = []
    for devices in (["cpu"] * ROLLOUTS, ["cpu", device.name, "cpu"], [device.name, "cpu", device.name]):
        folder = tmp_path / "-".join(devices)
        for name, rollout in zip(devices, rollouts, strict=True):
            training = run_on(name, folder)
            training.learner.update(rollout)
            training.progress.updates += 1
            training.progress.version += 1
            training.save()
            assert training.policy.device.type == name
        last = run_on("cpu", folder)
        assert last.updates == ROLLOUTS
        weights.append([tensor.numpy() for tensor in last.policy.state_dict().values()])
    for other in weights[1:]:
        for expected, found in zip(weights[0], other, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_weights_from_the_wire_are_acted_with_on_the_device(device: Device) -> None:
    rng = np.random.default_rng(0)
    learner, actor = toy_policy().to(device.name), toy_policy()
    with torch.no_grad():
        for parameter in learner.parameters():
            parameter.add_(0.1)
    sent = pack_weights(learner)
    for there in (actor, toy_policy().to(device.name)):
        holder = PolicyHolder(there)
        holder.load(sent.data, 3, sent.sha256)
        assert pack_weights(there).data == sent.data
        images = rng.integers(0, 256, (2, SIDE_PX, SIDE_PX, 3), np.uint8)
        output, version = holder.act(images, np.zeros((2, there.state_dim), np.float32), None)
        assert version == 3 and isinstance(output.actions, np.ndarray)


@pytest.mark.parametrize("good_minibatches", [0, 2])
def test_too_little_memory_undoes_the_update_and_names_what_to_lower(good_minibatches: int) -> None:
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(num_envs=64), seed=0)
    rollout, before = toy_rollout(policy, 9), pack_weights(policy).data
    calls = iter(range(1000))

    def grow(gradient: torch.Tensor) -> torch.Tensor:
        if next(calls) >= good_minibatches:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.\nTried to allocate 20.00 GiB.")
        return gradient

    handle = next(policy.critic.parameters()).register_hook(grow)
    with pytest.raises(DeviceError) as caught:
        learner.update(rollout)
    handle.remove()
    assert str(caught.value) == (
        "the memory of cpu is too small; lower ppo.num_envs from 64 to 32, ppo.minibatch_size from 16 to 8, or take a "
        "smaller preset"
    )
    assert pack_weights(policy).data == before and learner.updates == 0
    learner.update(rollout)
    straight = PpoLearner(toy_policy(), toy_ppo(num_envs=64), seed=0)
    straight.update(rollout)
    assert pack_weights(policy).data == pack_weights(straight.policy).data


def test_a_worker_that_collects_computes_on_the_cpu_whatever_the_settings_say(device: Device, tmp_path: Path) -> None:
    config = load_config("smoke", {"device": "cuda"})
    folder, weights = make_model_folder(tmp_path / "model", config), tmp_path / "policy.safetensors"
    policy = make_policy(config, folder)
    assert policy.device.type == "cuda"
    save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
    actors = [policy_actor(config.with_values(device=name), folder, weights, None) for name in ("cpu", "cuda")]
    seen = Observation(
        np.full((1, 64, 128, 3), 90, np.uint8), np.zeros((1, 3), np.float32), np.zeros(1, np.uint64),
        np.zeros(1, np.uint32),
    )
    if device.counts is not None:
        device.counts.reset()
    expected, found = (act(seen, 5) for act in actors)
    np.testing.assert_array_equal(found, expected)
    assert device.counts is None or device.counts.kernels == device.counts.copies == 0, device.counts.report()


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_worker_needs_no_gpu_where_the_run_has_one(tmp_path: Path) -> None:
    config = load_config("smoke")
    folder, weights = make_model_folder(tmp_path / "model", config), tmp_path / "policy.safetensors"
    policy = make_policy(config, folder)
    save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
    policy_actor(config.with_values(device="cuda"), folder, weights)
    with pytest.raises(DeviceError, match="sees no GPU"):
        make_policy(config.with_values(device="cuda"), folder)
