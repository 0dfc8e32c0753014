"""World-model folders with fresh weights: whoever needs a model's files and not its quality."""

from pathlib import Path

import torch

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import model_tasks
from wm_nodes.policy_rl.factories import ACTION_DIM, STATE_DIM
from wm_nodes.world_model import Tokenizer, save_model_folder
from wm_nodes.world_model.folder import action_model_class


def make_model_folder(folder: Path, config: RunConfig | None = None) -> Path:
    """Tokenizer and action model of the configuration (smoke by default), untrained, for its scene's tasks."""
    config = config or load_config("smoke")
    tasks = model_tasks(config.task)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tokenizer = Tokenizer(config.tokenizer, 64, 128)
        action = action_model_class(config.tokenizer.kind)(
            config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            action_dim=ACTION_DIM, state_dim=STATE_DIM, num_tasks=len(tasks),
        )
    return save_model_folder(folder, tokenizer, action, None, config, tasks=tasks, story={"made": {"seed": 0}})
