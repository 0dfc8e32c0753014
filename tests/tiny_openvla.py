"""An OpenVLA checkpoint of the published layout, tiny and random."""

import json
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

TEXT = {"vocab_size": 512, "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 2, "max_position_embeddings": 128}
SIDE_PX, PATCH_PX, DEPTH = 28, 14, 3
TOWERS = {"featurizer": (16, ("cls_token", "reg_token"), True), "fused_featurizer": (24, (), False)}
"""Width, tokens before the patches, LayerScale: as DINOv2 with registers, as SigLIP."""


def write_openvla(folder: Path) -> Path:
    """Write config.json, tokenizer.json and two files of weights."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import LlamaConfig, LlamaForCausalLM

    folder.mkdir(parents=True)
    told = ["In", ":", "What", "action", "should", "the", "robot", "take", "to", "push", "?", "Out", "reach", "a"]
    vocabulary = {word: i for i, word in enumerate(["<s>", "<unk>", *told])}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 0)])
    words.save(str(folder / "tokenizer.json"))
    config = {"model_type": "openvla", "text_config": TEXT, "pad_to_multiple_of": 64, "vision_heads": [2, 2]}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        eyes = {f"vision_backbone.{name}.{key}": tensor for name, (width, tokens, scaled) in TOWERS.items()
                for key, tensor in vision_tensors(width, tokens, scaled).items()}
        vision = sum(width for width, _, _ in TOWERS.values())
        sizes = {"fc1": (vision, 4 * vision), "fc2": (4 * vision, 32), "fc3": (32, 32)}
        for name, (inputs, outputs) in sizes.items():
            eyes[f"projector.{name}.weight"] = torch.randn(outputs, inputs) * inputs**-0.5
            eyes[f"projector.{name}.bias"] = torch.zeros(outputs)
        language = LlamaForCausalLM(LlamaConfig(**TEXT)).state_dict()
    save_file(eyes, folder / "model-00001-of-00002.safetensors")
    save_file({f"language_model.{name}": tensor.contiguous() * 3 for name, tensor in language.items()},
              folder / "model-00002-of-00002.safetensors")
    return folder


def vision_tensors(width: int, tokens: tuple[str, ...], scaled: bool) -> dict[str, Tensor]:
    """Of one vision transformer by timm's names, with what a Prismatic model does not use."""
    hidden, patches = 2 * width, (SIDE_PX // PATCH_PX) ** 2
    found = {
        "patch_embed.proj.weight": torch.randn(width, 3, PATCH_PX, PATCH_PX) * 0.04,
        "patch_embed.proj.bias": torch.randn(width), "pos_embed": torch.randn(1, patches, width),
        "norm.weight": torch.ones(width), "norm.bias": torch.zeros(width),
    } | {name: torch.randn(1, 1 if name == "cls_token" else 4, width) for name in tokens}
    for i in range(DEPTH):
        for norm in ("norm1", "norm2"):
            found[f"blocks.{i}.{norm}.weight"] = torch.rand(width) + 0.5
            found[f"blocks.{i}.{norm}.bias"] = torch.randn(width) * 0.1
        for name, (inputs, outputs) in {"attn.qkv": (width, 3 * width), "attn.proj": (width, width),
                                        "mlp.fc1": (width, hidden), "mlp.fc2": (hidden, width)}.items():
            found[f"blocks.{i}.{name}.weight"] = torch.randn(outputs, inputs) * inputs**-0.5
            found[f"blocks.{i}.{name}.bias"] = torch.randn(outputs) * 0.1
        if scaled:
            for name in ("ls1", "ls2"):
                found[f"blocks.{i}.{name}.scale_factor"] = torch.rand(width)
    return found
