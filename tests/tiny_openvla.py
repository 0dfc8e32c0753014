"""An OpenVLA checkpoint of the published layout, tiny and random."""

import json
from pathlib import Path

import torch
from safetensors.torch import save_file

from benchmarks.environments.openvla_size import PATCH_PX, Tower, checkpoint

TEXT = {"vocab_size": 512, "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
        "num_attention_heads": 2, "num_key_value_heads": 2, "max_position_embeddings": 128}
SIDE_PX = 28
TOWERS = Tower(16, 32, 3, {"cls_token": 1, "reg_token": 4}, True, 2), Tower(24, 48, 3, {}, False, 2)
"""As DINOv2 with registers, as SigLIP."""


def write_openvla(folder: Path) -> Path:
    """Write config.json, tokenizer.json and two files of weights."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    folder.mkdir(parents=True)
    told = ["In", ":", "What", "action", "should", "the", "robot", "take", "to", "push", "?", "Out", "reach", "a"]
    vocabulary = {word: i for i, word in enumerate(["<s>", "<unk>", *told])}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 0)])
    words.save(str(folder / "tokenizer.json"))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        config, tensors = checkpoint(TEXT, TOWERS, patches=(SIDE_PX // PATCH_PX) ** 2)
    config |= {"model_type": "openvla", "pad_to_multiple_of": 64}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    language = {name for name in tensors if name.startswith("language_model.")}
    save_file({name: t for name, t in tensors.items() if name not in language},
              folder / "model-00001-of-00002.safetensors")
    save_file({name: tensors[name].contiguous() * 3 for name in language}, folder / "model-00002-of-00002.safetensors")
    return folder
