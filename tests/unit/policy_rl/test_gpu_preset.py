"""The preset gpu of loop 1: its size, and that it runs on a device at a size for tests."""

from pathlib import Path

import torch
from model_folders import spec_of
from pretended_device import Device
from pushing_scene import episode, stacked_scene
from safetensors.torch import save_file
from torch import nn

from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.device_rollout import DeviceCollector
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_policy, make_training_environment
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.world_model import ActionModel, Tokenizer, save_model_folder
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.training.latent_episodes import tokenise_episodes
from wm_nodes.world_model.training.tokenizer import train_tokenizer

TOY = {
    "simulation.max_episode_steps": 4, "tokenizer.width": 32, "tokenizer.depth": 1, "tokenizer.num_iterations": 2,
    "tokenizer.batch_size": 4, "world_model.width": 32, "world_model.depth": 2, "world_model.num_heads": 2,
    "world_model.num_iterations": 4, "world_model.batch_size": 2, "ppo.num_envs": 4, "ppo.num_steps": 4,
    "ppo.minibatch_size": 8, "ppo.value_warmup_updates": 0,
}


def test_the_environment_has_about_65_million_parameters_and_1024_places() -> None:
    config = load_config("gpu")
    with torch.device("meta"):
        tokenizer = Tokenizer(config.tokenizer, config.simulation.image_size, 2 * config.simulation.image_size)
        action = ActionModel(
            config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim, action_dim=3,
            state_dim=3, num_tasks=2,
        )
    assert 60e6 < parameters(tokenizer) + parameters(action) < 70e6
    assert (config.device, config.simulation.image_size, config.ppo.num_envs) == ("cuda", 128, 1024)


def test_it_trains_a_model_and_a_policy_on_a_device(device: Device, tmp_path: Path) -> None:
    config = load_config("gpu", {"task": "push_cube", "device": device.name, "simulation.cameras": ["side"]} | TOY)
    tasks = ("push_cube", "reach")
    episodes = stacked_scene([episode(i, num_steps=4, size=128) for i in range(4)], tasks)
    tokenizer, _ = train_tokenizer(episodes, config, 0, None)
    action, _ = train_action_model(tokenizer, tokenise_episodes(tokenizer, episodes), config, 0, None)
    folder = save_model_folder(
        tmp_path / "model", tokenizer, action, None, config, spec=spec_of(config, tokenizer), tasks=tasks, story={},
    )
    starts = {"images": torch.from_numpy(episodes.images[:, 0].copy()),
              "states": torch.from_numpy(episodes.states[:, 0].copy())}
    save_file(starts, folder / "starts.safetensors")
    policy, reward = make_policy(config, folder), make_endogenous_reward(config, folder)
    env = make_training_environment(config, folder, num_envs=4, seed=0)
    rollout = DeviceCollector(env, policy, reward).collect(config.ppo.num_steps, 0, 1)
    before = [parameter.clone() for parameter in policy.parameters()]
    assert rollout.images is not None
    assert rollout.images.shape[2] == 128 and rollout.images.device.type == "cuda"
    PpoLearner(policy, config.ppo, seed=0).update(rollout)
    assert any(not torch.equal(old, new) for old, new in zip(before, policy.parameters(), strict=True))


def parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
