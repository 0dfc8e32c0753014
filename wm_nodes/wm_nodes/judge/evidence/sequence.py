"""What the object looks like from frame to frame, and where it and the tool are; and a small network that reads it.

See RA-17. The other evidence sums a clip up before anything learns from it. What happens beside a gripper within two
frames is more than these numbers say, so this network sees the object's pictures one after the other, and its answers
are numbers among them. Shapes: B clips, T frames with the reference frame before them, S side of a crop, M numbers of a
frame, K questions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.evidence.motion import Outline
from wm_nodes.judge.evidence.objects import Scene, Target, fill_gaps
from wm_nodes.judge.evidence.segmentation import OBJECT, ROBOT
from wm_nodes.judge.evidence.tracks import SMALLEST_PX, Floats

READS = ("interaction", "deformation", "geometry", "task_completion", "hack/physics")
"""The questions: does it pass, is it done or nearly, is the pattern absent."""
READING = "read_"
"""In front of a question's name, "/" replaced: the network's log-odds among the evidence."""
SIDE_PX, SIDE_SIZES = 40, 4.0
"""Side of a crop around the object, in px and in object sizes."""
FARTHEST, LONGEST_GAP = 10.0, 5.0
"""Numbers end there."""
NUMBERS = (
    "place_down", "place_right", "step_down", "step_right", "tool_down", "tool_right", "tool_step_down",
    "tool_step_right", "gap", "seen", "area", "tall", "wide", "long", "thin", "ring", "hollow", "second", "target",
    "size",
)
"""Of each frame, in object sizes: the object's place against its first one and its step, the tool's place against it
and the tool's step, the gap between them; whether the object is seen, its area against its first one, logarithms of its
outline's measures; robot around it and holes in it; a second object; its distance from the target; its size in 10 px.
"""
RIGHTWARD = tuple(i for i, name in enumerate(NUMBERS) if name.endswith("_right"))
"""Numbers that change their sign in a mirror."""
CHANNELS, CELLS, FEATURES, WIDTH, LAYERS = (24, 32, 48), 25, 64, 128, 4
"""Of the crops' convolutions; cells of the last one; features of a crop; of a frame in time; convolutions in time."""


@dataclass(frozen=True, eq=False)
class ObjectSequence:
    """crops: uint8 (T, S, S, 4), colours and the class of each pixel. numbers: float32 (T, M), finite."""

    crops: UInt8Array
    numbers: FloatArray


def object_sequence(scene: Scene, outline: Outline, pictures: UInt8Array, target: Target | None) -> ObjectSequence:
    """Follow the object. pictures: uint8 (T, H, W, 3), the reference frame first."""
    size, known = scene.size, np.isfinite(outline.area)
    place, hand = fill_gaps(outline.centre), fill_gaps(scene.tool)
    area0 = float(outline.area[known][0]) if known.any() else float(SMALLEST_PX)
    measures = np.concatenate([outline.spread, outline.axes], 1)
    first = measures[int(known.argmax())]
    with np.errstate(invalid="ignore"):
        shape = np.log(measures / first)
    away = np.zeros(len(place)) if target is None else np.minimum(target.distance(place), FARTHEST)
    columns: list[Floats] = [
        (place - place[0]) / size, _steps(place) / size, (hand - place) / size, _steps(hand) / size,
        np.minimum(scene.gap, LONGEST_GAP)[:, None], known[:, None].astype(np.float64),
        (np.nan_to_num(outline.area) / area0)[:, None], shape, outline.ring[:, None], outline.hollow[:, None],
        (scene.thing.second / area0)[:, None], away[:, None], np.full((len(place), 1), size / 10),
    ]
    numbers = np.clip(np.nan_to_num(np.concatenate(columns, 1)), -FARTHEST, FARTHEST).astype(np.float32)
    return ObjectSequence(_crops(pictures, scene.masks, place, SIDE_PX / (SIDE_SIZES * size)), numbers)


def _steps(places: Floats) -> Floats:
    return np.diff(places, axis=0, prepend=places[:1])


def _crops(pictures: UInt8Array, masks: UInt8Array, place: Floats, scale: float) -> UInt8Array:
    crops = np.empty((len(pictures), SIDE_PX, SIDE_PX, 4), np.uint8)
    middle = (SIDE_PX - 1) / 2
    for crop, picture, mask, (row, column) in zip(crops, pictures, masks, place, strict=True):
        moved = np.array([[scale, 0, middle - scale * column], [0, scale, middle - scale * row]])
        size = (SIDE_PX, SIDE_PX)
        crop[..., :3] = cv2.warpAffine(picture, moved, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        crop[..., 3] = cv2.warpAffine(mask, moved, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return crops


class TemporalNetwork(nn.Module):
    """Log-odds that each of READS is answered with yes; 0.35 million weights, 27 million multiplications a clip."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third = CHANNELS
        self.crops = nn.Sequential(
            nn.Conv2d(5, first, 3, 2, 1), nn.ReLU(), nn.Conv2d(first, second, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(second, third, 3, 2, 1), nn.ReLU(), nn.Flatten(), nn.Linear(third * CELLS, FEATURES), nn.ReLU(),
        )
        self.frame = nn.Linear(2 * FEATURES + len(NUMBERS), WIDTH)
        self.norms = nn.ModuleList(nn.GroupNorm(8, WIDTH) for _ in range(LAYERS))
        self.times = nn.ModuleList(nn.Conv1d(WIDTH, WIDTH, 3, padding=1) for _ in range(LAYERS))
        self.drop = nn.Dropout(0.2)
        self.out = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.ReLU(), nn.Dropout(0.3), nn.Linear(WIDTH, len(READS)))
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(len(NUMBERS)))
        self.register_buffer("scale", torch.ones(len(NUMBERS)))

    def forward(self, crops_BTSS4: Tensor, numbers_BTM: Tensor) -> Tensor:
        """(B, K) of uint8 crops and float32 numbers."""
        batch, frames = crops_BTSS4.shape[:2]
        planes = crops_BTSS4.flatten(0, 1).permute(0, 3, 1, 2).contiguous()
        masks = [(planes[:, 3:] == name).float() for name in (ROBOT, OBJECT)]
        pixels = torch.cat((planes[:, :3].float() / 127.5 - 1, *masks), 1)
        seen = self.crops(pixels.contiguous(memory_format=torch.channels_last)).view(batch, frames, -1)
        known = (numbers_BTM - self.mean) / self.scale
        hidden = self.frame(torch.cat((seen, seen - seen[:, :1], known), -1)).transpose(1, 2)
        for norm, time in zip(self.norms, self.times, strict=True):
            hidden = hidden + F.relu(time(self.drop(norm(hidden))))
        answers: Tensor = self.out(torch.cat((hidden.amax(2), hidden.mean(2)), 1))
        return answers

    @torch.inference_mode()
    def log_odds(self, sequence: ObjectSequence) -> FloatArray:
        """(K,) of one clip."""
        both = (sequence.crops, sequence.numbers)
        crops, numbers = (torch.from_numpy(array)[None].to(self.mean.device) for array in both)
        answers: FloatArray = self(crops, numbers)[0].cpu().numpy()
        return answers


def readings(readers: Sequence[TemporalNetwork], sequence: ObjectSequence) -> dict[str, float]:
    """The mean of what the readers answer, by the names that it has among the evidence; nothing without readers."""
    if not readers:
        return {}
    answers = np.mean([reader.log_odds(sequence) for reader in readers], 0)
    return dict(zip(reading_names(), answers.tolist(), strict=True))


def reading_names() -> tuple[str, ...]:
    return tuple(READING + name.replace("/", "_") for name in READS)
