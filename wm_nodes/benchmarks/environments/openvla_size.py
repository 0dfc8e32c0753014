"""Memory and arithmetic of OpenVLA as a policy at its published size; on a GPU also its time, with random weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.experiment import Count, OnDevice, console
from benchmarks.video_rl.public_size import clock, default_dtype, free, peak_gib
from wm_nodes.config.load import load_config
from wm_nodes.core.device import CPU
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.openvla.model import OpenVla
from wm_nodes.policy_rl.openvla.policy import OpenVlaPolicy
from wm_nodes.reports.console_table import make_table

TASK = "push"
PROMPT_TOKENS = 24
"""Of an instruction of the scenes, as Llama 2's tokenizer splits it."""
LLAMA_2: dict[str, Any] = {
    "vocab_size": 32064, "hidden_size": 4096, "intermediate_size": 11008, "num_hidden_layers": 32,
    "num_attention_heads": 32, "num_key_value_heads": 32,
}
REPEATS = 3


@dataclass(frozen=True)
class Tower:
    """A vision transformer of the checkpoint, by timm's names."""

    width: int
    """Of a patch's features."""
    hidden: int
    """Of its MLPs."""
    depth: int
    """Blocks, with the last one, which a Prismatic model does not use."""
    tokens: Mapping[str, int]
    """How many before the patches, by name."""
    scaled: bool
    """LayerScale."""
    num_heads: int = 16
    """Of attention."""


DINO = Tower(1024, 4096, 24, {"cls_token": 1, "reg_token": 4}, True)
SIGLIP = Tower(1152, 4304, 27, {}, False)
PATCH_PX, PATCHES = 14, 256


@dataclass(kw_only=True)
class OpenVlaSize(OnDevice):
    """Memory and arithmetic of OpenVLA-7B as a policy (policy.checkpoint), counted on the network without weights; on a
    GPU also memory and time, with random bfloat16 weights: actions of a batch of pictures, and a step of training."""

    pictures: Count = 4
    """Of a batch that is measured on a GPU."""
    seed: int = 0
    """Of the adapter."""

    def run(self) -> None:
        where = self.where
        row: dict[str, float | None] = dict(counted(published(torch.device("meta"), self.seed)))
        if where.type != CPU:
            row |= measured(published(where, self.seed), self.pictures, where)
        self.write({"rows": [row], "seed": self.seed, "pictures": self.pictures}, device=self.device)
        lines = [(name, f"{value:.4g}") for name, value in row.items()]
        console.print(make_table("OpenVLA-7B as a policy", ("quantity", "value"), lines))


def checkpoint(
    text: dict[str, Any], towers: tuple[Tower, Tower], patches: int = PATCHES
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """config.json and random tensors of a checkpoint, on the default device in the default number format."""
    from transformers import LlamaConfig, LlamaForCausalLM

    tensors = {f"language_model.{name}": t for name, t in LlamaForCausalLM(LlamaConfig(**text)).state_dict().items()}
    vision, width = sum(tower.width for tower in towers), text["hidden_size"]
    for name, inputs, outputs in (("fc1", vision, 4 * vision), ("fc2", 4 * vision, width), ("fc3", width, width)):
        tensors |= _linear(f"projector.{name}", inputs, outputs)
    for place, tower in zip(("featurizer", "fused_featurizer"), towers, strict=True):
        tensors |= {f"vision_backbone.{place}.{name}": t for name, t in _of_tower(tower, patches).items()}
    return {"text_config": dict(text), "vision_heads": [tower.num_heads for tower in towers]}, tensors


def _of_tower(tower: Tower, patches: int) -> dict[str, Tensor]:
    width = tower.width
    found = {
        "patch_embed.proj.weight": torch.randn(width, 3, PATCH_PX, PATCH_PX) * 0.04,
        "patch_embed.proj.bias": torch.randn(width), "pos_embed": torch.randn(1, patches, width),
        "norm.weight": torch.ones(width), "norm.bias": torch.zeros(width),
    } | {name: torch.randn(1, count, width) for name, count in tower.tokens.items()}
    for i in range(tower.depth):
        at = f"blocks.{i}"
        for norm in ("norm1", "norm2"):
            found |= {f"{at}.{norm}.weight": torch.rand(width) + 0.5, f"{at}.{norm}.bias": torch.randn(width) * 0.1}
        for name, inputs, outputs in (
            ("attn.qkv", width, 3 * width), ("attn.proj", width, width), ("mlp.fc1", width, tower.hidden),
            ("mlp.fc2", tower.hidden, width),
        ):
            found |= _linear(f"{at}.{name}", inputs, outputs)
        if tower.scaled:
            found |= {f"{at}.{name}.scale_factor": torch.rand(width) + 0.5 for name in ("ls1", "ls2")}
    return found


def _linear(name: str, inputs: int, outputs: int) -> dict[str, Tensor]:
    return {f"{name}.weight": torch.randn(outputs, inputs) * inputs**-0.5, f"{name}.bias": torch.randn(outputs) * 0.1}


def published(device: torch.device, seed: int) -> OpenVlaPolicy:
    """The policy of the published size in bfloat16 on a device; on `meta` without weights."""
    settings = load_config("cpu", {"task": TASK, "simulation.scenes": "train"})
    with default_dtype(torch.bfloat16), device:
        config, tensors = checkpoint(LLAMA_2, (DINO, SIGLIP))
        network = OpenVla(config, tensors, [1] * PROMPT_TOKENS)
        return OpenVlaPolicy(network, settings.policy, configured_spec(settings), seed=seed)


def counted(policy: OpenVlaPolicy) -> dict[str, float]:
    """Of one picture, in one pass over its prompt and its action tokens; multiplications and additions are two."""
    parameters, trained = list(policy.parameters()), [p for p in policy.parameters() if p.requires_grad]
    kept = dict[int, torch.UntypedStorage]()

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage._cdata] = storage
        return tensor

    shapes: Any = FakeTensorMode(allow_non_fake_inputs=True)  # transformers does not ask it for numbers
    saved = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
    with shapes, FlopCounterMode(display=False) as forward, saved:
        loss = _loss(policy, 1)
    with shapes, FlopCounterMode(display=False) as backward:
        loss.backward()  # type: ignore[no-untyped-call]
    of_weights = {shapes.from_tensor(p).untyped_storage()._cdata for p in parameters}
    activations = sum(storage.nbytes() for place, storage in kept.items() if place not in of_weights)
    return {
        "parameters": sum(p.numel() for p in parameters), "trained": sum(p.numel() for p in trained),
        "weights_gib": sum(p.nbytes for p in parameters) / 2**30,
        "gradients_and_adam_gib": 3 * sum(p.nbytes for p in trained) / 2**30,
        "kept_for_backward_gib_per_picture": activations / 2**30,
        "forward_tflop_per_picture": forward.get_total_flops() / 1e12,
        "backward_tflop_per_picture": backward.get_total_flops() / 1e12,
    }


def measured(policy: OpenVlaPolicy, pictures: int, device: torch.device) -> dict[str, float | None]:
    """Seconds a picture to act and to train, the median of REPEATS after one, and GiB at the peaks."""
    images = np.zeros((pictures, policy.side, policy.side, 3), np.uint8)
    states = np.zeros((pictures, policy.state_dim), np.float32)
    noise = np.zeros((pictures, policy.action_dim), np.float32)
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=1e-4)

    def train() -> None:
        _loss(policy, pictures).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    found = dict[str, float | None]()
    for name, run in (("act", lambda: policy.act(images, states, noise=noise)), ("train", train)):
        free(device)
        seconds = list[float]()
        for _ in range(1 + REPEATS):
            start = clock(device)
            run()
            seconds.append(clock(device) - start)
        found |= {f"{name}_s_per_picture": median(seconds[1:]) / pictures, f"{name}_gib": peak_gib(device)}
    return found


def _loss(policy: OpenVlaPolicy, pictures: int) -> Tensor:
    """What a gradient step needs of a batch: the likelihood of actions, and values."""
    device = next(policy.parameters()).device
    features = torch.zeros(pictures, policy.side * policy.side * 3, device=device)
    network = policy.actor
    assert isinstance(network, OpenVla)
    tokens = torch.full((pictures, policy.action_dim), network.first_id, device=device)
    states = torch.zeros(pictures, policy.state_dim, device=device)
    law = policy.distribution(features, states)
    return law.log_probabilities(tokens).mean() + policy.value_beside(law, features, states).mean()
