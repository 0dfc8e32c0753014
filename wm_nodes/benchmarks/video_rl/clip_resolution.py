"""Train low, infer higher: a video model on pictures of other sizes than it was trained on.

Shapes: E contexts, F frames, H W 3 image.
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.reference_reward import score_clips
from wm_nodes.video_rl.sampling import ClipGenerator
from wm_nodes.world_model.position_probe import PositionProbe

MODEL, CODEC, ENLARGED, COPY = "model", "codec alone", "the model's own size, enlarged", "first frame repeated"


def sample_clips(folder: VideoFolder, contexts: Clips, config: VideoRlConfig) -> Tensor:
    """One ODE clip of each context at the contexts' size, uint8 (E, F, H, W, 3)."""
    return ClipGenerator(folder, contexts, config).evaluate(contexts, config.evaluation.num_steps)


def size_rows(
    folder: VideoFolder, contexts: Clips, own: Tensor, config: VideoRlConfig, probe: PositionProbe
) -> list[dict[str, Any]]:
    """Scores of each context, by what is shown. own: clips of the same contexts at the model's own size."""
    frames = contexts.frames
    shown = {
        MODEL: sample_clips(folder, contexts, config),
        ENLARGED: resized(own, *frames.shape[2:4]),
        CODEC: folder.codec.decode(folder.codec.encode(frames)),
        COPY: frames[:, :1].expand_as(frames),
    }
    return [
        {"side_px": frames.shape[2], "shown": name, **{measure: values.tolist() for measure, values in scores.items()}}
        for name, clips in shown.items()
        for scores in [score_clips(clips, contexts, probe, folder.clip["num_conditioning"]).named()]
    ]


def resized(frames: Tensor, height: int, width: int) -> Tensor:
    """uint8 (E, F, H, W, 3) as (E, F, height, width, 3), bilinear."""
    flat = frames.flatten(0, 1).permute(0, 3, 1, 2).float()
    made = interpolate(flat, (height, width), mode="bilinear", antialias=True).round().to(torch.uint8)
    return made.permute(0, 2, 3, 1).reshape(*frames.shape[:2], height, width, 3)
