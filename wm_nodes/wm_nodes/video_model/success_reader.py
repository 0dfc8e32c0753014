"""The other reader of success: whether a picture shows the task done, learned from recordings' labels alone.

It shares nothing with the position probe or the judge, so that a clip that fools one of them is still read by another.
Shapes: B pictures, H W 3 image (cameras side by side), E episodes, F frames.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from wm_nodes.config.tasks import success
from wm_nodes.core.model_folder import ModelFolderError, read_manifest, write_model_folder
from wm_nodes.core.seeding import initial_weights, numpy_stream, torch_stream
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.training.loop import TrainingLoop
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import CODEC, load_module, read_video_manifest
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec
from wm_nodes.world_model.position_probe import PictureReader, halving_convolutions

CHANNELS, HIDDEN = (16, 32, 32, 48), 48
LEARNING_RATE, TRAINING_BATCH, PIXEL_NOISE = 2.0e-3, 96, 0.02
CALIBRATION_SHARE = 0.2
"""Of the training episodes, the last ones: they choose the threshold and are not trained on."""
WEIGHTS, SUCCESS_MANIFEST, FORMAT = "success.safetensors", "success.json", 1


class SuccessReader(PictureReader):
    """A small convolutional classifier of single pictures; `threshold` is the probability from which a task is done."""

    def __init__(self, height: int, width: int, threshold: float = 0.5) -> None:
        super().__init__(height, width)
        self.threshold = threshold
        layers, values = halving_convolutions(CHANNELS, height, width)
        self.layers = nn.Sequential(*layers, nn.Linear(values, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 1))

    def forward(self, pixels_B3HW: Tensor) -> Tensor:
        """Logits (B,); pixels float in [0, 1]."""
        logits: Tensor = self.layers(2 * pixels_B3HW - 1)[:, 0]
        return logits

    def read(self, images: UInt8Array | Tensor) -> FloatArray:
        """Probability (...,) that the task is done in each of uint8 images (..., H, W, 3). Raises ValueError as
        read_values."""
        probabilities: FloatArray = torch.sigmoid(self.read_values(images)).cpu().numpy().reshape(images.shape[:-3])
        return probabilities

    def done(self, images: UInt8Array | Tensor) -> BoolArray:
        """Whether the task is done (...,) in each image."""
        return self.read(images) >= self.threshold


def train_success_reader(
    clips: Clips, codec: TokenizerCodec, num_iterations: int, seed: int, run_dir: Path | None = None
) -> SuccessReader:
    """Train on recorded frames and, as often, on what the codec makes of them; then choose the threshold.

    The threshold makes as many pictures of the calibration episodes done as are labelled so, recorded and decoded ones
    together: there precision is recall, and a success rate has no bias.

    Raises:
        ValueError: fewer than 5 episodes, or none of those to train on, or to calibrate on, shows the task done.
    """
    labels = success(clips.task, clips.ground_truth)
    split = len(clips) - int(CALIBRATION_SHARE * len(clips))
    if split == len(clips) or not labels[:split].any() or not labels[split:].any():
        raise ValueError(f"{len(clips)} episodes, of which {int(labels[:, -1].sum())} end with {clips.task} done, are "
                         "too few to learn from; record more")
    with torch.inference_mode():
        decoded = codec.decode(codec.encode(clips.frames)).cpu()
    frames = torch.stack([clips.frames, decoded])
    height, width = frames.shape[3:5]
    pictures, wanted = frames[:, :split].reshape(-1, height, width, 3), np.tile(labels[:split].reshape(-1), 2)
    with initial_weights(seed, "success_reader_init"):
        reader = SuccessReader(height, width)

    def loss(iteration: int) -> dict[str, Tensor]:
        rows = numpy_stream(seed, "success_reader_batch", iteration).choice(len(pictures), TRAINING_BATCH)
        shown = reader.pixels(pictures[torch.from_numpy(rows)])
        noise = torch.randn(shown.shape, generator=torch_stream(seed, "success_reader_noise", iteration))
        target = torch.from_numpy(wanted[rows]).float()
        return {"loss": F.binary_cross_entropy_with_logits(reader(shown + PIXEL_NOISE * noise), target)}

    TrainingLoop("success_reader", reader, num_iterations, LEARNING_RATE, run_dir).run(loss)
    found = reader.requires_grad_(False).read(frames[:, split:])
    reader.threshold = float(np.quantile(found, 1 - labels[split:].mean()))
    return reader


def score_reader(reader: SuccessReader, frames: Tensor, labels: BoolArray) -> dict[str, float]:
    """Return precision and recall of what is read as done off pictures, uint8 (..., H, W, 3), with labels (...,); NaN
    where nothing is read as done, or nothing is."""
    done = reader.done(frames)
    return {"precision": _mean(labels[done]), "recall": _mean(done[labels])}


def save_success_reader(folder: Path, reader: SuccessReader, task: str, story: Mapping[str, Any]) -> Path:
    """Write the reader into a folder, such as a video model's, with a manifest of its own beside that one.

    story: further entries of the manifest: scores, seed, command.
    """
    packed = pack_weights(reader)
    manifest = {
        "format": FORMAT, "task": task, "threshold": reader.threshold, "height": reader.height, "width": reader.width,
        "sha256": {WEIGHTS: packed.sha256}, **story,
    }
    return write_model_folder(folder, {WEIGHTS: packed.data}, manifest, SUCCESS_MANIFEST)


def load_success_reader(folder: Path, task: str, device: torch.device | str = "cpu") -> SuccessReader:
    """Load and verify the reader of `task`, in evaluation mode.

    Raises:
        ModelFolderError: names the file, what is wrong, and the remedy.
    """
    manifest = read_manifest(folder, "success reader", FORMAT, SUCCESS_MANIFEST)
    if manifest["task"] != task:
        raise ModelFolderError(f"{folder} holds a success reader of {manifest['task']}, not {task}; train one for it")
    reader = SuccessReader(manifest["height"], manifest["width"], manifest["threshold"])
    load_module(folder / WEIGHTS, reader, manifest["sha256"][WEIGHTS])
    return reader.to(device).requires_grad_(False)


def reader_of(folder: Path, task: str, shipped: Path, device: torch.device | str = "cpu") -> SuccessReader | None:
    """The reader in a video model's folder, else one of the task in the folder `shipped` of a world model that was
    trained on what the same codec makes, of clips with the same stride where there is one; None without any."""
    codec, clip = _seen_through(folder)
    places = [place.parent for place in shipped.glob(f"video_model*/{SUCCESS_MANIFEST}")]
    places = sorted((place for place in places if _seen_through(place)[0] == codec and _reads(place) == task),
                    key=lambda place: (_seen_through(place)[1] != clip, place))
    found = [place for place in (folder, *places) if (place / SUCCESS_MANIFEST).is_file()]
    return load_success_reader(found[0], task, device) if found else None


def _reads(folder: Path) -> str:
    """The task of the success reader in a folder."""
    return str(read_manifest(folder, "success reader", FORMAT, SUCCESS_MANIFEST)["task"])


def _seen_through(folder: Path) -> tuple[str, int]:
    """The sha256 of a video model's codec, and the stride of its clips."""
    manifest = read_video_manifest(folder)
    return manifest["sha256"][CODEC], manifest["clip"]["stride"]


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else float("nan")
