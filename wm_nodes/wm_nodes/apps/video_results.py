"""The end of a run of loop 2: held-out scores before and after, pictures, summary.json, report.html, the table."""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.reports.clip_report import (
    TITLES,
    ClipSummary,
    ScoreChange,
    clip_panels,
    hacking_text,
    scores_table,
    write_clip_report,
)
from wm_nodes.reports.curves import curves
from wm_nodes.reports.film_strip import film_strip
from wm_nodes.reports.html import Picture
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.stages import console, say_files
from wm_nodes.reports.summary import as_first_made, write_summary
from wm_nodes.training.metrics import FILE_NAME, read_metrics
from wm_nodes.training.weights import load_weights_file
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_model.success_reader import reader_of
from wm_nodes.video_rl.heldout_metrics import load_or_measure_unrewarded, make_yardstick
from wm_nodes.video_rl.pretraining import BEFORE
from wm_nodes.video_rl.reference_reward import more_is_better
from wm_nodes.video_rl.reward_hacking import SECTION, alarm_text, hacked_slopes, watched_scores
from wm_nodes.video_rl.sampling import sample_by_ode
from wm_nodes.video_rl.training_run import VIDEO_FILES
from wm_nodes.video_rl.validation import OUTCOMES, load_or_measure_scores
from wm_nodes.world_model.position_probe import PositionProbe

AFTER, UNREWARDED = (Path("evaluations") / name for name in ("after.json", "unrewarded.json"))
STRIPS = 3
UNKNOWN = "the probe does not read what it asks for, or the recordings do not hold it"
MOVING = "in a recording no pixel stands still"
ENDS = (*OUTCOMES, "executed_success", "reader_success")
"""How a clip ends: with given actions neither better nor worse, see OUTCOMES."""


def conclude(
    config: VideoRlConfig, run_dir: Path, *, base: Path, iterations: int, version: int, heldout: Clips,
    probe: PositionProbe, preset: str, bag: str, command: str, minutes: float,
) -> None:
    """Measure a training that has come to its end, draw, write and print; what was measured on the same weights before
    is kept. base: folder of the model it began with. iterations, version: as progress() says.

    Raises:
        OSError: the version's weights are gone.
    """
    base_folder, trained = (load_video_folder(base, compute_device(config.device)) for _ in range(2))
    if version:
        load_weights_file(trained.network, run_dir / VIDEO_FILES.uri(version))
    before = load_or_measure_scores(run_dir / BEFORE, base_folder, heldout, probe, config)
    after = load_or_measure_scores(run_dir / AFTER, trained, heldout, probe, config)
    device, shipped = compute_device(config.device), shipped_model(config.task)
    found = load_or_measure_unrewarded(
        run_dir / UNREWARDED, (base_folder, trained), heldout, config, lambda: make_yardstick(
            base_folder.codec, heldout, probe, reader_of(base, config.task, shipped, device),
            load_config("cpu", {"task": config.task}).simulation,
        ),
    )
    known = known_scores(before, after)
    missing = {
        name: MOVING if name == "scenery" else UNKNOWN for name in TITLES if name in before and name not in known
    }
    lines = read_metrics(run_dir, SECTION) if (run_dir / FILE_NAME).is_file() else []
    watched = [line for line in lines if line.get("hacked") is not None]
    summary = as_first_made(run_dir, ClipSummary(
        task=config.task, preset=preset, seed=config.seed, iterations=iterations, version=version,
        contexts=len(before["success"]),
        scores=score_changes(known, before, after, config),
        unrewarded=score_changes(found.before, found.before, found.after, config),
        executed=len(found.before.get("executed_success", ())), not_measured=missing | found.missing,
        evaluations=len(lines), watched=compared_scores(watched, config),
        hacked=None if not watched else [
            {"step": line["step"], "reward_slope": line["reward_slope"], "slopes": hacked_slopes(line),
             "text": alarm_text(line)} for line in watched if line["hacked"]
        ],
        bag=bag, minutes=minutes, command=command, machine=machine_facts(config.device), date=time.strftime("%Y-%m-%d"),
    ))
    path = write_summary(run_dir, summary)
    strips = _strips(config, run_dir, heldout, (base_folder, trained))
    drawn = curves(
        run_dir / FILE_NAME, run_dir / "pictures" / "curves.png", clip_panels(config.grpo.updates_per_buffer),
        step="buffers trained on",
    )
    if drawn is not None:
        strips.append(Picture("Training", "By buffer; held-out scores are of the weights that are evaluated.", drawn))
    report = write_clip_report(run_dir, summary, strips, config_text=dump_config(config))
    console.print(scores_table(summary), f"reward hacking: {hacking_text(summary)}", sep="\n", highlight=False)
    for alarm in summary.hacked or ():
        console.print(f"[bold yellow]reward hacking[/] after {alarm['step']} buffers: {alarm['text']}", highlight=False)
    say_files(report, path, summary.bag)


def known_scores(before: Mapping[str, Sequence[float]], after: Mapping[str, Sequence[float]]) -> list[str]:
    """Which scores are numbers in every context; success, say, is none where a task's rule asks for what no probe
    reads."""
    return [name for name in TITLES if name in before and np.isfinite([*before[name], *after[name]]).all()]


def compared_scores(watched: Sequence[Mapping[str, Any]], config: VideoRlConfig) -> list[str]:
    """Which scores the alarm compared in the newest of the evaluations at which it looked."""
    names = watched_scores(config.groups.hide_actions)
    return [name for name in names if watched and watched[-1].get(name) is not None]


def score_changes(
    names: Iterable[str], before: Mapping[str, Sequence[float]], after: Mapping[str, Sequence[float]],
    config: VideoRlConfig,
) -> dict[str, ScoreChange]:
    """score_change() by name; with given actions ENDS have no verdict."""
    changes = {name: score_change(name, before[name], after[name], config.seed) for name in names}
    unjudged = () if config.groups.hide_actions else ENDS
    return {name: replace(change, verdict="") if name in unjudged else change for name, change in changes.items()}


def score_change(name: str, before: Sequence[float], after: Sequence[float], seed: int) -> ScoreChange:
    """Compare a score on the same contexts; better and worse as more_is_better() says."""
    difference, low, high = bootstrap_mean(np.subtract(after, before), seed=seed)
    _, worst, best = bootstrap_mean(more_is_better(name, after) - more_is_better(name, before), seed=seed)
    verdict = "better" if worst > 0 else "worse" if best < 0 else ""
    return ScoreChange(float(np.mean(before)), float(np.mean(after)), difference, low, high, verdict)


def _strips(config: VideoRlConfig, run_dir: Path, heldout: Clips, folders: Sequence[VideoFolder]) -> list[Picture]:
    """The recording, the base model and the trained model from the same first frames and noise."""
    shown = heldout.first(STRIPS)
    frames = [sample_by_ode(folder, shown, config, config.evaluation.num_steps).cpu() for folder in folders]
    rows = dict(zip(("recorded", "before", "after"), [shown.frames, *frames], strict=True))
    pictures, given = [], "first frame" if config.groups.hide_actions else "first frame and actions"
    for index, instruction in enumerate(shown.instructions):
        path = run_dir / "pictures" / f"film_strip_{index}.png"
        film_strip({label: np.ascontiguousarray(clips[index].numpy()) for label, clips in rows.items()}, path)
        pictures.append(
            Picture(
                f"Held-out context {index + 1}",
                f"“{instruction}”. The recording, then what the model makes of its {given}, before and after, from the "
                "same noise.", path,
            )
        )
    return pictures
