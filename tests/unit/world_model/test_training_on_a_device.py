"""What an iteration of training costs a device, and that it trains there as on the CPU."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from pretended_device import Device
from pushing_scene import episode, stacked_scene

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.decoder import train_decoder
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.training.latent_episodes import tokenise_episodes
from wm_nodes.world_model.training.text import train_text_model

STEPS = 16
ACTION_KERNELS, TEXT_KERNELS = 4430, 4140
"""Most kernels of an iteration at the shipped size, whatever the batch; rollouts of 16 steps. The goal is 3,000."""
TOY = {"tokenizer.width": 32, "world_model.width": 32, "world_model.depth": 2, "world_model.num_heads": 2}


def config_of(device: str, iterations: int, **overrides: Any) -> RunConfig:
    return load_config("cpu_full", {
        "task": "push_cube", "device": device, "world_model.num_iterations": iterations, "world_model.batch_size": 2,
        "world_model.text_num_iterations": iterations, "world_model.rollout_steps": [STEPS],
        "tokenizer.decoder_iterations": iterations,
    } | {key.replace("__", "."): value for key, value in overrides.items()})


def make_episodes() -> EpisodeArrays:
    made = stacked_scene([episode(i, num_steps=STEPS, size=64) for i in range(4)], ("push_cube", "reach"))
    last_only = torch.zeros(made.success.shape, dtype=torch.bool).numpy()
    last_only[:, -1] = True
    return replace(made, behaviours=("expert",) * len(made), success=last_only)


def train(config: RunConfig) -> dict[str, dict[str, float]]:
    """The last metrics of the action model, of the decoder for rollouts and of the text model."""
    episodes = make_episodes()
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer, *episodes.images.shape[2:4]).to(config.device)
    data = tokenise_episodes(tokenizer, episodes)
    action, metrics = train_action_model(tokenizer, data, config, 0, None)
    _, decoder = train_decoder(tokenizer, action, data, config, 0, None)
    text = train_text_model(tokenizer, action, episodes, data, ("push", "reach"), config, 0, None)
    return {"action_model": metrics, "decoder": decoder, "text_model": text[1]}


@pytest.mark.slow
def test_an_iteration_costs_few_kernels_one_wait_and_few_copies(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = device.counts
    if counts is None:
        pytest.skip("a real device does not count")
    found, step = {}, TrainingLoop._step

    def counted(loop: TrainingLoop, loss: Any) -> dict[str, torch.Tensor]:
        counts.reset()
        terms = step(loop, loss)
        found[loop.name] = (counts.kernels, counts.waits, counts.copies_up, counts.copies_down, counts.report())
        return terms

    monkeypatch.setattr(TrainingLoop, "_step", counted)
    train(config_of(device.name, 2))
    for name, most, copies in (("action_model", ACTION_KERNELS, 5), ("text_model", TEXT_KERNELS, 3)):
        kernels, waits, up, down, report = found[name]
        assert kernels <= most, report
        assert (waits, down) == (1, 0), report
        assert up <= copies, report


@pytest.mark.slow
def test_a_device_trains_as_the_cpu_does(device: Device) -> None:
    on_device = train(config_of(device.name, 4, **TOY))
    on_cpu = train(config_of("cpu", 4, **TOY))
    for name, metrics in on_cpu.items():
        assert on_device[name] == pytest.approx(metrics, rel=0.05, abs=1e-3), name
