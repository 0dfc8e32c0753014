"""Train the action model over discrete tokens by masked prediction. Shapes: B episodes, T steps, S tokens, D bits per
token, K done heads, J tasks."""

import math
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.decoding import choose_codes, code_targets
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.done import bootstrap_masks, done_losses, done_mask
from wm_nodes.world_model.training.dynamics import new_model, state_change_loss
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes

MAX_CORRUPTION = 0.2
"""Share of the tokens of the last given frame that are replaced by random codes; it grows linearly with time, so that
the model meets errors of its own kind."""


def train_token_model(
    tokenizer: Tokenizer, data: LatentEpisodes, config: RunConfig, seed: int, run_dir: Path | None,
    *, spec: EnvironmentSpec | None = None,
) -> tuple[TokenActionModel, dict[str, float]]:
    """Train WM_act over tokens (RS-2a, RS-3, RS-4); returns it with its last metrics. spec: as new_model's."""
    settings = config.world_model
    model = new_model(TokenActionModel, "token_model_init", tokenizer, data, settings, seed, spec)
    heads = bootstrap_masks(len(data), settings.num_done_heads, seed).to(tokenizer.device)

    def loss(iteration: int) -> dict[str, Tensor]:
        rows = numpy_stream(seed, "action_model_batch", iteration).integers(0, len(data), settings.batch_size)
        index = torch.from_numpy(rows).to(tokenizer.device)
        generator = torch_stream(seed, "action_model_mask", iteration)
        with compute_context(tokenizer.device):
            return token_losses(model, data, index, heads[index], generator, settings.done_weight)

    loop = TrainingLoop("action_model", model, settings.num_iterations, settings.learning_rate, run_dir)
    return model, loop.run(loss)


def token_losses(
    model: TokenActionModel, data: LatentEpisodes, index: Tensor, head_mask_BK: Tensor, generator: torch.Generator,
    done_weight: float,
) -> dict[str, Tensor]:
    """Losses of whole episodes with a random part of every next frame masked."""
    bits = data.latents[index].float()
    given, wanted = corrupt(bits[:, :-1], generator), bits[:, 1:]
    decided = ~mask_tokens(tuple(wanted.shape[:3]), generator).to(wanted.device)
    states = data.states[index]
    condition = model.condition(data.actions[index], states[:, :-1], states[:, 1:])
    prediction = model(given, wanted, decided, condition)
    steps = data.step_mask[index].float()
    counted = (~decided).float() * steps.unsqueeze(-1)
    entropies = [
        F.cross_entropy(part.flatten(0, -2), target.flatten(), reduction="none").view(target.shape)
        for part, target in zip(prediction.logits, code_targets(wanted), strict=True)
    ]
    count = counted.sum().clamp_min(1)
    right = (choose_codes(prediction.logits, model.latent_dim)[0] == wanted).all(-1)
    labels = data.success[index][:, 1:].float()
    losses = {
        "tokens": (torch.stack(entropies).sum(0) * counted).sum() / count,
        "done": done_losses(prediction.done_logits_BTKJ, labels, done_mask(data, index, steps, head_mask_BK)),
        "accuracy": (right * counted).sum() / count,
    }
    losses["loss"] = losses["tokens"] + done_weight * losses["done"]
    if model.state_change is not None:
        losses["state_change"] = state_change_loss(model.state_change, data.parts(index, index * 0, wanted.shape[1]))
        losses["loss"] = losses["loss"] + losses["state_change"]
    return losses


def mask_tokens(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """(B, T, S), True where masked: a share cos(pi u / 2), u uniform, of each frame; half of the frames wholly."""
    batch, frames, _ = shape
    share = torch.cos(math.pi / 2 * torch.rand(batch, frames, 1, generator=generator))
    share = torch.where(torch.rand(batch, frames, 1, generator=generator) < 0.5, 1.0, share)
    return torch.rand(shape, generator=generator) < share


def corrupt(bits_BTSD: Tensor, generator: torch.Generator) -> Tensor:
    """Replace tokens by random codes: none in the first frame, up to MAX_CORRUPTION in the last."""
    share = MAX_CORRUPTION * torch.linspace(0, 1, bits_BTSD.shape[1])[None, :, None]
    share = share * torch.rand(len(bits_BTSD), 1, 1, generator=generator)
    replaced = torch.rand(bits_BTSD.shape[:3], generator=generator) < share
    random = torch.where(torch.rand(bits_BTSD.shape, generator=generator) < 0.5, 1.0, -1.0)
    return torch.where(replaced.unsqueeze(-1).to(bits_BTSD.device), random.to(bits_BTSD.device), bits_BTSD)
