"""Train the world models by rolling them out. Shapes: B episodes, T steps, S tokens, D values per token, K done heads,
J tasks, P probed values, R decoded frames.

Multi-step training: from real frames the model runs on its own predictions, back-propagating through every step, and is
compared with the recorded frames all along. A frame is real at the start and then every `rollout_steps` steps, at a
phase of its own in each episode, so every recorded frame is used in every iteration whatever the rollout length.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig, WorldModelConfig
from wm_nodes.core.seeding import initial_weights, numpy_stream, torch_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.background import BackgroundBatches
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.dynamics import ActionModel, FrameModel, Prediction
from wm_nodes.world_model.precision import compute_context, has_fast_bfloat16
from wm_nodes.world_model.state_change import StateChange
from wm_nodes.world_model.state_model import state_sizes
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.device_rollout import roll_out_on_device
from wm_nodes.world_model.training.done import bootstrap_masks, done_losses, done_mask
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes, first_frames, tokenise_episodes, tool_moves
from wm_nodes.world_model.training.state_model import train_state_model
from wm_nodes.world_model.training.tokenizer import foreground_weight, probe_loss

M = TypeVar("M", ActionModel, TokenActionModel)

INPUT_NOISE = 0.05
"""Standard deviation of noise on real input frames, against copying tokenizer detail."""
HUBER_DELTA = 0.5
MAX_TOKEN_WEIGHT = 4.0
DECODED_FRAMES = 2
"""Predicted frames of each episode that are decoded and encoded again in an iteration (decoded_losses)."""


@dataclass(frozen=True)
class RolloutTerms:
    """Predictions of frames 1..T."""

    next_latents: Tensor
    """(B, T, S, D)."""
    positions: Tensor
    """(B, T, P) in the probe's units."""
    done_logits: Tensor
    """(B, T, K, J)."""


def train_action_model(
    tokenizer: Tokenizer, episodes: EpisodeArrays | LatentEpisodes, config: RunConfig, seed: int, run_dir: Path | None,
    *, model: ActionModel | None = None, spec: EnvironmentSpec | None = None,
) -> tuple[ActionModel, dict[str, float]]:
    """Train WM_act on episodes of any behaviour; returns the model (averaged weights) and its last metrics.

    Loss (RS-4): world_model.latent_weight * latents + world_model.done_weight * done + world_model.state_weight *
    positions (those the model says, and those the tokenizer's frozen probe reads off the predicted latents) +
    world_model.decoded_weight * decoded_losses, without recoded_state where state_weight is 0. `model` continues from
    given weights (online rounds). spec: as new_model's; the loss of its measured values is state_change_loss, with
    weight 1. A state_model is trained before, alone (train_state_model), and then stays as it is.
    """
    data = episodes if isinstance(episodes, LatentEpisodes) else tokenise_episodes(tokenizer, episodes)
    settings = config.world_model
    if model is None:
        model = new_model(ActionModel, "action_model_init", tokenizer, data, settings, seed, spec)
    tokenizer.requires_grad_(False)
    trained = model
    if trained.state_model is not None:
        train_state_model(trained.state_model, data, settings.state_model_iterations, seed, run_dir)
    heads = bootstrap_masks(len(data), settings.num_done_heads, seed).to(tokenizer.device)
    lengths, moves = data.step_mask.sum(1).cpu(), tool_moves(data).cpu()
    whole = data.actions.shape[1]
    num_steps = min(settings.part_steps or whole, whole)

    def steps_at(iteration: int) -> int:
        return rollout_steps_at(iteration, settings.num_iterations, settings.rollout_steps)

    def read(iteration: int) -> tuple[Tensor, ...]:
        rows = numpy_stream(seed, "action_model_batch", iteration).integers(0, len(data), settings.batch_size)
        index = torch.from_numpy(rows)
        stream = torch_stream(seed, "action_model_part", iteration)
        first = first_frames(lengths[index], moves[index], num_steps, stream)
        generator = torch_stream(seed, "action_model_noise", iteration)
        batch = torch.stack((index, first)), *starts(data, len(rows), num_steps, steps_at(iteration), generator)
        if not settings.decoded_weight:
            return batch
        stream = torch_stream(seed, "action_model_decoded", iteration)
        return *batch, *shown_frames(data, index, first, (lengths[index] - first).clamp(max=num_steps), stream)

    batches = BackgroundBatches(read, tokenizer.device)

    def loss(iteration: int) -> dict[str, Tensor]:
        steps = steps_at(iteration)
        (index, first), noise, anchors, *shown = batches(iteration)
        part = data.parts(index, first, num_steps)
        rows = torch.arange(len(index), device=index.device)
        with compute_context(tokenizer.device):
            terms = unroll(trained, tokenizer, part, rows, noise, anchors, one_pass=min(steps, num_steps) == 1)
            losses = rollout_losses(terms, tokenizer, part, rows, part.step_mask.float(), heads[index], settings)
            if settings.decoded_weight:
                frames, images = shown
                losses |= decoded_losses(terms, tokenizer, part, rows, frames, images, config)
                decoded = losses["pixel"] + losses["recoded"]
                if settings.state_weight:
                    decoded = decoded + losses["recoded_state"]
                losses["loss"] = losses["loss"] + settings.decoded_weight * decoded
            if trained.state_change is not None:
                losses["state_change"] = state_change_loss(trained.state_change, part)
                losses["loss"] = losses["loss"] + losses["state_change"]
            return losses | {"rollout_steps": torch.tensor(float(steps))}

    loop = TrainingLoop("action_model", trained, settings.num_iterations, settings.learning_rate, run_dir)
    return trained, loop.run(loss)


def new_model(
    kind: type[M], stream: str, tokenizer: Tokenizer, data: LatentEpisodes, settings: WorldModelConfig, seed: int,
    spec: EnvironmentSpec | None = None,
) -> M:
    """Return a model with first weights from `stream`, whose condition lets the data's states span [-1, 1].

    spec: of the environment whose measured values the model predicts; None: there are none."""
    with initial_weights(seed, stream):
        model = kind(
            settings, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
            action_dim=data.actions.shape[-1], state_dim=data.states.shape[-1], num_tasks=data.success.shape[-1],
            num_positions=data.truth.shape[-1], **(state_sizes(spec) if spec else {}),
        )
    model.condition.fit_states(data.states.flatten(0, 1))
    for change in (model.state_change, model.state_model):
        if change is not None:
            before, after = data.states[:, :-1][data.step_mask], data.states[:, 1:][data.step_mask]
            change.fit_scale(before, after - before)
    return model.to(tokenizer.device)


def state_change_loss(change: StateChange, part: LatentEpisodes) -> Tensor:
    """Mean Huber loss of the predicted changes of the measured values, from recorded frames and states."""
    states, steps = part.states, part.step_mask.float().unsqueeze(-1)
    found = change(part.latents[:, :-1], part.actions, states[:, :-1])
    errors = F.huber_loss(found, change.wanted(states[:, :-1], states[:, 1:]), reduction="none")
    return (errors * steps).sum() / (steps.sum() * errors.shape[-1]).clamp_min(1)


def rollout_steps_at(iteration: int, num_iterations: int, stages: list[int]) -> int:
    """Imagined steps between real frames at this iteration: the stages in equal shares of the training."""
    return stages[min(len(stages) - 1, iteration * len(stages) // max(1, num_iterations))]


def starts(
    data: LatentEpisodes, batch: int, num_steps: int, rollout_steps: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Noise (B, T, S, D) on real input frames, and anchors (B, T), True where the model goes on from a real frame."""
    noise = torch.randn((batch, num_steps, *data.latents.shape[2:]), generator=generator)
    phase = torch.randint(0, rollout_steps, (batch, 1), generator=generator)
    anchors = (torch.arange(num_steps) + phase) % rollout_steps == 0
    if rollout_steps >= num_steps:
        anchors = torch.zeros_like(anchors)
    anchors[:, 0] = True
    return noise, anchors


def unroll(
    model: ActionModel, tokenizer: Tokenizer, data: LatentEpisodes, index: Tensor, noise: Tensor, anchors: Tensor, *,
    one_pass: bool,
) -> RolloutTerms:
    """Roll the model out over all steps of the episodes `index`, on its own predictions between real frames (see
    starts). `one_pass`: every frame is real."""
    real = data.latents[index].float()
    states, actions = data.states[index], data.actions[index]
    noisy = tokenizer.normalise(real[:, :-1] + INPUT_NOISE * noise)
    condition, told = model.condition(actions, states[:, :-1], states[:, 1:]), model.told(states[:, 1:], states[:, :-1])
    if one_pass:
        prediction = model.predict(noisy, condition, told_BTKJ=told)
        one_step = tokenizer.normalise(noisy + prediction.change_BTSD)
        return RolloutTerms(one_step, prediction.positions_BTQ, prediction.done_logits_BTKJ)
    if wants_few_kernels(noisy.device):
        return roll_out_for_device(model, tokenizer, noisy, anchors, condition, told=told)
    caches = model.trunk.new_caches()

    def predict(t: int, latents: Tensor) -> Prediction:
        now = None if told is None else told[:, t : t + 1]
        return model.predict(latents, condition[:, t : t + 1], caches, told_BTKJ=now)

    def choose_input(t: int, frame: Tensor) -> Tensor:
        return torch.where(anchors[:, t, None, None, None], noisy[:, t : t + 1], frame)

    return roll_out(predict, tokenizer, noisy[:, :1], actions.shape[1], choose_input)


def roll_out(
    predict: Callable[[int, Tensor], Prediction], tokenizer: Tokenizer, first: Tensor, num_steps: int,
    choose_input: Callable[[int, Tensor], Tensor] = lambda t, frame: frame,
) -> RolloutTerms:
    """Predict `num_steps` frames one by one, from latents `first` (B, 1, S, D) of frame 0.

    Args:
        predict: (t, latents of frame t) -> prediction of frame t + 1.
        choose_input: (t, predicted latents of frame t) -> the latents to go on from.
    """
    current, frames, positions, logits = first, list[Tensor](), list[Tensor](), list[Tensor]()
    for t in range(num_steps):
        prediction = predict(t, current)
        frames.append(tokenizer.normalise(current + prediction.change_BTSD))
        positions.append(prediction.positions_BTQ)
        logits.append(prediction.done_logits_BTKJ)
        if t + 1 < num_steps:
            current = choose_input(t + 1, frames[-1])
    return RolloutTerms(torch.cat(frames, 1), torch.cat(positions, 1), torch.cat(logits, 1))


def wants_few_kernels(device: torch.device) -> bool:
    """Say whether training rolls out by roll_out_for_device, which a CPU would be slower at, and round otherwise."""
    return device.type != "cpu"


def roll_out_for_device(
    model: FrameModel, tokenizer: Tokenizer, real: Tensor, anchors: Tensor, condition: Tensor,
    visible: Tensor | None = None, told: Tensor | None = None,
) -> RolloutTerms:
    """roll_out in few kernels: the same numbers to rounding. See device_rollout for the arguments."""
    dtype = torch.bfloat16 if has_fast_bfloat16(real.device) else torch.float32
    return RolloutTerms(*roll_out_on_device(model, tokenizer, real, anchors, condition, dtype, visible, told))


def rollout_losses(
    terms: RolloutTerms, tokenizer: Tokenizer, data: LatentEpisodes, index: Tensor, mask_BT: Tensor,
    head_mask_BK: Tensor, settings: WorldModelConfig,
) -> dict[str, Tensor]:
    """Return the training losses (RS-2 for continuous latents, RS-3, RS-4) of frames 1..T of the episodes `index`.

    mask_BT: 1 where the frame was recorded. head_mask_BK: 1 where head k learns from the episode.
    """
    steps = mask_BT.shape[1]
    target = data.latents[index][:, : steps + 1].float()
    weight = token_weights(target, data.mean_change_S) * mask_BT[..., None]
    errors = F.huber_loss(terms.next_latents, target[:, 1:], delta=HUBER_DELTA, reduction="none").mean(-1)
    losses = {"latent": (errors * weight).sum() / weight.sum()}
    labels = data.success[index][:, 1 : steps + 1].float()
    losses["done"] = done_losses(terms.done_logits, labels, done_mask(data, index, mask_BT, head_mask_BK))
    probed = tokenizer.read_state_normalised(terms.next_latents.flatten(0, 1))
    truth = torch.where(mask_BT[..., None] > 0, data.truth[index][:, 1 : steps + 1], torch.nan).flatten(0, 1)
    losses["state"] = probe_loss(tokenizer, probed, truth)
    losses["position"] = probe_loss(tokenizer, terms.positions.flatten(0, 1), truth)
    state = settings.state_weight * (losses["state"] + losses["position"])
    losses["loss"] = settings.latent_weight * losses["latent"] + settings.done_weight * losses["done"] + state
    return losses


def shown_frames(
    data: LatentEpisodes, index: Tensor, first: Tensor, lengths: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """DECODED_FRAMES random steps (B, 2) of parts of the episodes `index`, and the images (B, 2, H, W, 3) after them.

    Args:
        first, lengths: int (B,), of each part: its first frame, and its recorded steps. All tensors of this function
            are on the CPU.
    """
    share = torch.rand(len(index), DECODED_FRAMES, generator=generator)
    steps = (share * lengths.unsqueeze(1)).long()
    return steps, data.images[index.unsqueeze(1), first.unsqueeze(1) + steps + 1]


def decoded_losses(
    terms: RolloutTerms, tokenizer: Tokenizer, data: LatentEpisodes, index: Tensor, steps_B2: Tensor, images: Tensor,
    config: RunConfig,
) -> dict[str, Tensor]:
    """What the policy will see: some predicted frames of each episode (see shown_frames) are decoded and encoded again.

    pixel: foreground-weighted L1 against the recorded image. recoded: as the latent loss, after the round trip.
    recoded_state: positions that the frozen probe reads after the round trip. Between encoder images, latents that
    predict well may still decode to a blur from which nobody can read positions.
    """
    rows = torch.arange(len(index), device=index.device).unsqueeze(1).expand_as(steps_B2).flatten()
    steps, episodes = steps_B2.flatten(), index[rows]
    wanted = tokenizer.to_pixels(images.flatten(0, 1))
    pixels_R3HW = tokenizer.decode_pixels(terms.next_latents[rows, steps])
    weight = foreground_weight(wanted, tokenizer.background, config.tokenizer)
    recoded = tokenizer.bottleneck(tokenizer.features(pixels_R3HW.clamp(0, 1)))
    errors = F.huber_loss(recoded, data.latents[episodes, steps + 1].float(), delta=HUBER_DELTA, reduction="none")
    probed = tokenizer.read_state_normalised(recoded)
    return {
        "pixel": (weight * (pixels_R3HW - wanted).abs()).mean() / weight.mean(),
        "recoded": errors.mean(),
        "recoded_state": probe_loss(tokenizer, probed, data.truth[episodes, steps + 1]),
    }


def token_weights(latents_BTSD: Tensor, mean_change_S: Tensor) -> Tensor:
    """(B, T, S) weights of the tokens of frames 1..T: up to MAX_TOKEN_WEIGHT where a token has changed, since the first
    frame, more than it does on average."""
    change = (latents_BTSD[:, 1:] - latents_BTSD[:, :1]).abs().mean(-1)
    return 0.5 + 0.5 * (change / mean_change_S.clamp_min(1e-3)).clamp(max=2 * MAX_TOKEN_WEIGHT)
