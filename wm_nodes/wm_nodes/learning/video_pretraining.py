"""From clips to a video model: codec, flow matching, held-out scores. Resumable; what is finished is kept."""

import platform
from datetime import date
from pathlib import Path

import torch
from torch import Tensor

from wm_nodes.learning.clip_generation import ClipGenerator
from wm_nodes.learning.clip_scores import score_clips
from wm_nodes.learning.video_config import VideoRlConfig
from wm_nodes.learning.video_data import Clips
from wm_nodes.learning.video_folder import MANIFEST, VideoFolder, load_video_folder, save_video_folder
from wm_nodes.learning.video_training import train_video_model
from wm_nodes.seeding import numpy_stream, stream_seed
from wm_nodes.video_model import Condition, NetworkSettings, VideoNetwork
from wm_nodes.video_model.codec import PatchCodec
from wm_nodes.world_model.position_probe import PositionProbe

CODEC_FRAMES = 2000


def make_video_model(
    config: VideoRlConfig, clips: Clips, heldout: Clips, probe: PositionProbe, run_dir: Path, *, progress: bool = True,
    command: str = "",
) -> VideoFolder:  # fmt: skip
    """Fit the codec, train the network, score held-out clips; kept in run_dir/video_model, and loaded from there."""
    folder = run_dir / "video_model"
    if (folder / MANIFEST).is_file():
        return load_video_folder(folder)
    settings = config.model
    codec = PatchCodec(settings.patch, settings.channels)
    kept = codec.fit(_some_frames(clips, config.seed))
    torch.manual_seed(stream_seed(config.seed, "video_network") % 2**32)
    sizes = NetworkSettings(
        settings.channels, clips.actions.shape[2], settings.text_dim, settings.width, settings.depth
    )
    network = VideoNetwork(sizes)
    K = settings.num_conditioning
    latents = codec.encode(clips.frames)
    condition = clips.condition(codec, K, settings.text_dim)

    def batch(iteration: int) -> tuple[Tensor, Condition]:
        drawn = numpy_stream(config.seed, "video_batches", iteration).choice(len(clips), settings.batch_size)
        rows = torch.from_numpy(drawn)
        return latents[rows], condition.rows(rows)

    losses = train_video_model(
        network, batch, settings.training, seed=config.seed, run_dir=run_dir, progress=progress
    )
    made = VideoFolder(codec, network, {"stride": settings.stride, "num_conditioning": K}, {})
    story = {
        "command": command, "date": date.today().isoformat(), "seed": config.seed, "machine": platform.processor(),
        "episodes": len(clips), "codec_variance_kept": kept, "training": losses,
        "heldout": heldout_scores(made, heldout, probe, config),
    }  # fmt: skip
    save_video_folder(folder, codec, network, made.clip, story)
    return load_video_folder(folder)


def heldout_scores(
    folder: VideoFolder, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
) -> dict[str, float]:
    """Mean scores of held-out contexts, one ODE clip each; `copy_*`: of repeating the first frame; `codec_psnr_db`."""
    some = heldout.select(torch.arange(min(config.evaluation.contexts, len(heldout))))
    K = folder.clip["num_conditioning"]
    frames = ClipGenerator(folder, some, config).evaluate(some, config.evaluation.num_steps)
    copied = some.frames[:, :1].expand_as(some.frames)
    coded = folder.codec.decode(folder.codec.encode(some.frames))
    found = {name: float(value.mean()) for name, value in score_clips(frames, some, probe, K).named().items()}
    found |= {f"copy_{name}": float(v.mean()) for name, v in score_clips(copied, some, probe, K).named().items()}
    found["codec_psnr_db"] = float(score_clips(coded, some, probe, K).psnr_db.mean())
    return found


def _some_frames(clips: Clips, seed: int) -> Tensor:
    frames = clips.frames.flatten(0, 1)
    count = min(CODEC_FRAMES, len(frames))
    return frames[torch.from_numpy(numpy_stream(seed, "codec_frames").choice(len(frames), count, replace=False))]
