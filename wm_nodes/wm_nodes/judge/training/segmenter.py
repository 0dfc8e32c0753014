"""Train the segmenter of the embedded judge on simulator masks (RA-17).

Only clips whose masks say what is seen: recorded ones, mild edits, edited states, and edits of the whole picture;
none that a world model imagined.
"""

import math
from collections.abc import Iterable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from wm_nodes.core.device import CPU_DEVICE
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.dataset.edits.recipes import RECIPES
from wm_nodes.judge.dataset.policy_camera import IMAGINED
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.training.data import SetClip

FRAMES_PER_CLIP = 4
BATCH = 16
LEARNING_RATE = 3e-3
CLASS_WEIGHTS = (1.0, 1.5, 5.0, 4.0)
"""Of scene, robot, object, clutter in the loss: small things count more."""
WHOLE_PICTURE = frozenset({
    "blur", "dark", "bright", "hue_drift", "flicker", "object_recolour", "arm_tint", "camera_shift", "camera_roll",
    "camera_zoom", "shuffle", "drop", "repeat", "freeze", "slow", "jitter", "splice", "table_swap", "smooth",
})
"""Recipes on pixels or time after which a mask still shows what can be seen."""


def has_true_masks(row: ManifestRow) -> bool:
    """Whether the masks of a clip match its pixels; in imagined clips they are only near."""
    return not row.origin.scene.startswith(IMAGINED) and all(
        edit.severity == "mild" or edit.recipe in WHOLE_PICTURE or RECIPES[edit.recipe].kind == "S"
        for edit in row.edits
    )


def segmentation_data(clips: Iterable[SetClip], seed: int) -> tuple[UInt8Array, UInt8Array]:
    """Return images (N, H, W, 3) and masks (N, H, W): FRAMES_PER_CLIP of each clip whose masks hold."""
    images, masks = [], []
    for clip in clips:
        if has_true_masks(clip.row):
            rng = numpy_stream(seed, f"segmenter_frames/{clip.row.sha256}")
            chosen = rng.choice(len(clip.frames), min(FRAMES_PER_CLIP, len(clip.frames)), replace=False)
            images.append(clip.frames[chosen])
            masks.append(clip.masks[chosen])
    if not images:
        raise ValueError("no clip has masks that show what is seen; build a set with recorded clips")
    return np.concatenate(images), np.concatenate(masks)


def train_segmenter(
    images: UInt8Array, masks: UInt8Array, *, num_steps: int, seed: int, progress: bool = True,
    device: torch.device = CPU_DEVICE,
) -> Segmenter:
    """Minimise weighted cross-entropy with AdamW; equal arguments give equal weights on one machine."""
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        model = Segmenter().train().to(device)
    optimiser = torch.optim.AdamW(model.parameters(), LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=num_steps, pct_start=0.1)
    generator, weights = torch_stream(seed, "segmenter_batches"), torch.tensor(CLASS_WEIGHTS).to(device)
    pictures, labels = torch.from_numpy(images), torch.from_numpy(masks)
    steps = tqdm(range(num_steps), desc="segmenter", disable=not progress)
    for _ in steps:
        chosen = torch.randint(len(pictures), (BATCH,), generator=generator)
        shown, meant = pictures[chosen].to(device), labels[chosen].to(device)
        pixels, wanted = _augment(shown.permute(0, 3, 1, 2).float() / 255, meant.long(), generator)
        loss = F.cross_entropy(model(pixels), wanted, weights)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        steps.set_postfix(loss=f"{loss.item():.3f}", refresh=False)
    return model.eval().requires_grad_(False)


def _augment(pixels_N3HW: Tensor, labels_NHW: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Augment images, each change with probability 1/2 and a uniform amount, so that the network learns shapes.

    Colours are turned about the grey axis by any angle; the light is 0.7 to 1.3; the picture is mirrored; and it is
    turned by up to 15 degrees and scaled by 0.8 to 1.25.
    """
    count = len(pixels_N3HW)
    draws = (torch.rand(4, count, generator=generator).to(pixels_N3HW.device) for _ in range(2))
    chosen, amount = next(draws) < 0.5, next(draws) * 2 - 1
    angle = torch.where(chosen[0], amount[0] * math.pi, 0.0)
    cos, up, down = angle.cos(), *((1 - angle.cos()) / 3 + side * angle.sin() / math.sqrt(3) for side in (-1, 1))
    same = cos + (1 - cos) / 3
    turn = torch.stack([same, up, down, down, same, up, up, down, same], 1).view(count, 3, 3)
    pixels = torch.einsum("nij,njhw->nihw", turn, pixels_N3HW)
    pixels = pixels * torch.where(chosen[1], 1 + 0.3 * amount[1], 1.0).view(-1, 1, 1, 1)
    roll, scale = (chosen[3] * amount[3]) * math.radians(15), 1.25 ** torch.where(chosen[3], amount[2], 0.0)
    side = torch.where(chosen[2], -1.0, 1.0)
    zero = torch.zeros_like(roll)
    affine = torch.stack(
        [scale * roll.cos() * side, -scale * roll.sin(), zero, scale * roll.sin() * side, scale * roll.cos(), zero], 1
    ).view(count, 2, 3)
    grid = F.affine_grid(affine, list(pixels.shape), align_corners=False)
    pixels = F.grid_sample(pixels.clamp(0, 1), grid, padding_mode="border", align_corners=False)
    labels = F.grid_sample(labels_NHW[:, None].float(), grid, "nearest", "border", align_corners=False)
    return pixels, labels[:, 0].long()


def overlaps(model: Segmenter, images: UInt8Array, masks: UInt8Array) -> dict[str, float]:
    """Intersection over union of each class over all pixels, of the classes that the masks have."""
    predicted = model.masks(images)
    names = ("scene", "robot", "object", "clutter")
    return {
        name: float(((predicted == i) & (masks == i)).sum() / max(1, ((predicted == i) | (masks == i)).sum()))
        for i, name in enumerate(names)
        if (masks == i).any()
    }
