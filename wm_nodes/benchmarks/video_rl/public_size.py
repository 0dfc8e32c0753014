"""Public size: memory and time of GRPO on networks of the sizes of public video models.

Shapes: C channels, F latent frames, H W latent grid, K given frames, L text tokens of E values.
"""

import gc
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from rich.table import Table
from torch import Tensor, nn

from benchmarks.experiment import Count, OnDevice, console
from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import CUDA, device_label, synchronize
from wm_nodes.core.seeding import initial_weights
from wm_nodes.reports.console_table import make_table
from wm_nodes.training.checkpoint import optimizer_tensors
from wm_nodes.video_model import (
    Condition,
    RolloutBuffer,
    config_hash,
    initial_noise,
    sample_videos,
    select_steps,
    stochastic_steps,
)
from wm_nodes.video_model.adapters import CosmosVelocity, PublicVelocity, WanVelocity, add_lora
from wm_nodes.video_model.adapters.velocity import package
from wm_nodes.video_rl.grpo import GrpoLearner

PRESET = "paper"
CLIPS = 2
"""Of one context: the fewest whose rewards can differ."""
FRAMES_PER_LATENT = 4
RANK, ALPHA = 32, 64
TOKENS = 512
WARM_UP = 1 + FRAMES_PER_LATENT
"""Frames of the clips before those that count."""
Name = Literal["wan2.1-t2v-1.3b", "wan2.2-ti2v-5b", "cosmos-predict2.5-2b", "tiny-wan", "tiny-cosmos"]


@dataclass(frozen=True)
class Size:
    """A public model without its weights."""

    settings: Mapping[str, Any]
    """Of the diffusers class of its transformer."""
    frames: int
    """Of a video of its card."""
    grid: tuple[int, int]
    """Latent height and width."""
    given: int
    """Latent frames that are given: 1, or 0 of a model of text alone."""
    text_values: int
    """Per token, as its text encoder gives them."""
    cosmos: bool = False
    """CosmosTransformer3DModel; else WanTransformer3DModel."""


WAN = {"attention_head_dim": 128, "text_dim": 4096, "freq_dim": 256, "num_layers": 30}
COSMOS = {
    "in_channels": 17, "out_channels": 16, "num_attention_heads": 16, "attention_head_dim": 128, "num_layers": 28,
    "mlp_ratio": 4.0, "text_embed_dim": 1024, "adaln_lora_dim": 256, "rope_scale": (1.0, 3.0, 3.0),
    "extra_pos_embed_type": None, "use_crossattn_projection": True, "crossattn_proj_in_channels": 100352,
    "encoder_hidden_states_channels": 1024,
}
TINY = {"num_attention_heads": 2, "attention_head_dim": 12, "num_layers": 2}
SIZES: dict[str, Size] = {
    "wan2.1-t2v-1.3b": Size(
        WAN | {"num_attention_heads": 12, "in_channels": 16, "out_channels": 16, "ffn_dim": 8960}, 81, (60, 104), 0,
        4096,
    ),
    "wan2.2-ti2v-5b": Size(
        WAN | {"num_attention_heads": 24, "in_channels": 48, "out_channels": 48, "ffn_dim": 14336}, 121, (44, 80), 1,
        4096,
    ),
    "cosmos-predict2.5-2b": Size(COSMOS, 93, (60, 104), 1, 100352, cosmos=True),
    "tiny-wan": Size(
        WAN | TINY | {"in_channels": 4, "out_channels": 4, "ffn_dim": 32, "text_dim": 8, "freq_dim": 16}, 9, (4, 4), 0,
        8,
    ),
    "tiny-cosmos": Size(
        COSMOS | TINY | {
            "in_channels": 5, "out_channels": 4, "adaln_lora_dim": 4, "text_embed_dim": 8,
            "crossattn_proj_in_channels": 16, "encoder_hidden_states_channels": 8,
        }, 9, (4, 4), 1, 16, cosmos=True,
    ),
}
"""By name; of the published configurations, the last two for a first look without a GPU."""


@dataclass(kw_only=True)
class PublicSize(OnDevice):
    """Memory and time of GRPO on public video models: networks of their real sizes with random bfloat16 weights, LoRA
    of rank 32, gradient checkpointing, preset paper with 2 clips of one context, one video or transition per call.
    """

    models: tuple[Name, ...] = ("wan2.1-t2v-1.3b", "wan2.2-ti2v-5b", "cosmos-predict2.5-2b")
    """Which sizes; no folder is needed."""
    frames: Count | None = None
    """Of a clip, 1 + a multiple of 4, e.g. to shorten it (default: those of the model's card)."""
    steps: Count = 4
    """Sampler steps of a clip that are measured; 2 at least."""
    seed: int = 0
    """Of noise, rewards and the adapter's first weights."""

    def run(self) -> None:
        """Measure model after model, write --json after each, show the table."""
        rows = [row for row in self.read() if "error" not in row]
        for name in self.models:
            frames = self.frames or SIZES[name].frames
            if any((row["model"], row["frames"], row["steps"]) == (name, frames, self.steps) for row in rows):
                continue
            row: dict[str, Any] = {"model": name, "frames": frames, "steps": self.steps}
            try:
                row |= measure_size(SIZES[name], frames, self.steps, self.seed, self.where)
            except Exception as error:  # the other models are worth more than an early end
                row["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]
            free(self.where)
            rows.append(row)
            console.print(", ".join(f"{key} {value}" for key, value in row.items()), highlight=False)
            facts = {"device": device_label(self.where), "preset": PRESET, "seed": self.seed, "rank": RANK}
            self.write({**facts, "clips": CLIPS, "rows": rows}, device=self.device)
        console.print(size_table(rows))


def measure_size(size: Size, frames: int, steps: int, seed: int, device: torch.device) -> dict[str, Any]:
    """Seconds and GiB of rollout and training of one size.

    Raises:
        DeviceError, torch.OutOfMemoryError: it does not fit.
    """
    package("diffusers")
    start = time.perf_counter()
    velocity = random_velocity(size, seed, device)
    facts = {
        "parameters": sum(p.numel() for name, p in velocity.named_parameters() if "lora_" not in name),
        "trained_parameters": sum(p.numel() for p in velocity.parameters() if p.requires_grad),
        "weights_gib": peak_gib(device),
    }
    one_context = {
        "groups.contexts": 1, "groups.group_size": CLIPS, "rollout.num_steps": steps, "rollout.micro_batch": 1,
        "grpo.micro_batch": 1, "grpo.updates_per_buffer": 1,
    }
    config = load_video_config(PRESET, one_context)
    once(velocity, size, config, min(WARM_UP, frames), seed, device)
    found = once(velocity, size, config, frames, seed, device)
    iteration = paper_iteration(found["rollout_s_per_step_clip"], found["train_s_per_transition"])
    return {**facts, **found, **iteration, "measured_in_s": time.perf_counter() - start}


def random_velocity(size: Size, seed: int, device: torch.device) -> PublicVelocity:
    """A network with its adapter, drawn where it computes, in the number formats that diffusers loads it in."""
    diffusers = package("diffusers")
    kind = diffusers.CosmosTransformer3DModel if size.cosmos else diffusers.WanTransformer3DModel
    with default_dtype(torch.bfloat16), initial_weights(seed, "public_size"), device:
        transformer: nn.Module = kind(**size.settings)
    exact = set(kind._keep_in_fp32_modules or ())
    for name, parameter in transformer.named_parameters():
        if exact & set(name.split(".")):
            parameter.data = parameter.data.float()
    transformer.enable_gradient_checkpointing()  # type: ignore[operator]
    velocity = CosmosVelocity(transformer) if size.cosmos else WanVelocity(transformer, fused=bool(size.given))
    add_lora(velocity, RANK, ALPHA, seed=seed)
    return velocity.to(device)


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """What is drawn meanwhile has this number format."""
    standard = torch.get_default_dtype()
    try:
        torch.set_default_dtype(dtype)
        yield
    finally:
        torch.set_default_dtype(standard)


def once(
    velocity: PublicVelocity, size: Size, config: VideoRlConfig, frames: int, seed: int, device: torch.device
) -> dict[str, Any]:
    """Sample the clips of one context, then train on them with random rewards."""
    latent_frames = 1 + (frames - 1) // FRAMES_PER_LATENT
    shape = (velocity.channels, latent_frames, *size.grid)
    clip = torch.arange(CLIPS)
    noise = initial_noise(shape, seed + clip)
    condition = make_condition(velocity, size, latent_frames, device).repeat_interleave(CLIPS)
    learner = GrpoLearner(velocity, config.grpo, config.rollout, seed=seed)
    free(device)
    start = clock(device)
    rollout = sample_videos(velocity.eval(), condition, noise.to(device), clip, config.rollout)
    rollout_s, rollout_gib = clock(device) - start, peak_gib(device)
    condition = condition.to(rollout.latents.device)
    buffer = RolloutBuffer(rollout, condition, clip * 0, clip, {}, learner.version, 0, config_hash(config.rollout))
    rewards = torch.rand(CLIPS, generator=torch.Generator().manual_seed(seed))
    free(device)
    start = clock(device)
    report = learner.train(buffer.with_rewards({"total": rewards}))
    train_s, train_gib = clock(device) - start, peak_gib(device)
    return {
        "latents": list(shape), "given": size.given,
        "tokens": latent_frames * size.grid[0] * size.grid[1] // (velocity.patch[1] * velocity.patch[2]),
        "rollout_gib": rollout_gib, "rollout_s_per_step_clip": rollout_s / (CLIPS * config.rollout.num_steps),
        "train_gib": train_gib, "train_s_per_transition": train_s / report.updates[0].transitions,
        "transitions": report.updates[0].transitions,
        "optimizer_mib": sum(t.nbytes for t in optimizer_tensors(learner._optimizer).values()) / 2**20,
    }


def make_condition(velocity: PublicVelocity, size: Size, latent_frames: int, device: torch.device) -> Condition:
    """Random given frames and text of one context, the text as a public model's Condition keeps it."""
    generator = torch.Generator(device).manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, device=device)

    text = velocity.project_text(normal(1, TOKENS, size.text_values)).float()
    frames = normal(1, velocity.channels, size.given, *size.grid)
    return Condition(frames, frames.new_zeros(1, latent_frames - 1, 0), text)


def paper_iteration(step_s: float, transition_s: float) -> dict[str, float]:
    """What an iteration of the unchanged preset would take by these numbers, without decoding and rewards; computed."""
    config = load_video_config(PRESET)
    groups, grpo, num_steps = config.groups, config.grpo, config.rollout.num_steps
    stochastic = len(stochastic_steps(num_steps, config.window, 0))
    chosen = int(select_steps(stochastic, 1, fraction=grpo.step_fraction, seed=0, iteration=0).sum())
    kept = grpo.advantage.best_of_n or groups.group_size
    step_clips = groups.contexts * groups.group_size * num_steps
    transitions = groups.contexts * kept * chosen * grpo.updates_per_buffer
    return {
        "computed_rollout_h": step_clips * step_s / 3600, "computed_train_h": transitions * transition_s / 3600,
        "computed_iteration_h": (step_clips * step_s + transitions * transition_s) / 3600,
    }


def clock(device: torch.device) -> float:
    synchronize(device)
    return time.perf_counter()


def free(device: torch.device) -> None:
    """Give back what is no longer used, and let the peak begin again."""
    gc.collect()
    if device.type == CUDA:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def peak_gib(device: torch.device) -> float | None:
    """Most memory of tensors on the GPU since free(); None on the CPU."""
    return torch.cuda.max_memory_allocated(device) / 2**30 if device.type == CUDA else None


def size_table(rows: list[dict[str, Any]]) -> Table:
    columns = (
        "model", "parameters, 10^9", "tokens", "rollout, GiB", "s per step and clip", "training, GiB",
        "s per transition", "iteration of the preset, h, computed",
    )
    keys = (
        "rollout_gib", "rollout_s_per_step_clip", "train_gib", "train_s_per_transition", "computed_iteration_h",
    )
    cells = [
        (row["model"], row["error"]) if "error" in row else (
            row["model"], f"{row['parameters'] / 1e9:.2f}", row["tokens"],
            *("-" if row[key] is None else f"{row[key]:.3g}" for key in keys),
        )
        for row in rows
    ]
    return make_table(f"preset {PRESET}, one video or transition per call", columns, cells)
