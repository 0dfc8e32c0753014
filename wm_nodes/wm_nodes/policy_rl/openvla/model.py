"""OpenVLA (Prismatic, fused DINOv2 and SigLIP on Llama 2) from a folder in the layout of its checkpoint (RS-10f).

Shapes: B batch, H W 3 image, P patches, L words of the prompt, D width of the language model, A action, V = 256 action
tokens.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import gelu, interpolate

from wm_nodes.policy_rl.action_tokens import NUM_EDGES
from wm_nodes.policy_rl.openvla.vision import VisionTransformer

PROMPT = "In: What action should the robot take to {}?\nOut:"
SPACE = 29871
"""The token that Llama 2's tokenizer makes of the space after "Out:" and that training data had there."""
NORMALISATION = (((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)), ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
"""Mean and standard deviation of pixels in [0, 1], of DINOv2 and of SigLIP."""
NUM_HEADS = (16, 16)
"""Of the two vision transformers, where config.json has no vision_heads."""
TOWERS = ("vision_backbone.featurizer.", "vision_backbone.fused_featurizer.")


class OpenVlaError(ValueError):
    """A folder that holds no OpenVLA checkpoint; says what is missing."""


@dataclass(frozen=True)
class Prompt:
    """What the language model has read."""

    hidden_BD: Tensor
    """At the last token of the prompt, which predicts the first action token."""
    cache: Any
    """Keys and values, to go on from."""


def vocabulary_of(config: Mapping[str, Any]) -> int:
    """Tokens of the language model before the padding of its vocabulary."""
    return int(config["text_config"]["vocab_size"]) - int(config.get("pad_to_multiple_of", 64))


class _Projector(nn.Module):
    def __init__(self, vision: int, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(vision, 4 * vision), nn.Linear(4 * vision, width)
        self.fc3 = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.fc3(gelu(self.fc2(gelu(self.fc1(x)))))
        return out


class OpenVla(nn.Module):
    """The network, its prompt and its vocabulary of actions.

    Attributes:
        width: D.

    Args:
        config: of config.json.
        tensors: of the checkpoint, by name.
        prompt: tokens (L,).

    Raises:
        KeyError, RuntimeError, ValueError, TypeError: what config or tensors lack.
    """

    prompt_L: Tensor

    def __init__(self, config: Mapping[str, Any], tensors: Mapping[str, Tensor], prompt: Sequence[int]) -> None:
        from transformers import LlamaConfig, LlamaForCausalLM

        super().__init__()
        towers = [{name.removeprefix(of): t for name, t in tensors.items() if name.startswith(of)} for of in TOWERS]
        heads = config.get("vision_heads", NUM_HEADS)
        eyes = [VisionTransformer(of, count) for of, count in zip(towers, heads, strict=True)]
        text = LlamaConfig(**config["text_config"])
        self.sides_px, self.width = [one.side_px for one in eyes], int(text.hidden_size)
        self.towers = nn.ModuleList(eyes)
        self.projector = _Projector(sum(one.width for one in eyes), self.width)
        self.language_model: Any = LlamaForCausalLM(text)
        for name in ("projector", "language_model"):
            of = {key.removeprefix(f"{name}."): t for key, t in tensors.items() if key.startswith(f"{name}.")}
            getattr(self, name).load_state_dict(of)
        self.vocabulary = vocabulary_of(config)
        self.register_buffer("prompt_L", torch.tensor(prompt), persistent=False)

    @classmethod
    def load(cls, folder: Path, instruction: str, dtype: torch.dtype = torch.float32) -> Self:
        """Of a folder with config.json, tokenizer.json and *.safetensors. instruction: of the robot, for every picture.

        Raises:
            OpenVlaError: names what the folder lacks.
        """
        from tokenizers import Tokenizer

        lacking = [name for name in ("config.json", "tokenizer.json", "*.safetensors") if not any(folder.glob(name))]
        if lacking:
            raise OpenVlaError(f"{folder} lacks {', '.join(lacking)}; policy.checkpoint is a folder of an OpenVLA "
                               "checkpoint, as published")
        try:
            config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
            tensors = {name: t for file in sorted(folder.glob("*.safetensors")) for name, t in load_file(file).items()}
            ids = tokenizer.encode(PROMPT.format(instruction.lower())).ids
            ids += [SPACE] if ids[-1] != SPACE and vocabulary_of(config) > SPACE else []
            return cls(config, tensors, ids).to(dtype)
        except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
            words = f"{folder} holds no whole OpenVLA checkpoint: {type(error).__name__} {error}; download it again"
            raise OpenVlaError(" ".join(words.split())) from None

    def read(self, images_BHWC: Tensor) -> Prompt:
        """Read pictures, uint8 values (B, H, W, 3) of any float type, and the prompt."""
        found = self.language_model.model(inputs_embeds=self._inputs(images_BHWC), use_cache=True)
        return Prompt(found.last_hidden_state[:, -1], found.past_key_values)

    def generate(self, images_BHWC: Tensor, count: int, choose: Callable[[Tensor, int], Tensor]) -> Tensor:
        """Ids (B, A) of `count` action tokens, each by choose(its logits (B, V), its place) -> place in V, int64 (B,).
        """
        prompt = self.read(images_BHWC)
        hidden, tokens = prompt.hidden_BD, list[Tensor]()
        for place in range(count):
            tokens.append(choose(self._action_logits(hidden), place) + self.first_id)
            if place + 1 < count:
                hidden = self.language_model.model(
                    input_ids=tokens[-1][:, None], past_key_values=prompt.cache, use_cache=True
                ).last_hidden_state[:, -1]
        return torch.stack(tokens, 1)

    def action_logits(self, images_BHWC: Tensor, tokens_BA: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, A, V) of each action token after those before it, float32, and the hidden_BD of read()."""
        before = self.language_model.get_input_embeddings()(tokens_BA[:, :-1])
        inputs = torch.cat([self._inputs(images_BHWC), before], 1)
        hidden = self.language_model.model(inputs_embeds=inputs, use_cache=False).last_hidden_state
        last = hidden[:, -tokens_BA.shape[1] :]
        return self._action_logits(last), last[:, 0]

    @property
    def first_id(self) -> int:
        """Of the V = 256 action tokens, the last of the real vocabulary."""
        return self.vocabulary - NUM_EDGES

    def _action_logits(self, hidden: Tensor) -> Tensor:
        logits: Tensor = self.language_model.lm_head(hidden)[..., self.first_id : self.vocabulary].float()
        return logits

    def _inputs(self, images_BHWC: Tensor) -> Tensor:
        """Embeddings (B, P + L, D): the first token of the prompt, the patches, the rest of the prompt."""
        words = self.language_model.get_input_embeddings()(self.prompt_L).expand(len(images_BHWC), -1, -1)
        features = []
        for tower, side, (mean, std) in zip(self.towers, self.sides_px, NORMALISATION, strict=True):
            pixels = images_BHWC.movedim(-1, 1).float() / 255
            pixels = interpolate(pixels, (side, side), mode="bicubic", antialias=True, align_corners=False).clamp(0, 1)
            shift, scale = (torch.tensor(values, device=pixels.device)[:, None, None] for values in (mean, std))
            features.append(tower(((pixels - shift) / scale).to(words.dtype)))
        return torch.cat([words[:, :1], self.projector(torch.cat(features, -1)), words[:, 1:]], 1)
