"""Low-rank adapters on a public model's attention, through peft. Adapter off is the base model: kl.anchor lora_off."""

from pathlib import Path

import torch

from wm_nodes.video_model.adapters.velocity import PublicVelocity, package, tuner_layers

TARGETS = ("to_q", "to_k", "to_v", "to_out.0")
"""Attention projections of Wan's and Cosmos's blocks."""


def add_lora(model: PublicVelocity, rank: int, alpha: float | None = None, *, seed: int = 0) -> None:
    """Add an adapter in place, which starts as no change; it alone trains afterwards, in float32.

    Args:
        alpha: the adapter is scaled by alpha / rank; None: 1.
        seed: of its first weights.
    """
    if rank < 1:
        raise ValueError(f"lora.rank must be >= 1, got {rank}")
    if tuner_layers(model):
        raise ValueError("this model has a LoRA adapter already")
    config = package("peft").LoraConfig(
        r=rank, lora_alpha=rank if alpha is None else alpha, target_modules=list(TARGETS), lora_dropout=0.0
    )
    with torch.random.fork_rng(devices=[]):  # the weights are drawn on the CPU, then moved
        torch.manual_seed(seed)
        model.transformer.add_adapter(config)
    for name, parameter in model.named_parameters():
        parameter.requires_grad_("lora_" in name)
        if "lora_" in name:
            parameter.data = parameter.data.float()


def save_lora(model: PublicVelocity, folder: Path) -> None:
    """Write the adapter as safetensors that diffusers' pipelines load too (load_lora_adapter)."""
    if not tuner_layers(model):
        raise ValueError("this model has no LoRA adapter to save")
    model.transformer.save_lora_adapter(folder, safe_serialization=True)
