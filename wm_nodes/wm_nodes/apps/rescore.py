"""Loop 2 without a graph: score a run's recorded clips again, or train on them again."""

import argparse
import json
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from rich.table import Table
from torch import Tensor
from tqdm import tqdm

from wm_nodes.apps.policy_run import Stages, console, judge_options, open_run_dir
from wm_nodes.apps.video_results import Finished, conclude
from wm_nodes.config.load import dump_config, judge_or_embedded, load_video_config, parse_override, reward_overrides
from wm_nodes.config.schema import AGENT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.files import write_atomic
from wm_nodes.judge.agent import Verdict
from wm_nodes.judge.backends.factory import for_clips
from wm_nodes.judge.evidence_of_clip import ClipEvidence
from wm_nodes.judge.service import READS, JudgeService, agent_scores, buffer_jobs, clip_fps
from wm_nodes.recording.raw import PARTIAL_SUFFIX
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.summary import plain
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.recorded_buffers import (
    BufferJudge,
    JudgedBuffer,
    RecordedClips,
    Rescored,
    read_clips,
    recorded_buffer,
    rescore,
    trained_clips,
)
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.training_run import VideoRun, progress
from wm_nodes.video_rl.validation import validation_scores

RESCORED = "rescored.json"


def rescore_run(arguments: argparse.Namespace) -> int:
    """Score every recorded picture again; 0 where all bits are the recorded ones, else 1."""
    run_dir, config = _source(arguments.run, chosen_judge(arguments))
    probe = load_probe(shipped_model(config.task))
    bags = _shards(run_dir, "train")
    contexts = load_clips(bags, config.model.stride)
    with _judge(config, run_dir, contexts, clip_fps(bags[0], config.model.stride)) as judge:
        clips = (recorded for bag in recorded_bags(run_dir) for recorded in read_clips(bag, pictures=True))
        rows = [
            rescore(recorded, contexts, probe, config.rewards, config.model.num_conditioning, judge)
            for recorded in tqdm(clips, desc="rescoring", unit="buffer")
        ]
    equal = all(not row.different for row in rows)
    content = {"equal": equal, "rewards": config.rewards, "buffers": [_row(row) for row in rows]}
    path = arguments.json or run_dir / RESCORED
    write_atomic(path, (json.dumps(plain(content), indent=1) + "\n").encode())
    console.print(_table(rows))
    words = "every score is the recorded one, bit for bit" if equal else "[bold red]scores differ from the bag's[/]"
    if not all(row.same_reward for row in rows):
        words += "; the total is by other rewards than recorded, so it is not compared"
    if silent := sum(row.recorded.audit_ids.count("") for row in rows if row.verdicts):
        words += f"; {silent} clips that got no answer then are not compared"
    console.print(f"{words}: {path}", highlight=False)
    return 0 if equal else 1


def retrain_run(arguments: argparse.Namespace, command: str) -> int:
    """Train on a run's kept buffers and recorded scores, without sampling, in a new run folder."""
    stage = Stages()
    source, live = _source(arguments.run)
    config = load_video_config(str(source / "config.yaml"), dict(parse_override(text) for text in arguments.set))
    if config.seed != live.seed:
        raise ValueError(f"the clips of {source} were drawn with seed {live.seed}, not {config.seed}; do not set it")
    run_dir = open_run_dir(arguments.run_dir, "world_model_retrain", dump_config(config))
    if run_dir == source:
        raise ValueError(f"{run_dir} is the run to train again from; name a new folder with --run-dir")
    _, iterations = progress(source)
    if not iterations:
        raise ValueError(f"{source} has no checkpoint of a learner: nothing was trained there to train again")
    clips = trained_clips(recorded_bags(source), iterations)
    stage(f"training on {len(clips)} buffers of {source} in {run_dir}")
    base, heldout, judge = source / "video_model", _shards(source, "heldout"), shipped_model(config.task)
    folder = load_video_folder(base)
    run = VideoRun(
        folder.network, config, run_dir, tensorboard=arguments.tensorboard,
        heldout=validation_scores(folder, heldout, judge, config) if config.evaluation.every else None,
    )
    rewards = None if config.rewards == live.rewards else config.rewards
    try:
        for recorded in tqdm(clips[run.iterations :], desc="GRPO", unit="buffer"):
            run.train(recorded_buffer(source, recorded, rewards))
    finally:
        run.close()
    conclude(
        Finished(
            config, run_dir, base, run.iterations, run.version, load_clips(heldout, folder.clip["stride"]),
            load_probe(judge), f"as in {source.name}", "", command, stage.minutes,
        )
    )
    return 0


def recorded_bags(run_dir: Path) -> list[Path]:
    """The bags of a run, oldest first: one for each time it was started, those of killed recorders by their final name.

    Raises:
        ValueError: there is none.
    """
    folders = (path for path in (run_dir / "bags").glob("*") if path.is_dir())
    bags = sorted({path.with_name(path.name.removesuffix(PARTIAL_SUFFIX)) for path in folders})
    if not bags:
        raise ValueError(f"{run_dir} holds no recorded bag; name the run folder of a world_model_rl.py that trained")
    return bags


def chosen_judge(arguments: argparse.Namespace) -> dict[str, Any]:
    """The settings that the options --reward, --judge, --judge-model, --judge-key-env and --rubric stand for."""
    return {**reward_overrides(arguments.reward), **judge_options(arguments)}


@contextmanager
def _judge(config: VideoRlConfig, run_dir: Path, contexts: Clips, fps: float) -> Iterator[BufferJudge | None]:
    """The run's reward agent with the answers that it kept; a round is judged by the judge that did it, where the run
    still has that one. None where the agent is not among the rewards."""
    if not config.rewards.get(AGENT):
        yield None
        return

    def verdicts(recorded: RecordedClips, frames: Tensor, references: Clips) -> JudgedBuffer:
        jobs = buffer_jobs(
            frames,
            references,
            recorded.sha256,
            given=config.model.num_conditioning,
            fps=fps,
            task=config.task,
            robot=config.judge.robot,
        )
        found = judge.judge(jobs, by=recorded.judge_id if recorded.judge_id in judge.judge_ids else "")
        return JudgedBuffer(agent_scores(found), tuple(verdict_row(verdict) for verdict in found))

    evidence = ClipEvidence(shipped_model(config.task))
    settings = for_clips(judge_or_embedded(config.judge), tuple(contexts.frames.shape[1:]))
    with closing(JudgeService(settings, seed=config.seed, reads=run_dir / READS, evidence=evidence)) as judge:
        yield verdicts


def _source(run_dir: Path, overrides: dict[str, Any] | None = None) -> tuple[Path, VideoRlConfig]:
    folder = run_dir.expanduser().absolute()
    saved = folder / "config.yaml"
    if not saved.is_file():
        raise ValueError(f"{folder} holds no config.yaml; name the run folder of a world_model_rl.py")
    return folder, load_video_config(str(saved), overrides)


def _shards(run_dir: Path, name: str) -> list[Path]:
    shards = sorted((run_dir / "data" / name).glob("shard_????????"))
    if not shards:
        raise ValueError(f"{run_dir / 'data' / name} holds no episodes; name the run folder that recorded the clips")
    return shards


def _row(row: Rescored) -> dict[str, object]:
    recorded = row.recorded
    return {
        "iteration": recorded.iteration, "policy_version": recorded.policy_version, "sha256": recorded.sha256,
        "recorded": recorded.total.tolist(), "again": row.total.tolist(), "different": list(row.different),
        "verdicts": list(row.verdicts),
    }


def verdict_row(verdict: Verdict) -> dict[str, object]:
    return {name: getattr(verdict, name) for name in ("clip_id", "status", "reward", "level", "reason", "audit_id")}


def _table(rows: Sequence[Rescored]) -> Table:
    columns = ("iteration", "version", "clips", "mean reward recorded", "again", "different")
    cells = (
        (
            row.recorded.iteration, row.recorded.policy_version, len(row.total),
            *(f"{float(total.nanmean()):.6f}" for total in (row.recorded.total, row.total)),
            ", ".join(row.different) or "-",
        )
        for row in rows
    )
    return make_table("recorded clips, scored again from their pictures", columns, cells, left=("different",))
