"""Reads off a robot's picture where the things are that its task names (RS-1f): by spatial soft-argmax keypoints (Finn
et al. 2016, arXiv:1509.06113), and by the commanded tool, which is where the wrist camera is.

Shapes: B images, V cameras, C channels, H W 3 image of all cameras side by side, S commanded state, M values read.
"""

from pathlib import Path

import torch
from torch import Tensor, nn

from wm_nodes.config.object_state import READER
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.training.weights import WeightsError, load_weights_file

CHANNELS, KEYPOINTS, HIDDEN = 32, 64, 256
DILATIONS = (1, 2, 4)
BATCH = 256
SCALE_M = 0.05
"""Of what is read."""
START = "_start_"
"""In the names of values that the picture of a reset shows and later ones do not."""


class ObjectReader(nn.Module):
    """What fills the measured values of a spec's state from its picture and its commanded values, but those that say
    what was at the start.

    Args:
        spec: its cameras are side by side, of equal width.
    """

    def __init__(self, spec: EnvironmentSpec) -> None:
        super().__init__()
        self.height, self.width, self.views = spec.height, spec.width, len(spec.cameras)
        names = spec.state_names
        self.measured = tuple(i for i in spec.measured if START not in names[i])
        self.starts = {i: names.index(names[i].replace(START, "_")) for i in spec.measured if START in names[i]}
        self.commanded = tuple(i for i in range(spec.tool_dim) if i not in spec.measured)
        layers: list[nn.Module] = [nn.Conv2d(3, CHANNELS, 5, stride=2, padding=2), nn.SiLU()]
        for dilation in DILATIONS:
            layers += [nn.Conv2d(CHANNELS, CHANNELS, 3, padding=dilation, dilation=dilation), nn.SiLU()]
        self.maps = nn.Sequential(*layers, nn.Conv2d(CHANNELS, KEYPOINTS, 1))
        self.sharpness = nn.Parameter(torch.ones(()))
        self.read = nn.Sequential(
            nn.Linear(3 * KEYPOINTS * self.views + len(self.commanded), HIDDEN), nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, len(self.measured)),
        )
        self.commanded_mean: Tensor
        self.commanded_scale: Tensor
        self.mean: Tensor
        self.register_buffer("commanded_mean", torch.zeros(len(self.commanded)))
        self.register_buffer("commanded_scale", torch.ones(len(self.commanded)))
        self.register_buffer("mean", torch.zeros(len(self.measured)))

    def forward(self, pixels_B3HW: Tensor, commanded_BS: Tensor) -> Tensor:
        """Values (B, M) in their units, float32; pixels float in [0, 1]."""
        views = torch.cat((2 * pixels_B3HW - 1).chunk(self.views, -1))
        found = keypoints(self.maps(views).float(), self.sharpness.exp())
        scaled = (commanded_BS - self.commanded_mean) / self.commanded_scale
        out: Tensor = self.read(torch.cat((*found.chunk(self.views), scaled), 1))
        return self.mean + SCALE_M * out.float()

    @torch.inference_mode()
    def fill(self, images: UInt8Array, states: FloatArray) -> FloatArray:
        """States (B, P) with the values that are read off uint8 images (B, H, W, 3).

        Raises:
            ValueError: images of another shape.
        """
        if images.shape[1:] != (self.height, self.width, 3):
            raise ValueError(f"images must be (B, {self.height}, {self.width}, 3), got {images.shape}; the object "
                             "reader was trained for another camera set-up")
        filled = states.copy()
        for i in range(0, len(images), BATCH):
            pixels = torch.from_numpy(images[i : i + BATCH]).permute(0, 3, 1, 2).float() / 255
            commanded = torch.from_numpy(states[i : i + BATCH, self.commanded])
            filled[i : i + BATCH, self.measured] = self(pixels, commanded).numpy()
        return filled

    def fill_clip(self, images: UInt8Array, states: FloatArray) -> FloatArray:
        """As fill, of one episode's frames from its first on, off which what was at the start is read, too."""
        filled = self.fill(images, states)
        for start, now in self.starts.items():
            filled[:, start] = filled[0, now]
        return filled


def keypoints(maps_BKHW: Tensor, sharpness: Tensor) -> Tensor:
    """Of each map the expected place of its softmax, x and y in [-1, 1], and its maximum, (B, 3 K)."""
    height, width = maps_BKHW.shape[2:]
    shares = (maps_BKHW.flatten(2) * sharpness).softmax(-1).view_as(maps_BKHW)
    across, down = (torch.linspace(-1, 1, n, device=maps_BKHW.device) for n in (width, height))
    return torch.cat((shares.sum(2) @ across, shares.sum(3) @ down, maps_BKHW.amax((2, 3))), 1)


def reader_of(folder: Path, spec: EnvironmentSpec) -> ObjectReader | None:
    """The reader in a world model's folder, where there is one. Raises as load_object_reader."""
    path = folder / READER
    return load_object_reader(path, spec) if path.is_file() else None


def load_object_reader(path: Path, spec: EnvironmentSpec) -> ObjectReader:
    """Return the reader in a file, for environments of `spec`.

    Raises:
        ValueError: there is no such file, or it is another spec's.
    """
    reader = ObjectReader(spec)
    if not path.is_file():
        raise ValueError(f"simulation.object_state is {path}, and there is no such file; name a world model's "
                         "object_reader.safetensors, or truth, or leave it empty")
    try:
        load_weights_file(reader, path)
    except WeightsError as error:
        raise ValueError(f"{path} is no object reader for {spec.env_id}: {error}") from None
    return reader.eval().requires_grad_(False)
