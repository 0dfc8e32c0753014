"""From clips to a video model: flow matching, held-out scores. Resumable; what is finished is kept."""

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.seed_ranges import seed_spans
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import success
from wm_nodes.config.video import FlowMatchingConfig, VideoRlConfig
from wm_nodes.core.device import compute_device, explain_memory
from wm_nodes.core.model_folder import MANIFEST
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.video_model import Condition, NetworkSettings, VideoNetwork
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.flow_matching import train_video_model
from wm_nodes.video_model.folder import VideoFolder, load_video_folder, read_video_manifest, save_video_folder
from wm_nodes.video_model.success_reader import save_success_reader, score_reader, train_success_reader
from wm_nodes.video_model.tokenizer_codec import codec_of_world_model
from wm_nodes.video_rl.reference_reward import score_clips
from wm_nodes.video_rl.validation import load_or_measure_scores
from wm_nodes.world_model.position_probe import PositionProbe

READER_ITERATIONS = 500
BEFORE = Path("evaluations") / "before.json"


def make_video_model(
    config: VideoRlConfig, clips: Clips, heldout: Clips, probe: PositionProbe, run_dir: Path, *,
    shipped: VideoFolder | None = None, command: str = "",
) -> VideoFolder:
    """The shipped video model, or without one a model trained on the clips, with its held-out scores; with a success
    reader where it chooses the motion or can be stepped.

    Kept in run_dir/video_model, and loaded from there; the scores of each held-out context are kept in
    run_dir/evaluations/before.json.

    Args:
        shipped: what shipped_video_model() gives; None: train one.
    """
    folder, device = run_dir / "video_model", compute_device(config.device)
    if (folder / MANIFEST).is_file():
        return load_video_folder(folder, device)
    story: dict[str, Any]
    if shipped is not None:
        model, kept = shipped, ("command", "date", "seed", "episodes", "training_seeds", "training")
        story = {"shipped": {name: model.manifest[name] for name in kept if name in model.manifest}}
    else:
        model, losses = _train(config, clips, run_dir)
        story = {
            "command": command, "date": date.today().isoformat(), "seed": config.seed, "task": config.task,
            "episodes": len(clips), "training_seeds": seed_spans(clips.seeds), "training": losses,
        }
    scores = load_or_measure_scores(run_dir / BEFORE, model, heldout, probe, config)
    story["model"] = config.model.model_dump()
    means = {name: sum(values) / len(values) for name, values in scores.items()}
    story["heldout"] = means | _score_baselines(model, heldout, probe, config)
    if shipped is None and (config.model.training.hide_actions or config.model.training.given_frames):
        reader = train_success_reader(clips, model.codec, READER_ITERATIONS, config.seed, run_dir)
        scores_of_reader = score_reader(reader, heldout.frames, success(heldout.task, heldout.ground_truth))
        made = {"seed": config.seed, "command": command, "heldout": scores_of_reader}
        save_success_reader(folder, reader, clips.task, made)
    save_video_folder(folder, model.codec, model.network, model.clip, story)
    return load_video_folder(folder, device)


def shipped_video_model(config: VideoRlConfig) -> VideoFolder | None:
    """The video model of these settings and task that is shipped with the task's world model, on config.device; None
    where there is none."""
    try:
        folders = sorted(shipped_model(config.task).glob(f"video_model*/{MANIFEST}"))
    except FileNotFoundError:
        return None
    for path in folders:
        manifest = read_video_manifest(path.parent)
        if (manifest["task"], manifest["model"]) == (config.task, config.model.model_dump()):
            return load_video_folder(path.parent, compute_device(config.device))
    return None


def _train(config: VideoRlConfig, clips: Clips, run_dir: Path) -> tuple[VideoFolder, dict[str, float]]:
    """Train the network on the shipped tokenizer's latents; return both, on config.device, and the last losses."""
    device, settings, K = compute_device(config.device), config.model, config.model.num_conditioning
    codec = codec_of_world_model(shipped_model(config.task)).to(device)
    latents, condition = codec.encode(clips.frames), clips.condition(codec, K, settings.text_dim)
    sizes = NetworkSettings(
        codec.channels, clips.actions.shape[2], settings.text_dim, settings.width, settings.depth,
        patch=1, change_std=change_std(latents, K, settings.training.new_frames),
    )
    torch.manual_seed(stream_seed(config.seed, "video_network") % 2**32)
    network = VideoNetwork(sizes).to(device)

    def batch(iteration: int) -> tuple[Tensor, Condition]:
        drawn = numpy_stream(config.seed, "video_batches", iteration).choice(len(clips), settings.batch_size)
        rows = torch.from_numpy(drawn).to(device)
        videos, of = latents[rows], condition.rows(rows)
        if not settings.training.given_frames:
            return videos, of
        return cut_windows(videos, of, settings.training, numpy_stream(config.seed, "video_windows", iteration))

    with explain_memory(device, model__batch_size=settings.batch_size):
        losses = train_video_model(network, batch, settings.training, seed=config.seed, run_dir=run_dir)
    clip = {"stride": settings.stride, "num_conditioning": K}
    if settings.training.given_frames:
        clip |= {"given_frames": settings.training.given_frames, "new_frames": settings.training.new_frames}
    return VideoFolder(codec, network, clip, {}), losses


def cut_windows(
    videos: Tensor, condition: Condition, settings: FlowMatchingConfig, rng: np.random.Generator
) -> tuple[Tensor, Condition]:
    """Cut K + n frames out of each of B videos (B, C, F, h, w), of which the first K are given.

    K of 1 to given_frames and n of 1 to new_frames, or to what is left, are drawn for the batch, the place for each
    video. condition: of the whole videos.

    Raises:
        ValueError: the videos have no frame after the given ones.
    """
    B, _, count = videos.shape[:3]
    if count <= settings.given_frames:
        raise ValueError(f"videos of {count} frames have none after {settings.given_frames} given ones; lower "
                         "model.training.given_frames")
    K = int(rng.integers(1, settings.given_frames + 1))
    n = int(rng.integers(1, min(settings.new_frames, count - K) + 1))
    starts = torch.from_numpy(rng.integers(0, count - K - n + 1, B)).to(videos.device)
    places = starts.unsqueeze(1) + torch.arange(K + n, device=videos.device)
    index = torch.arange(B, device=videos.device).unsqueeze(1)
    cut = videos.transpose(1, 2)[index, places].transpose(1, 2).contiguous()
    actions = condition.actions[index, places[:, :-1]]
    return cut, Condition(cut[:, :, :K].contiguous(), actions, condition.text)


def _score_baselines(
    folder: VideoFolder, heldout: Clips, probe: PositionProbe, config: VideoRlConfig
) -> dict[str, float]:
    """Return mean scores without sampling. `copy_*`: of repeating the first frame. `codec_psnr_db`: of the codec."""
    contexts = heldout.first(config.evaluation.contexts)
    K = folder.clip["num_conditioning"]
    copied = contexts.frames[:, :1].expand_as(contexts.frames)
    coded = folder.codec.decode(folder.codec.encode(contexts.frames))
    scores = {f"copy_{name}": float(v.mean()) for name, v in score_clips(copied, contexts, probe, K).items()}
    return scores | {"codec_psnr_db": float(score_clips(coded, contexts, probe, K)["psnr_db"].mean())}


def change_std(latents: Tensor, num_conditioning: int, new_frames: int = 0) -> float:
    """Root mean square of what changes after the last given frame of clips (B, C, F, h, w); without one, of all.

    new_frames: with it, of what changes within up to so many frames, anywhere.
    """
    if num_conditioning == 0:
        return float(latents.square().mean().sqrt())
    if new_frames:
        later = [latents[:, :, lag:] - latents[:, :, :-lag] for lag in range(1, min(new_frames + 1, latents.shape[2]))]
        return float(torch.stack([change.square().mean() for change in later]).mean().sqrt())
    given = latents[:, :, num_conditioning - 1 : num_conditioning]
    return float((latents[:, :, num_conditioning:] - given).square().mean().sqrt())
