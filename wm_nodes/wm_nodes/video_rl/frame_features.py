"""Features of pictures for diversity (DD-19). Each kind has a name, which is reported with every number.

Shapes: N frames, H W 3 image, D features. A backbone comes from a local folder; nothing is downloaded.
"""

from pathlib import Path
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.core.device import device_of
from wm_nodes.core.model_folder import read_json
from wm_nodes.core.seeding import torch_stream
from wm_nodes.video_model.adapters.packages import package
from wm_nodes.world_model import Tokenizer

BATCH = 64
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
RANDOM_WIDTH = 32


class FrameFeatures(Protocol):
    """uint8 (N, H, W, 3) -> float32 (N, D)."""

    @property
    def name(self) -> str: ...

    def __call__(self, frames: Tensor) -> Tensor: ...


class CentredPixels:
    """Pixels less their frame's mean colour, so that a shared background does not hide what moves."""

    name = "centred pixels, no learned backbone"

    def __call__(self, frames: Tensor) -> Tensor:
        pixels = frames.float() / 255
        return (pixels - pixels.mean((1, 2), keepdim=True)).flatten(1)


class RandomFeatures:
    """Two convolutions of fixed random weights, averaged over 4 x 4 parts of the picture."""

    name = "random convolutions, no learned backbone"

    def __init__(self, seed: int = 0) -> None:
        generator = torch_stream(seed, "random_features")
        self._first = torch.randn(RANDOM_WIDTH, 3, 5, 5, generator=generator) / (3 * 25) ** 0.5
        self._second = torch.randn(RANDOM_WIDTH, RANDOM_WIDTH, 3, 3, generator=generator) / (RANDOM_WIDTH * 9) ** 0.5

    def __call__(self, frames: Tensor) -> Tensor:
        pixels = frames.permute(0, 3, 1, 2).float() / 127.5 - 1
        hidden = F.relu(F.conv2d(pixels, self._first.to(pixels.device), stride=2, padding=2))
        hidden = F.relu(F.conv2d(hidden, self._second.to(pixels.device), stride=2, padding=1))
        return F.adaptive_avg_pool2d(hidden, 4).flatten(1)


class TokenizerFeatures:
    """Encoder output of a world model's frozen tokenizer less its mean over the picture."""

    def __init__(self, tokenizer: Tokenizer, name: str) -> None:
        self._tokenizer, self.name = tokenizer, f"frozen tokenizer of {name}"

    @torch.no_grad()
    def __call__(self, frames: Tensor) -> Tensor:
        parts = torch.split(frames, BATCH)  # type: ignore[no-untyped-call]
        tokens = torch.cat([self._tokenizer.features(self._tokenizer.to_pixels(part)) for part in parts])
        return (tokens - tokens.mean(1, keepdim=True)).flatten(1)


class BackboneFeatures:
    """The pooled output of a vision transformer of the transformers library, e.g. DINOv2 or DINOv3.

    Frames are scaled to the model's own picture size and normalised with the folder's mean and deviation.
    """

    def __init__(self, model: nn.Module, size: int, mean: tuple[float, ...], std: tuple[float, ...], name: str) -> None:
        self._model, self._size, self.name = model.eval().requires_grad_(False), size, name
        device = device_of(model)
        self._mean, self._std = (torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (mean, std))

    @torch.no_grad()
    def __call__(self, frames: Tensor) -> Tensor:
        parts = torch.split(frames, BATCH)  # type: ignore[no-untyped-call]
        return torch.cat([self._pool(part) for part in parts])

    def _pool(self, frames: Tensor) -> Tensor:
        pixels = frames.to(self._mean.device).permute(0, 3, 1, 2).float() / 255
        pixels = F.interpolate(pixels, (self._size, self._size), mode="bicubic", antialias=True).clamp(0, 1)
        output: Any = self._model(pixel_values=(pixels - self._mean) / self._std)
        pooled: Tensor | None = getattr(output, "pooler_output", None)
        return (output.last_hidden_state[:, 0] if pooled is None else pooled).float()


def load_backbone(folder: Path, device: torch.device | str = "cpu") -> BackboneFeatures:
    """Load a vision backbone (config.json, model.safetensors, preprocessor_config.json if there) from a local folder,
    onto `device`.

    Raises:
        ValueError: no config.json there, weights are missing or of another shape, or the model takes no pictures.
        MissingPackageError: transformers is not installed.
    """
    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} has no config.json; give the folder of a vision model, e.g. DINOv3, as downloaded")
    auto_model = package("transformers").AutoModel
    try:
        model, info = auto_model.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, trust_remote_code=False, output_loading_info=True
        )
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{folder} cannot be loaded as a vision model: {error}") from None
    lost = sorted(set(info["missing_keys"]) | set(map(str, info.get("mismatched_keys", ()))))
    if lost:
        kind = model.config.model_type
        raise ValueError(f"{folder} lacks weights of {kind}: {', '.join(lost[:3])}; download it again")
    size = getattr(model.config, "image_size", None)
    if not isinstance(size, int):
        raise ValueError(f"{folder} holds a {model.config.model_type}, which takes no pictures; give a vision model")
    path = folder / "preprocessor_config.json"
    settings = read_json(path, "copy the whole folder again") if path.is_file() else {}
    mean, std = settings.get("image_mean", IMAGENET_MEAN), settings.get("image_std", IMAGENET_STD)
    name = f"{model.config.model_type} of {folder.name}"
    return BackboneFeatures(model.to(device), size, tuple(mean), tuple(std), name)
