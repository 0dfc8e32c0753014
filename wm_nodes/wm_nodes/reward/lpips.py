"""LPIPS (Zhang et al. 2018; RS-5a) from a local folder: a frozen AlexNet or VGG16 with learned channel weights.
Shapes: N images, C channels.

Nothing is downloaded. The folder holds one backbone file with torchvision's parameter names (`features.0.weight`, ...)
and one file of linear weights with the names of the `lpips` package (`lin0.model.1.weight`, ...), as .safetensors, .pth
or .pt: {alexnet,vgg16}*.{safetensors,pth,pt} and lin_{alex,vgg}*, or {alex,vgg}.{...} as that package ships them.
"""

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.reward.distances import check_pair

Backbone = Literal["alex", "vgg"]

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_SUFFIXES = (".safetensors", ".pth", ".pt")
_NAMES: dict[Backbone, tuple[str, str]] = {"alex": ("alexnet*", "alex"), "vgg": ("vgg16*", "vgg")}


class Lpips:
    """Perc(a, b) = sum over layers of mean over pixels of w . (a_hat - b_hat)^2, features normalised over channels.

    layers: the backbone cut after each judged activation. linear_weights: (C,) per layer, >= 0.
    """

    def __init__(self, layers: nn.ModuleList, linear_weights: list[Tensor], name: str) -> None:
        self._layers = layers.eval().requires_grad_(False)
        self._weights = linear_weights
        self.name = name
        self._shift = torch.tensor(_SHIFT).view(1, 3, 1, 1)
        self._scale = torch.tensor(_SCALE).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, images: UInt8Array, others: UInt8Array) -> FloatArray:
        check_pair(images, others)
        first, second = self._input(images), self._input(others)
        total_N = torch.zeros(len(images))
        for layer, weight_C in zip(self._layers, self._weights, strict=True):
            first, second = layer(first), layer(second)
            difference = (_unit(first) - _unit(second)).square()
            total_N = total_N + (difference * weight_C.view(1, -1, 1, 1)).sum(1).mean((1, 2))
        return total_N.numpy()

    def _input(self, images: UInt8Array) -> Tensor:
        tensor = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 127.5 - 1
        return (tensor - self._shift) / self._scale


def alexnet_layers() -> nn.ModuleList:
    """Return AlexNet's convolutions cut after its five activations; children keep torchvision's indices as names."""
    return _cut(
        {
            0: nn.Conv2d(3, 64, 11, stride=4, padding=2), 1: nn.ReLU(), 2: nn.MaxPool2d(3, 2),
            3: nn.Conv2d(64, 192, 5, padding=2), 4: nn.ReLU(), 5: nn.MaxPool2d(3, 2),
            6: nn.Conv2d(192, 384, 3, padding=1), 7: nn.ReLU(),
            8: nn.Conv2d(384, 256, 3, padding=1), 9: nn.ReLU(),
            10: nn.Conv2d(256, 256, 3, padding=1), 11: nn.ReLU(),
        },
        ends=(1, 4, 7, 9, 11),
    )


def vgg16_layers() -> nn.ModuleList:
    """Return VGG16's convolutions cut after the last activation of each of its five groups."""
    modules: dict[int, nn.Module] = {}
    ends, channels = [], 3
    for width, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(count):
            modules[len(modules)] = nn.Conv2d(channels, width, 3, padding=1)
            modules[len(modules)] = nn.ReLU()
            channels = width
        ends.append(len(modules) - 1)
        modules[len(modules)] = nn.MaxPool2d(2, 2)
    return _cut(modules, ends=tuple(ends))


def load_lpips(folder: Path, backbone: Backbone) -> Lpips:
    """Load LPIPS from a folder the user names.

    Raises:
        FileNotFoundError: a file is missing; says which patterns were tried.
        ValueError: a parameter is missing or has another shape, or a linear weight is negative.
        TypeError: a file holds something else than tensors by name.
    """
    backbone_pattern, linear_name = _NAMES[backbone]
    state = _read(_find(folder, (backbone_pattern,)))
    linear = _read(_find(folder, (f"lin_{linear_name}*", linear_name)))
    layers = alexnet_layers() if backbone == "alex" else vgg16_layers()
    weights = []
    for number, layer in enumerate(layers):
        for name, parameter in layer.named_parameters():
            parameter.data = _taken(state, f"features.{name}", tuple(parameter.shape), folder).float()
        convolution = [module for module in layer.modules() if isinstance(module, nn.Conv2d)][-1]
        key = f"lin{number}.model.1.weight"
        weight_C = _taken(linear, key, (1, convolution.out_channels, 1, 1), folder).float().flatten()
        if bool((weight_C < 0).any()):
            raise ValueError(f"{key} in {folder} has negative weights; LPIPS weights are >= 0")
        weights.append(weight_C)
    return Lpips(layers, weights, f"lpips_{backbone}")


def _cut(modules: dict[int, nn.Module], *, ends: tuple[int, ...]) -> nn.ModuleList:
    slices, start = nn.ModuleList(), 0
    for end in ends:
        part = nn.Sequential()
        for index in range(start, end + 1):
            part.add_module(str(index), modules[index])
        slices.append(part)
        start = end + 1
    return slices


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)


def _find(folder: Path, patterns: tuple[str, ...]) -> Path:
    for pattern in patterns:
        for suffix in _SUFFIXES:
            found = sorted(folder.glob(pattern + suffix))
            if found:
                return found[0]
    tried = ", ".join(f"{pattern}{{{','.join(_SUFFIXES)}}}" for pattern in patterns)
    raise FileNotFoundError(f"no {tried} in {folder}; put the weights there or choose another distance")


def _read(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        tensors: dict[str, Tensor] = load_file(path)
        return tensors
    loaded: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(loaded, dict):
        raise TypeError(f"{path} holds a {type(loaded).__name__}, expected a dictionary of tensors")
    return loaded


def _taken(state: dict[str, Tensor], key: str, shape: tuple[int, ...], folder: Path) -> Tensor:
    if key not in state:
        raise ValueError(f"{key} is missing from the weights in {folder}")
    if tuple(state[key].shape) != shape:
        raise ValueError(f"{key} in {folder} has shape {tuple(state[key].shape)}, expected {shape}")
    return state[key]
