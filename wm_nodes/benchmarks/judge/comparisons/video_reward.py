"""VideoAlign's own reward from a local folder: Qwen2-VL, three reward tokens, a linear head. Nothing is downloaded.

Known from its public code (KwaiVGI/VideoAlign): the last hidden states at the tokens of VQ, MQ and TA go through a
linear head with three outputs, of which the token's own is taken; each is normalised by the mean and deviation in
`model_config.json`; Overall is their sum; clips are read at 2 frames per second. The published file is a pickle with
LoRA weights: merge it and save it as safetensors first, the head under the name `rm_head.weight`.

The folder holds config.json, *.safetensors, the tokenizer with its special tokens, preprocessor_config.json,
model_config.json, and prompt.txt: the detailed template that the weights were trained with, {text_prompt} in it, copied
by the user from the public repository. Another wording gives other numbers. Inferred: pictures are scaled to the
multiples of 28 px nearest to their size within the folder's pixel limits, as the image processor of the library does.

Shapes: T frames, P patches, D features, L tokens.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch import Tensor

from wm_nodes.core.optional import optional_package
from wm_nodes.judge.agent.profiles import uniform
from wm_nodes.judge.agent.types import ClipRef, TaskSpec

DIMENSIONS = ("VQ", "MQ", "TA")
REWARD_TOKENS = tuple(f"<|{name}_reward|>" for name in DIMENSIONS)
VIDEO_TOKEN = "<|video_pad|>"
HEAD = "rm_head.weight"
VIDEO_FPS = 2.0
VIDEO_TYPE = 2
"""Of mm_token_type_ids: 0 text, 1 image, 2 video."""
MIN_PIXELS, MAX_PIXELS = 3136, 12845056
"""Of the library's image processor, where the folder names none."""


@dataclass(frozen=True)
class VideoPatches:
    """How frames become patches; the values of preprocessor_config.json."""

    patch_px: int
    merge: int
    temporal: int
    min_pixels: int
    max_pixels: int
    mean: tuple[float, ...]
    std: tuple[float, ...]


class VideoReward:
    """Scores clips; see load_video_reward."""

    def __init__(
        self, model: Any, head: Tensor, tokenizer: Any, pictures: VideoPatches, prompt: str, scales: Mapping[str, float]
    ) -> None:
        self._model, self._head, self._tokenizer = model.eval().requires_grad_(False), head, tokenizer
        self._pictures, self._prompt, self._scales = pictures, prompt, scales

    @torch.no_grad()
    def score(self, clip: ClipRef, task: TaskSpec) -> dict[str, float]:
        """VQ, MQ, TA and Overall, in units of the deviation over the authors' data; more is better."""
        count = max(self._pictures.temporal, math.ceil(clip.duration_s * VIDEO_FPS))
        frames = torch.from_numpy(clip.frames[uniform(len(clip.frames), count)])
        patches, grid = to_patches(frames, self._pictures)
        ids = self._token_ids(task.instruction, int(grid.prod()) // self._pictures.merge**2)
        types = torch.where(ids == self._id(VIDEO_TOKEN), VIDEO_TYPE, 0)
        output = self._model(
            input_ids=ids, attention_mask=torch.ones_like(ids), pixel_values_videos=patches, video_grid_thw=grid[None],
            mm_token_type_ids=types,
        )
        raw = F.linear(output.last_hidden_state[0].float(), self._head)
        scores = {}
        for column, (name, token) in enumerate(zip(DIMENSIONS, REWARD_TOKENS)):
            (place,) = (ids[0] == self._id(token)).nonzero()[:, 0].tolist()
            mean, deviation = self._scales[f"{name}_mean"], self._scales[f"{name}_std"]
            scores[name] = (float(raw[place, column]) - mean) / deviation
        return {**scores, "Overall": sum(scores.values())}

    def _token_ids(self, instruction: str, num_video_tokens: int) -> Tensor:
        """(1, L), the chat with as many video tokens as the model makes of the clip."""
        content = [{"type": "video"}, {"type": "text", "text": self._prompt.replace("{text_prompt}", instruction)}]
        text = self._tokenizer.apply_chat_template(
            [{"role": "user", "content": content}], tokenize=False, add_generation_prompt=True
        )
        text = text.replace(VIDEO_TOKEN, VIDEO_TOKEN * num_video_tokens)
        return torch.tensor([self._tokenizer(text, add_special_tokens=False)["input_ids"]])

    def _id(self, token: str) -> int:
        return int(self._tokenizer.convert_tokens_to_ids(token))


def load_video_reward(folder: Path) -> VideoReward:
    """Load the reward from a local folder.

    Raises:
        ValueError: a file, token, weight or entry is missing; names it.
        MissingPackageError: transformers is not installed.
    """
    for name in ("config.json", "preprocessor_config.json", "model_config.json", "prompt.txt"):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}; see wm_nodes/benchmarks/judge/comparisons/video_reward.py")
    transformers = optional_package("transformers", needed_by="VideoAlign's weights need", requirements="video.txt")
    prompt = (folder / "prompt.txt").read_text(encoding="utf-8")
    wanted = ("{text_prompt}", *REWARD_TOKENS)
    if missing := [part for part in wanted if prompt.count(part) != 1]:
        raise ValueError(f"{folder / 'prompt.txt'} must hold {', '.join(missing)} once; copy the detailed template")
    scales = json.loads((folder / "model_config.json").read_text(encoding="utf-8")).get("inference_config") or {}
    if lost := [f"{n}_{part}" for n in DIMENSIONS for part in ("mean", "std") if f"{n}_{part}" not in scales]:
        raise ValueError(f"{folder / 'model_config.json'} lacks {', '.join(lost)} in inference_config")
    head = _head(folder)
    try:
        tokenizer = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True)
        model, info = transformers.Qwen2VLForConditionalGeneration.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{folder} cannot be loaded as Qwen2-VL: {error}") from None
    if unknown := [token for token in (*REWARD_TOKENS, VIDEO_TOKEN) if token not in tokenizer.get_vocab()]:
        raise ValueError(f"the tokenizer of {folder} lacks {', '.join(unknown)}; take the one of the reward model")
    if info["missing_keys"]:
        raise ValueError(f"{folder} lacks weights: {', '.join(sorted(info['missing_keys'])[:3])}; merge the LoRA first")
    width = model.config.text_config.hidden_size
    if head.shape != (len(DIMENSIONS), width):
        raise ValueError(f"{HEAD} must be {(len(DIMENSIONS), width)}, got {tuple(head.shape)}")
    return VideoReward(model.model, head, tokenizer, _pictures(folder), prompt, scales)


def to_patches(frames: Tensor, pictures: VideoPatches) -> tuple[Tensor, Tensor]:
    """uint8 (T, H, W, 3) as Qwen2-VL's patches (P, 3 temporal patch^2) and their grid (time, rows, columns).

    The last frame is repeated until the number of frames is a multiple of `temporal`.
    """
    patch, merge, pair = pictures.patch_px, pictures.merge, pictures.temporal
    height, width = fit_size(frames.shape[1], frames.shape[2], pictures)
    pixels = frames.permute(0, 3, 1, 2).float()
    pixels = F.interpolate(pixels, (height, width), mode="bicubic", antialias=True).round().clamp(0, 255) / 255
    mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in (pictures.mean, pictures.std))
    pixels = (pixels - mean) / std
    pixels = torch.cat([pixels, pixels[-1:].repeat(-len(pixels) % pair, 1, 1, 1)])
    times, rows, columns = len(pixels) // pair, height // patch, width // patch
    parts = pixels.reshape(times, pair, 3, rows // merge, merge, patch, columns // merge, merge, patch)
    parts = parts.permute(0, 3, 6, 4, 7, 2, 1, 5, 8)
    return parts.reshape(times * rows * columns, 3 * pair * patch * patch), torch.tensor([times, rows, columns])


def fit_size(height: int, width: int, pictures: VideoPatches) -> tuple[int, int]:
    """The size in px: multiples of patch x merge, nearest to the frame's, within the limits at its proportions."""
    unit = pictures.patch_px * pictures.merge
    rows, columns = (max(unit, round(side / unit) * unit) for side in (height, width))
    if rows * columns > pictures.max_pixels:
        scale = math.sqrt(height * width / pictures.max_pixels)
        rows, columns = (max(unit, math.floor(side / scale / unit) * unit) for side in (height, width))
    elif rows * columns < pictures.min_pixels:
        scale = math.sqrt(pictures.min_pixels / (height * width))
        rows, columns = (math.ceil(side * scale / unit) * unit for side in (height, width))
    return rows, columns


def _pictures(folder: Path) -> VideoPatches:
    settings = json.loads((folder / "preprocessor_config.json").read_text(encoding="utf-8"))
    size = settings.get("size") or {}
    return VideoPatches(
        settings.get("patch_size", 14), settings.get("merge_size", 2), settings.get("temporal_patch_size", 2),
        settings.get("min_pixels", size.get("shortest_edge", MIN_PIXELS)),
        settings.get("max_pixels", size.get("longest_edge", MAX_PIXELS)),
        tuple(settings["image_mean"]), tuple(settings["image_std"]),
    )


def _head(folder: Path) -> Tensor:
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, "pt") as file:
            if HEAD in file.keys():  # noqa: SIM118, a file is no mapping
                head: Tensor = file.get_tensor(HEAD).float()
                return head
    raise ValueError(f"no *.safetensors of {folder} holds {HEAD}; save the reward head beside the model's weights")
