"""Rewards of sampled clips, from the recorded episode that they should show (DD-28, DD-28a).

Shapes: N clips, F frames, H W 3 image. Positions are read off the decoded pictures by the judge's probe
(world_model/position_probe.py), which shares nothing with the video model; the truth is the simulator's. Where there is
none, the pictures themselves are compared. Nothing here is a learned preference: these are the verifiable rewards, and
the held-out metrics beside which a judge's reward is watched (DD-2).
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from wm_nodes.config.tasks import get_task
from wm_nodes.core.types import FloatArray
from wm_nodes.reward.picture_similarity import psnr_db, ssim
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.tokenizer_codec import TokenizerCodec
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import columns_of, probe_targets

TRACKING_SCALE_M, OUTCOME_SCALE_M = 0.03, 0.05
"""An error of this much takes the tracking score, or the outcome, to 1 / e."""
SEEN_MOTION = 12
"""A pixel counts as scenery while no recorded frame differs from the first one by more than this, of 255."""
ERRORS = ("scenery", "object_cm", "tool_cm", "executed_object_cm", "impossible_tool_steps")
"""Scores of which less is better; the last two are heldout_metrics.UNREWARDED."""
CLIP_SCORES = ("tracking", "scenery", "psnr_db", "object_cm", "tool_cm", "success", "outcome")
"""What score_clips() gives."""
PICTURE_SCORES = ("ssim", "perceptual", "closeness")
"""What score_pictures() gives."""
FULL_PSNR_DB = 40.0
"""A frame of this PSNR or more has 1 for it in closeness."""


def score_clips(frames: Tensor, references: Clips, probe: PositionProbe, num_conditioning: int) -> dict[str, Tensor]:
    """Score decoded clips, uint8 (N, F, H, W, 3), against the recordings of their contexts, where the clips are; return
    CLIP_SCORES, float64 (N,) in the host's memory.

    tracking: mean exp(-error / 3 cm) of object and tool over generated frames, in (0, 1]. scenery: mean absolute error,
    [0, 1], where the recording stands still. psnr_db: of generated frames. object_cm, tool_cm: mean position errors.
    success: 1 where the task is done in the last frame. outcome: exp(-d / 5 cm), d what is then left to the edge of the
    goal (DD-32). All but scenery and psnr_db are NaN where the recording has no simulator state, scenery where nothing
    in it stands still.

    Raises:
        ValueError: clips and recordings differ in number or size.
    """
    _check_sizes(frames, references)
    generated, recorded = slice(num_conditioning, None), references.frames.to(frames.device)
    truth = probe_targets(references.ground_truth[:, generated], references.task)
    unknown = bool(np.isnan(truth).all())  # then the pictures may be of cameras that the probe does not know
    positions = truth if unknown else probe.read(frames[:, generated])
    thing, tool = (columns_of(references.task, name) for name in ("object", "tool"))
    object_m, tool_m = (np.linalg.norm((positions - truth)[..., columns], axis=-1) for columns in (thing, tool))
    tracking = (np.exp(-object_m / TRACKING_SCALE_M) + np.exp(-tool_m / TRACKING_SCALE_M)) / 2
    error = (frames[:, generated].float() - recorded[:, generated].float()) / 255
    still = still_pixels(recorded)[:, None, :, :, None].float()
    weight = still.sum((1, 2, 3, 4)) * error.shape[1] * error.shape[4]
    left_m = distance_left(positions[:, -1], truth[:, -1], references.task)
    scores = (
        torch.from_numpy(tracking.mean(1)),
        (error.abs() * still).sum((1, 2, 3, 4)) / weight,
        -10 * error.square().mean((1, 2, 3, 4)).clamp_min(1e-8).log10(),
        torch.from_numpy(100 * object_m.mean(1)),
        torch.from_numpy(100 * tool_m.mean(1)),
        torch.from_numpy(np.where(np.isfinite(left_m), left_m <= 0, left_m)),
        torch.from_numpy(np.exp(-np.maximum(left_m, 0) / OUTCOME_SCALE_M)),
    )
    return {name: values.double().cpu() for name, values in zip(CLIP_SCORES, scores, strict=True)}


def score_pictures(
    frames: Tensor, references: Clips, codec: TokenizerCodec, num_conditioning: int
) -> dict[str, Tensor]:
    """Return by name, float64 (N,) in the host's memory, how alike decoded clips, uint8 (N, F, H, W, 3), and their
    recordings look (DD-28a); no simulator state is read.

    ssim: in [-1, 1]. perceptual: exp(-mean |difference of the codec's latents|), in (0, 1]. closeness: mean of both and
    of PSNR / 40 dB, at most 1, in (-1/3, 1]. Each is a mean over the generated frames.

    Raises:
        ValueError: clips and recordings differ in number or size.
    """
    _check_sizes(frames, references)
    shown, wanted = (some[:, num_conditioning:] for some in (frames, references.frames.to(frames.device)))
    pairs = shown.flatten(0, 1), wanted.flatten(0, 1)
    psnr, similarity = (measure(*pairs).view(shown.shape[:2]) for measure in (psnr_db, ssim))
    distance = (codec.encode(shown) - codec.encode(wanted)).abs().mean((1, 3, 4))
    perceptual = torch.exp(-distance).to(psnr.device)
    closeness = ((psnr / FULL_PSNR_DB).clamp_max(1) + similarity + perceptual) / 3
    scores = zip(PICTURE_SCORES, (similarity, perceptual, closeness), strict=True)
    return {name: values.double().mean(1).cpu() for name, values in scores}


def still_pixels(recorded: Tensor) -> Tensor:
    """Return which pixels of recordings, uint8 (N, F, H, W, 3), are scenery, bool (N, H, W)."""
    return (recorded.int() - recorded[:, :1].int()).abs().amax((1, 4)) <= SEEN_MOTION


def check_scenery(recordings: Clips) -> None:
    """Raise ValueError where a recording has no scenery, so that the reward `scenery` would be unknown."""
    for row in range(len(recordings)):
        if not still_pixels(recordings.frames[row : row + 1]).any():
            raise ValueError(
                f"the reward scenery compares what stands still, and no pixel of recording {row} does; set "
                "rewards.scenery 0, or take recordings of a camera that stands still"
            )


def distance_left(positions: FloatArray, truth: FloatArray, task: str) -> FloatArray:
    """Return how far what the task moves is from the edge of its goal, m, below 0 within it, (N,); NaN for a task
    without a goal.

    Args:
        positions: read off a frame, (N, P), of what moves and of a thing that the goal is above. truth: of the scene
            that the goal is in, the same.
    """
    part, (thing, tool, goal) = get_task(task).judge, (columns_of(task, name) for name in ("object", "tool", "goal"))
    rule = part.goal
    if rule is None:
        return np.full(len(positions), np.nan, np.float32)
    if rule.above_thing_m is None:
        place, target = positions[:, thing if rule.mover == "object" else tool[:2]], truth[:, goal]
    else:
        # the probe does not read how high the thing lies
        height = np.full((len(positions), 1), part.object_height_m + rule.above_thing_m, np.float32)
        place, target = positions[:, tool], np.concatenate([positions[:, thing], height], 1)
    left: FloatArray = np.linalg.norm(place - target, axis=-1) - rule.radius_m
    return left


def more_is_better(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return a score as a number of which more is better: errors negated, others unchanged."""
    scores: NDArray[np.float64] = np.asarray(values, np.float64)
    return -scores if name in ERRORS else scores


def load_probe(folder: Path, device: torch.device | str = "cpu") -> PositionProbe:
    """Load the judge's probe of a world model's folder onto `device`. Raises ValueError where it has none."""
    probe = load_model_folder(folder, device).probe
    if probe is None:
        raise ValueError(f"{folder} has no position probe to judge with; take the shipped world model")
    return probe


def mix_rewards(values: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Return sum over names of weight x value (DD-13a), float64 (N,); what has weight 0 need not be scored.

    Raises:
        ValueError: a weight for something that was not scored, or no weight at all.
    """
    weights = {name: weight for name, weight in weights.items() if weight}
    unknown = sorted(set(weights) - set(values))
    if unknown or not weights:
        raise ValueError(f"unknown rewards {unknown}; weigh some of {', '.join(sorted(values))}")
    return torch.stack([weight * values[name].double() for name, weight in weights.items()]).sum(0)


def _check_sizes(frames: Tensor, references: Clips) -> None:
    if frames.shape != references.frames.shape:
        raise ValueError(f"clips are {tuple(frames.shape)}, their recordings {tuple(references.frames.shape)}")
