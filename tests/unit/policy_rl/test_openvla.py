"""OpenVLA as a policy, on a tiny random checkpoint of the published layout: tokens, likelihood, training."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import make_model_folder, write_starts
from tiny_openvla import write_openvla

from wm_nodes.config.load import load_config
from wm_nodes.core.types import Episode, FloatArray, UInt8Array
from wm_nodes.policy_rl import factories, openvla
from wm_nodes.policy_rl.behaviour_cloning import train_sft
from wm_nodes.policy_rl.openvla.model import OpenVlaError
from wm_nodes.policy_rl.openvla.policy import OpenVlaPolicy, TokenDistribution
from wm_nodes.policy_rl.train import train_policy
from wm_nodes.training.weights import load_weights, pack_weights

pytest.importorskip("peft")
B = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_openvla(tmp_path_factory.mktemp("openvla") / "checkpoint")


@pytest.fixture
def policy(folder: Path) -> OpenVlaPolicy:
    return openvla.make_policy(load_config("smoke", {"policy.checkpoint": str(folder)}))


def pictures(count: int = B) -> UInt8Array:
    return np.random.default_rng(0).integers(0, 256, (count, 64, 128, 3), dtype=np.uint8)


def states(count: int = B) -> FloatArray:
    return np.zeros((count, 3), np.float32)


def test_actions_are_middles_of_bins_and_their_likelihood_is_that_of_their_tokens(policy: OpenVlaPolicy) -> None:
    """Token by token from a cache, or all at once: one law."""
    noise = np.random.default_rng(1).standard_normal((B, 3)).astype(np.float32)
    drawn = policy.act(pictures(), states(), noise=noise)
    best = policy.act(pictures(), states())
    for output in (drawn, best):
        middles = ((output.actions + 1) * 127.5 - 0.5).round() / 127.5 + 1 / 255 - 1
        np.testing.assert_allclose(middles, output.actions, atol=1e-5)
    assert (best.logprobs >= drawn.logprobs - 1e-6).sum() >= B - 1 and not (drawn.actions == best.actions).all()
    again = policy.act(pictures(), states(), noise=noise)
    assert (again.actions == drawn.actions).all() and (again.logprobs == drawn.logprobs).all()
    alone = policy.act(pictures()[1:2], states(1), noise=noise[1:2])
    assert (alone.actions == drawn.actions[1:2]).all()


def test_the_critic_reads_what_the_likelihood_has_read(policy: OpenVlaPolicy) -> None:
    output, inputs = policy.act(pictures(), states()), (policy.features(pictures()), torch.zeros(B, 3))
    np.testing.assert_allclose(output.values, policy.value(*inputs).detach().numpy(), atol=1e-5)


def test_noise_draws_from_the_law(policy: OpenVlaPolicy) -> None:
    """Quantiles at equal steps hit every first token as often as it is likely."""
    count = 2000
    distribution = policy.distribution(policy.features(np.repeat(pictures(1), count, 0)), torch.zeros(count, 3))
    noise = torch.special.ndtri((torch.arange(count).double() + 0.5) / count)[:, None].repeat(1, 3)
    with torch.no_grad():
        actions = distribution.executed(noise)
        tokens = torch.from_numpy(policy._tokenizer.encode(actions.numpy()))
        likely = distribution.log_probabilities(tokens[:1].repeat(count, 1))[0, 0].exp()
    shares = torch.bincount(tokens[:, 0] - policy.actor.first_id - 1, minlength=255) / count
    np.testing.assert_allclose(shares.numpy(), likely.numpy(), atol=2 / count)


def test_an_actions_likelihood_is_that_of_all_tokens_that_are_executed_so(policy: OpenVlaPolicy) -> None:
    """1 is cloned, 254/255 is executed: their two tokens are one."""
    ids = policy.actor.first_id + torch.arange(256)[:, None]
    images = torch.from_numpy(pictures(1)[:, :, :64].repeat(256, 0))
    actions = torch.from_numpy(policy._tokenizer.decode(ids.numpy()))
    law = TokenDistribution(policy.actor, policy._tokenizer, images, 1)
    with torch.no_grad():
        raw_V = policy.actor.action_logits(images[:1], ids[:1])[0][0, 0].softmax(-1)
        found, of_one = law.logprob(actions).exp(), law.logprob(torch.ones(256, 1)).exp()
    torch.testing.assert_close(found, (actions == actions.T).float() @ raw_V)
    assert found[0] == found[1] == of_one[0] and len(actions.unique()) == 255
    torch.testing.assert_close(found[1:].sum(), torch.tensor(1.0))


def test_the_picture_is_the_leftmost_square_and_the_instruction_is_read(folder: Path, policy: OpenVlaPolicy) -> None:
    first = policy.act(pictures(), states())
    right, left = pictures(), pictures()
    right[:, :, 64:] = 0
    left[:, :, :64] = 0
    assert (policy.act(right, states()).logprobs == first.logprobs).all()
    assert not np.allclose(policy.act(left, states()).logprobs, first.logprobs, atol=1e-4)
    other = openvla.make_policy(load_config("smoke", {"policy.checkpoint": str(folder), "task": "reach"}))
    assert not np.allclose(other.act(pictures(), states()).logprobs, first.logprobs, atol=1e-4)


def test_entropy_and_kl_are_those_of_the_tokens(policy: OpenVlaPolicy) -> None:
    reference = policy.clone()
    with torch.no_grad():
        for name, tensor in policy.named_parameters():
            if "lora_B" in name:
                tensor.normal_(0, 0.3)
    features = policy.features(pictures())
    own, other = (one.distribution(features, torch.zeros(B, 3)) for one in (policy, reference))
    actions = torch.from_numpy(policy.act(pictures(), states()).actions)
    with torch.no_grad():
        own.logprob(actions)
        assert ((own.entropy() > 0) & (own.entropy() < 3 * np.log(256))).all() and (own.kl(other) > 0).all()
        same = policy.distribution(features, torch.zeros(B, 3))
        assert own.kl(same).abs().max() < 1e-5
    with pytest.raises(ValueError, match="ask for their logprob first"):
        policy.distribution(features, torch.zeros(B, 3)).entropy()


def test_weights_are_lora_and_value_head_and_a_clone_shares_the_rest(folder: Path, policy: OpenVlaPolicy) -> None:
    names = policy.state_dict().keys()
    assert names and all("lora_" in name or name.startswith("critic.") for name in names)
    assert sum("vision" in name or "towers" in name for name in names) and any("lm_head" in name for name in names)
    reference, shared = policy.clone(), dict(policy.named_parameters())
    for name, parameter in reference.named_parameters():
        assert (parameter is shared[name]) == (name not in names), name
    config = load_config("smoke", {"policy.checkpoint": str(folder), "seed": 1})
    other = openvla.make_policy(config)
    first = policy.act(pictures(), states())
    assert not np.allclose(other.act(pictures(), states()).values, first.values)
    load_weights(other, pack_weights(policy).data)
    assert (other.act(pictures(), states()).values == first.values).all()
    with pytest.raises(KeyError, match="another policy"):
        other.load_state_dict({})


def test_cloning_makes_demonstrated_tokens_likely(policy: OpenVlaPolicy) -> None:
    config = load_config("smoke").sft.with_values(num_iterations=60, batch_size=8, learning_rate=1e-2)
    actions = np.tile(np.float32([[0.5, -0.25, 0.0]]), (5, 1))
    demo = Episode(
        images=pictures(6), states=states(6), actions=actions, ground_truth=np.zeros((6, 0), np.float32),
        success=np.arange(6) == 5, rewards=np.zeros(5, np.float32), terminated=True, truncated=False, task="push_cube",
        instruction="", behaviour="expert", seed=0, episode_id=0, source=1,
    )
    found = train_sft(policy, [demo], config, 0)
    assert found.losses[-5:].mean() < 0.3 * found.losses[:5].mean()
    assert np.abs(policy.act(pictures(6)[:5], states(5)).actions - [0.5, -0.25, 0.0]).max() < 0.01


@pytest.mark.parametrize("advantage", ["gae", "group"])
def test_ppo_and_grpo_train_it_in_the_world_model(folder: Path, tmp_path: Path, advantage: str) -> None:
    settings = {"policy.checkpoint": str(folder), "ppo.advantage": advantage, "ppo.updates": 2, "ppo.group_size": 2,
                "reward.dense_weight": 0.0, "reward.success_threshold": 0.1, "ppo.num_envs": 4, "ppo.minibatch_size": 8}
    config = load_config("smoke", settings)
    model = make_model_folder(tmp_path / "model")
    policy = factories.make_policy(config, model)
    base = {name: t.clone() for name, t in policy.named_parameters() if name not in policy.state_dict()}
    before = copy.deepcopy(policy.state_dict())
    env = factories.make_imagined_environment(config, model, write_starts(tmp_path / "starts"), num_envs=4, seed=0)
    metrics = [one for _, one in train_policy(policy, env, factories.make_reward(config, model), config)]
    assert len(metrics) == 2 and all(np.isfinite([m.loss_policy, m.entropy, m.kl_reference]).all() for m in metrics)
    assert metrics[0].approx_kl < 1e-3, "the likelihood that acted is that of the first minibatch"
    assert any(not torch.equal(before[name], t) for name, t in policy.state_dict().items())
    assert all(torch.equal(base[name], t) for name, t in policy.named_parameters() if name in base)


def test_the_fastest_training_environment_is_one_that_shows_it_pictures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Device rollouts hand on features of the world model's tokenizer, which it does not see by."""
    monkeypatch.setattr(factories, "compute_device", lambda name: torch.device("meta"))
    monkeypatch.setattr(factories, "make_imagined_environment", lambda *_, **__: "pictures")
    monkeypatch.setattr(factories, "make_device_environment", lambda *_, **__: "features")
    for checkpoint, shown in ((str(folder), "pictures"), ("", "features")):
        config = load_config("smoke", {"policy.checkpoint": checkpoint})
        assert factories.make_training_environment(config, tmp_path, num_envs=1, seed=0) == shown


def test_what_a_folder_lacks_is_named(tmp_path: Path, folder: Path) -> None:
    config = load_config("smoke", {"policy.checkpoint": str(tmp_path)})
    with pytest.raises(OpenVlaError, match=r"lacks config.json, tokenizer.json, \*.safetensors"):
        factories.make_policy(config, None)
    for name in ("config.json", "tokenizer.json", "model-00001-of-00002.safetensors"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with pytest.raises(OpenVlaError, match="no whole OpenVLA checkpoint"):
        factories.make_policy(config, None)
