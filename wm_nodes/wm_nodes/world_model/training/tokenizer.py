"""Train the frame codec (RS-1a). Shapes: B frames, H W 3 image, S tokens, D values per token, P probed values."""

import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig, TokenizerConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.seeding import initial_weights, numpy_stream, torch_stream
from wm_nodes.core.types import FloatArray
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.background import BackgroundBatches
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.positions import probe_targets
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.quantizer import entropy_loss
from wm_nodes.world_model.tokenizer import Tokenizer, make_probe

LATENT_NOISE = 0.1
"""Standard deviation of the noise on continuous latents while training; their own is 1."""
BACKGROUND_FRAMES = 256
FOREGROUND_CONTRAST = 0.25
"""A pixel counts as fully foreground when a channel differs from the background by this much, of [0, 1]."""
WORST_SHARE = 0.02
"""Of a frame's pixels, those with the largest error: about what a small thing takes up."""
SURROUNDINGS_PX = 15
"""About three times an object's width."""


def train_tokenizer(
    episodes: EpisodeArrays, config: RunConfig, seed: int, run_dir: Path | None
) -> tuple[Tokenizer, dict[str, float]]:
    """Train on every recorded frame; returns the tokenizer (averaged weights) and its last metrics.

    Loss: L1 + 2 L2 on pixels, foreground weighed 1 + tokenizer.foreground_weight; a probe that reads object and tool
    positions off the latents, whose gradient reaches the encoder; for lfq the entropy and commitment terms. Where the
    episodes have no ground truth, a probe of recorded_targets, which is not kept, and the worst pixels of each frame
    count too (tokenizer.worst_weight): both keep small things encoded.
    """
    settings = config.tokenizer
    height, width = episodes.images.shape[2:4]
    frames = np.flatnonzero(episodes.frame_mask)
    images = episodes.images.reshape(-1, height, width, 3)
    truth = probed_targets(episodes, states=settings.success_state).reshape(len(images), -1)
    with initial_weights(seed, "tokenizer_init"):
        codec = Tokenizer(settings, height, width, truth.shape[-1])
    _set_statistics(codec, images[frames], truth[frames], seed)
    codec.to(compute_device(config.device))
    recorded = np.zeros((len(images), 0), np.float32)
    recorded_probe: nn.Module | None = None
    trained: nn.Module = codec
    if not episodes.ground_truth.shape[-1]:
        recorded = recorded_targets(episodes).reshape(len(images), -1)
        mean, std = position_statistics(recorded[frames])
        recorded = (recorded - mean) / std
        with initial_weights(seed, "recorded_probe_init"):
            recorded_probe = make_probe(codec.num_tokens * codec.latent_dim, settings, recorded.shape[-1])
        trained = nn.ModuleDict({"tokenizer": codec, "probe": recorded_probe.to(codec.device)})

    def read(iteration: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rows = numpy_stream(seed, "tokenizer_batch", iteration).choice(frames, settings.batch_size)
        generator = torch_stream(seed, "latent_noise", iteration)
        noise = torch.randn((len(rows), codec.num_tokens, codec.latent_dim), generator=generator)
        targets = torch.from_numpy(truth[rows]), torch.from_numpy(recorded[rows])
        return torch.from_numpy(images[rows]), *targets, noise

    batches = BackgroundBatches(read, codec.device)

    def loss(iteration: int) -> dict[str, Tensor]:
        shown, positions, said, noise = batches(iteration)
        pixels = codec.to_pixels(shown)
        with compute_context(codec.device):
            features = codec.features(pixels)
            latents = codec.bottleneck(features)
            noisy = latents + LATENT_NOISE * noise if codec.kind == "continuous" else latents
            reconstruction = codec.decode_pixels(noisy)
            probed = codec.read_state_normalised(noisy)
            spoken = recorded_probe(noisy.flatten(1)).float() if recorded_probe else said
        error = reconstruction - pixels
        weight = foreground_weight(pixels, codec.background, settings)
        errors = error.abs() + 2 * error.square()
        terms = {"pixel": (weight * errors).mean() / weight.mean()}
        terms["probe"] = probe_loss(codec, probed, positions)
        terms["loss"] = terms["pixel"] + settings.probe_weight * terms["probe"]
        if recorded_probe:
            terms["recorded"], terms["worst"] = known_huber(spoken, said), worst_error(errors)
            terms["loss"] = terms["loss"] + settings.probe_weight * terms["recorded"]
            terms["loss"] = terms["loss"] + settings.worst_weight * terms["worst"]
        if codec.kind == "lfq":
            terms["entropy"] = entropy_loss(features)
            terms["commitment"] = (features - latents.detach()).square().mean()
            terms["loss"] = (
                terms["loss"] + settings.entropy_weight * terms["entropy"]
                + settings.commitment_weight * terms["commitment"]
            )
        terms["psnr_db"] = -10 * error.detach().square().mean().log10()
        return terms

    loop = TrainingLoop("tokenizer", trained, settings.num_iterations, settings.learning_rate, run_dir)
    return codec, loop.run(loss)


def foreground_weight(pixels_B3HW: Tensor, median_3HW: Tensor, settings: TokenizerConfig) -> Tensor:
    """(B, 1, H, W): 1 on the background, up to 1 + tokenizer.foreground_weight where a pixel differs from what
    tokenizer.foreground names: the median frame, or the mean of the SURROUNDINGS_PX x SURROUNDINGS_PX pixels around."""
    background = median_3HW
    if settings.foreground == "surroundings":
        side = SURROUNDINGS_PX
        background = F.avg_pool2d(pixels_B3HW, side, stride=1, padding=side // 2, count_include_pad=False)
    contrast = (pixels_B3HW - background).abs().amax(1, keepdim=True) / FOREGROUND_CONTRAST
    return 1 + settings.foreground_weight * contrast.clamp(max=1)


def worst_error(errors_B3HW: Tensor) -> Tensor:
    """Mean error of the WORST_SHARE of each frame's pixels with the largest ones."""
    errors = errors_B3HW.mean(1).flatten(1)
    return errors.topk(max(1, int(WORST_SHARE * errors.shape[1])), dim=1).values.mean()


def recorded_targets(episodes: EpisodeArrays) -> FloatArray:
    """What recordings say of each frame (E, T + 1, A + J) without ground truth: the action taken there, NaN after the
    last step, and whether each task is done. Whoever acts towards a goal shows where it is."""
    acted = np.where(episodes.step_mask[..., None], episodes.actions, np.nan)
    acted = np.pad(acted, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    targets: FloatArray = np.concatenate((acted, episodes.success), -1)
    return targets.astype(np.float32, copy=False)


def success_states(episodes: EpisodeArrays) -> FloatArray:
    """The state of each frame, and the state at the episode's first success (E, T + 1, 2 S): without ground truth the
    nearest to where the tool is and where it should be. The latter is NaN after the success, and where an episode does
    not succeed: its goal was not recorded."""
    done = episodes.success.any(-1) & episodes.frame_mask
    first = done.argmax(1)
    before = done.any(1)[:, None] & (np.arange(done.shape[1]) <= first[:, None])
    reached = episodes.states[np.arange(len(episodes)), first][:, None]
    targets: FloatArray = np.concatenate((episodes.states, np.where(before[..., None], reached, np.nan)), -1)
    return targets.astype(np.float32, copy=False)


def probed_targets(episodes: EpisodeArrays, *, states: bool) -> FloatArray:
    """What a model's own probe learns to read (E, T + 1, P): episode_targets; without ground truth
    success_states, or if not `states` nothing."""
    return success_states(episodes) if states and not episodes.ground_truth.shape[-1] else episode_targets(episodes)


def episode_targets(episodes: EpisodeArrays) -> FloatArray:
    """probe_targets (E, T + 1, P) of episodes, each by the task that it was recorded for; by the first task where that
    is none of `episodes.tasks`. P is 0 where the environment has no ground truth."""
    if not episodes.ground_truth.shape[-1]:
        return episodes.ground_truth
    targets = probe_targets(episodes.ground_truth, episodes.tasks[0])
    for task in episodes.tasks[1:]:
        rows = [recorded == task for recorded in episodes.recorded_tasks]
        targets[rows] = probe_targets(episodes.ground_truth[rows], task)
    return targets


def probe_loss(tokenizer: Tokenizer, probed_BP: Tensor, targets_BP: Tensor) -> Tensor:
    """Huber loss of normalised positions; unknown (NaN) and constant values do not count."""
    return known_huber(probed_BP, (targets_BP - tokenizer.probe_mean) / tokenizer.probe_std)


def known_huber(found: Tensor, wanted: Tensor) -> Tensor:
    """Mean Huber loss (delta 0.5) of the values that are known: wanted is NaN elsewhere. 0 where none is."""
    known = torch.isfinite(wanted)
    losses = F.huber_loss(found, wanted.nan_to_num(), delta=0.5, reduction="none")
    return (losses * known).sum() / known.sum().clamp_min(1)


def _set_statistics(tokenizer: Tokenizer, images: np.ndarray, truth: FloatArray, seed: int) -> None:  # type: ignore[type-arg]
    rows = numpy_stream(seed, "background").choice(len(images), min(BACKGROUND_FRAMES, len(images)), replace=False)
    median = np.median(images[rows].astype(np.float32), 0) / 255
    tokenizer.background.copy_(torch.from_numpy(median.astype(np.float32)).permute(2, 0, 1))
    mean, std = position_statistics(truth)
    tokenizer.probe_mean.copy_(torch.from_numpy(mean))
    tokenizer.probe_std.copy_(torch.from_numpy(std))


def position_statistics(targets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation (P,) of the known among targets (F, P); 0 and 1 where none is known, and 1 where all
    are equal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without a known value
        mean, std = np.nanmean(targets, 0), np.nanstd(targets, 0)
    return np.nan_to_num(mean).astype(np.float32), np.where(std >= 1e-4, std, 1.0).astype(np.float32)
