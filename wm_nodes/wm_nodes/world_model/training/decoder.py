"""Train a decoder for rollouts, so that imagined frames are sharp (RS-4a). Shapes: E episodes, T steps,
F frames of a batch, H W 3 image, S tokens, D values per token."""

from copy import deepcopy
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional as F

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import initial_weights, numpy_stream, torch_stream
from wm_nodes.training.background import BackgroundBatches
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.dynamics import HUBER_DELTA, unroll
from wm_nodes.world_model.training.latent_episodes import ENCODING_BATCH, LatentEpisodes
from wm_nodes.world_model.training.tokenizer import LATENT_NOISE, foreground_weight

BATCH = 32
LEARNING_RATE = 5.0e-4
RECODED_WEIGHT = 1.0
GRADIENT_PENALTY = 0.01
"""Weight of half the squared norm of the discriminator's gradient, on recorded images and on decoded ones."""


class PatchDiscriminator(nn.Sequential):
    """Scores each patch of an image (F, 3, H, W), higher where it looks recorded: (F, 1, H / 8, W / 8) (PatchGAN)."""

    def __init__(self, width: int) -> None:
        layers: list[nn.Module] = []
        channels = (3, width, 2 * width, 4 * width)
        for before, after in pairwise(channels):
            layers += [nn.Conv2d(before, after, 4, stride=2, padding=1), nn.LeakyReLU(0.2)]
        super().__init__(*layers, nn.Conv2d(channels[-1], 1, 3, padding=1))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def train_decoder(
    tokenizer: Tokenizer, model: ActionModel, data: LatentEpisodes, config: RunConfig, seed: int, run_dir: Path | None
) -> tuple[Tokenizer, dict[str, float]]:
    """Train a copy of the decoder for tokenizer.decoder_iterations; returns a copy of the tokenizer that has it,
    and the last metrics.

    Half of a batch is recorded frames' latents, half those that the model predicts by the recorded actions from the
    first frame on. Loss: foreground-weighted L1; Huber on the latents after decoding and encoding (a perceptual loss,
    the encoder its network); tokenizer.adversarial_weight times the loss against a PatchDiscriminator that learns
    beside it: relativistic, by pairs of a decoded image and its recording, with gradient penalties on both (R3GAN,
    arXiv 2501.05441).
    """
    settings, tokenizer = config.tokenizer, deepcopy(tokenizer)
    imagined = predict_all(tokenizer, model, data)
    episodes, steps = (index.cpu() for index in data.step_mask.nonzero(as_tuple=True))
    with initial_weights(seed, "discriminator_init"):
        discriminator = PatchDiscriminator(32).to(tokenizer.device)

    def read(iteration: int) -> tuple[Tensor, ...]:
        rows = numpy_stream(seed, "decoder_batch", iteration).integers(0, len(episodes), BATCH)
        chosen, generator = (episodes[rows], steps[rows]), torch_stream(seed, "decoder_noise", iteration)
        noise = torch.randn((len(rows), tokenizer.num_tokens, tokenizer.latent_dim), generator=generator)
        return torch.stack(chosen), noise, data.images[chosen[0], chosen[1] + 1]

    batches = BackgroundBatches(read, tokenizer.device)

    def loss(iteration: int) -> dict[str, Tensor]:
        (rows, t), noise, images = batches(iteration)
        recorded = data.latents[rows, t + 1].float()
        half = len(rows) // 2
        latents = torch.cat([recorded[:half] + LATENT_NOISE * noise[:half], imagined[rows[half:], t[half:]].float()])
        wanted, pixels = tokenizer.to_pixels(images), tokenizer.decode_pixels(latents)
        weight = foreground_weight(wanted, tokenizer.background, settings)
        recoded = tokenizer.bottleneck(tokenizer.features(pixels.clamp(0, 1)))
        terms = {
            "pixel": (weight * (pixels - wanted).abs()).mean() / weight.mean(),
            "recoded": F.huber_loss(recoded, recorded, delta=HUBER_DELTA),
        }
        terms["loss"] = terms["pixel"] + RECODED_WEIGHT * terms["recoded"]
        if settings.adversarial_weight:
            background = tokenizer.background
            terms |= adversarial_losses(discriminator, wanted - background, pixels - background)
            adversarial = settings.adversarial_weight * terms["adversarial"]
            terms["loss"] = terms["loss"] + adversarial + terms["discriminator"]
        return terms

    tokenizer.decoder.requires_grad_(True)
    both = nn.ModuleDict({"decoder": tokenizer.decoder, "discriminator": discriminator})
    metrics = TrainingLoop("decoder", both, settings.decoder_iterations, LEARNING_RATE, run_dir).run(loss)
    tokenizer.decoder.requires_grad_(False)
    return tokenizer, metrics


def adversarial_losses(discriminator: PatchDiscriminator, real: Tensor, fake: Tensor) -> dict[str, Tensor]:
    """adversarial: the decoder's loss, which moves no weight of the discriminator. discriminator: its loss, which moves
    no image. real, fake: pairs (F, 3, H, W)."""
    fixed = {name: value.detach() for name, value in discriminator.named_parameters()}
    margin = functional_call(discriminator, fixed, (fake,)) - functional_call(discriminator, fixed, (real,))
    images = torch.cat((real, fake)).detach().requires_grad_(True)
    scores = discriminator(images)
    told, faked = scores.chunk(2)
    (slope,) = torch.autograd.grad(scores.sum(), images, create_graph=True)
    penalty = slope.square().sum((1, 2, 3)).mean()  # half of it, on each of two kinds of images
    return {
        "adversarial": F.softplus(-margin).mean(),
        "discriminator": F.softplus(faked - told).mean() + GRADIENT_PENALTY * penalty,
    }


@torch.no_grad()
def predict_all(tokenizer: Tokenizer, model: ActionModel, data: LatentEpisodes) -> Tensor:
    """Latents of frames 1..T, float16 (E, T, S, D), that the model predicts by recorded actions from first frames."""
    num_steps, pieces = data.actions.shape[1], list[Tensor]()
    for first in range(0, len(data), ENCODING_BATCH):
        rows = torch.arange(first, min(first + ENCODING_BATCH, len(data)), device=data.latents.device)
        noise = torch.zeros((len(rows), num_steps, *data.latents.shape[2:]), device=rows.device)
        anchors = torch.zeros((len(rows), num_steps), dtype=torch.bool, device=rows.device)
        anchors[:, 0] = True
        terms = unroll(model, tokenizer, data, rows, noise, anchors, one_pass=num_steps == 1)
        pieces.append(terms.next_latents.half())
    return torch.cat(pieces)
