"""World-model folders with fresh weights: whoever needs a model's files and not its quality."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from video_toys import small_codec

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import model_tasks
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.folder import save_video_folder
from wm_nodes.video_model.success_reader import SuccessReader, save_success_reader
from wm_nodes.world_model import Tokenizer, save_model_folder
from wm_nodes.world_model.folder import action_model_class


def make_model_folder(folder: Path, config: RunConfig | None = None) -> Path:
    """Tokenizer and action model of the configuration (smoke by default), untrained, for its scene's tasks."""
    config = config or load_config("smoke")
    tasks, spec = model_tasks(config.task), simulation_spec(config.task, config.simulation, 1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tokenizer = Tokenizer(config.tokenizer, 64, 128)
        action = action_model_class(config.tokenizer.kind)(
            config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            action_dim=spec.action_dim, state_dim=spec.tool_dim, num_tasks=len(tasks),
        )
    story = {"made": {"seed": 0}}
    return save_model_folder(folder, tokenizer, action, None, config, spec=spec, tasks=tasks, story=story)


def spec_of(config: RunConfig, tokenizer: Tokenizer) -> EnvironmentSpec:
    """The spec of the configured task, in pictures of the tokenizer's size."""
    spec = simulation_spec(config.task, config.simulation, 1)
    return replace(spec, height=tokenizer.height, width=tokenizer.width)


def make_stepped_folder(folder: Path, task: str = "push_cube", **clip: int) -> Path:
    """A video model that goes on from its own frames, of pictures of 64 x 128, and its success reader, untrained."""
    codec = small_codec(16, 64, 128)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = VideoNetwork(NetworkSettings(6, 3, text_dim=4, width=16, depth=2, patch=1, change_std=0.5))
        for parameter in network.parameters():  # what starts at zero makes the network say nothing
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
        reader = SuccessReader(64, 128)
        frames = codec.decode(torch.randn(64, 6, 1, 4, 8)).squeeze(1).permute(0, 3, 1, 2) / 255
    with torch.no_grad():  # so that some frames are read as success
        logits = reader(frames)
        last = reader.layers[-1]
        last.weight *= 4 / logits.std()
        last.bias.copy_(last.bias * 4 / logits.std() - 4 * logits.mean() / logits.std())
    cut = {"stride": 1, "num_conditioning": 1, "given_frames": 4, "new_frames": 2, **clip}
    save_video_folder(folder, codec, network, cut, {"task": task})
    return save_success_reader(folder, reader, task, {})


def write_starts(path: Path) -> Path:
    """Five first frames of 64 x 128 noise and their states."""
    rng = np.random.default_rng(0)
    images, states = rng.integers(0, 256, (5, 64, 128, 3), dtype=np.uint8), rng.uniform(0.5, 0.7, (5, 3))
    save_file({"images": torch.from_numpy(images), "states": torch.from_numpy(states).float()}, path)
    return path
