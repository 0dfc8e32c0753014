"""Score a recording again, and say whether the scores are the recorded ones, bit by bit.

    wm rescore runs/RUN              # the clips of a run of train-video-model, or the rewards of one of train-policy
    wm rescore runs/RUN/bags/BAG     # the rewards of another bag of train-policy
    wm rescore BAG --judge embedded  # the episodes of a recording with images, by the reward agent

The judge's answers that the run kept (judge.keep_reads) are taken again, so that nobody is asked twice. With --reward
or --judge another reward than the recorded one may score; what is not of one reward is not compared. The exit code is 1
where something differs.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from rich.table import Table
from torch import Tensor

from wm_nodes.apps.options import add_device, add_json, add_judge, device_settings, judge_settings, prepare_torch
from wm_nodes.config.load import REWARDS, judge_or_embedded, load_config, reward_overrides
from wm_nodes.config.schema import AGENT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import for_task
from wm_nodes.judge.episode_reward import episode_judge
from wm_nodes.judge.rejudge import judge_bag
from wm_nodes.judge.service import READS, JudgeService, agent_scores, buffer_jobs, clip_fps
from wm_nodes.policy_rl.rescoring import model_of_run, recorded_model, rescore_bag
from wm_nodes.recording.bag import is_bag
from wm_nodes.recording.rollouts import recorded_reward_name
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.stages import console
from wm_nodes.reports.summary import plain, read_summary
from wm_nodes.training.run_record import CONFIG
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl import recorded_buffers
from wm_nodes.video_rl.recorded_buffers import BufferJudge, RecordedClips, Rescored
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.sampling import RecordedContexts

RESCORED = "rescored.json"
SHOWN = 10


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="run folder, or a bag of train-policy")
    parser.add_argument(
        "--reward", choices=REWARDS,
        help="agent: a judge's verdicts; execution: what the action world model makes of their motion; reference: how "
        "well clips follow their recordings; closeness: how alike they look (default: as recorded)",
    )
    add_judge(parser)
    add_device(parser)
    add_json(parser, f"every score (default of a run folder: <run>/{RESCORED})")
    more = parser.add_argument_group("for a bag of train-policy")
    more.add_argument("--config", help="a preset or .yaml (default: config.yaml of the run that the bag lies in)")
    more.add_argument("--model-dir", type=Path, help="world model (default: <run>/model, else the shipped one)")
    more.add_argument("--namespace", help="of the environment, where the bag holds several")
    more.add_argument("--reads", type=Path, help=f"the judge's kept answers (default: {READS} beside --config)")
    more.add_argument("--audit", type=Path, help="folder of an audit log to write, where the agent judges")


@dataclass(frozen=True)
class Outcome:
    """What scoring a recording again gave."""

    equal: bool
    """Whether all that could be compared is the recorded, bit by bit."""
    said: Sequence[str | Table]
    """Lines and tables to print, in order."""
    content: Mapping[str, Any]
    """For the file of --json."""


def run(arguments: argparse.Namespace) -> int:
    """Return 0 where all that could be compared is equal, else 1."""
    prepare_torch()
    recording, path = _recording(arguments.recording), arguments.json
    rescore: Callable[[argparse.Namespace, Path], Outcome]
    if not is_bag(recording):
        rescore, path = _clips, path or recording / RESCORED
    elif AGENT in (arguments.reward, recorded_reward_name(recording, namespace=arguments.namespace)):
        rescore = _episodes
    else:
        rescore = _episodes if judge_settings(arguments) else _rewards
    outcome = rescore(arguments, recording)
    for part in outcome.said:
        console.print(part, highlight=False, markup=False, soft_wrap=isinstance(part, str))
    if path is not None:
        content = plain({"equal": outcome.equal, **outcome.content})
        write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())
        print(f"wrote {path}")
    return int(not outcome.equal)


def _recording(path: Path) -> Path:
    """The recording itself; of a run folder of train-policy, the bag of its training."""
    return Path(read_summary(path)["bag"]) if (path / "policies").is_dir() else path


def _rewards(arguments: argparse.Namespace, bag: Path) -> Outcome:
    """The endogenous or rule rewards of a bag of loop 1."""
    if arguments.reward is not None:
        raise ValueError(f"--reward {arguments.reward} is of clips; {bag} holds a policy's episodes")
    model = recorded_model(bag, arguments.config, arguments.model_dir, arguments.device)
    report = rescore_bag(bag, model, namespace=arguments.namespace)
    said = [*report.different[:SHOWN], report.text()]
    return Outcome(report.equal, said, {"compared": report.compared, "different": report.different})


def _episodes(arguments: argparse.Namespace, bag: Path) -> Outcome:
    """The episodes of a bag of loop 1 by the reward agent; rewards that it gave live must come out again."""
    run_dir = bag.absolute().parent.parent
    saved = run_dir / CONFIG
    file = arguments.config or (str(saved) if saved.is_file() else "cpu")
    config = load_config(file, judge_settings(arguments) | device_settings(arguments))
    kept = Path(file).parent / READS
    judge = JudgeService(
        episode_judge(config), seed=config.seed, reads=arguments.reads or (kept if kept.is_dir() else None),
        audit=arguments.audit, device=config.device,
        model_dir=arguments.model_dir or model_of_run(run_dir, config.task),
    )
    with closing(judge):
        judged = judge_bag(bag, judge, namespace=arguments.namespace)
    counts = {status: sum(verdict.status is status for verdict in judged.verdicts) for status in Status}
    words = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    said = [
        f"{len(judged.verdicts)} episodes judged ({words or 'none'}), {len(judged.unseen)} not seen whole",
        *(f"  {reason}" for reason in judged.unseen[:SHOWN]),
        f"{judged.compared} recorded lock-steps are of this judge and rubric, {len(judged.different)} of them differ; "
        f"not compared: {judged.unanswered} rewards that were not given then",
    ]
    content = {"compared": judged.compared, "episodes": [verdict_row(verdict) for verdict in judged.verdicts]}
    return Outcome(not judged.different, said, content)


def _clips(arguments: argparse.Namespace, run_dir: Path) -> Outcome:
    """Every recorded picture of a run of loop 2."""
    chosen = {**reward_overrides(arguments.reward), **judge_settings(arguments), **device_settings(arguments)}
    run_dir, config = recorded_buffers.read_run(run_dir, chosen)
    device = compute_device(config.device)
    folder = load_video_folder(run_dir / "video_model", device)
    bags = recorded_buffers.recorded_episodes(run_dir, "train")
    contexts = load_clips(bags, config.model.stride, config.clip_steps, config.task)
    source = RecordedContexts(folder, contexts, config, load_probe(shipped_model(config.task), device))
    with _clip_judge(config, run_dir, contexts, clip_fps(bags[0], config.model.stride)) as judge:
        recordings = recorded_buffers.recorded_bags(run_dir)
        clips = chain.from_iterable(recorded_buffers.read_clips(recording, pictures=True) for recording in recordings)
        shown = tqdm(clips, desc="rescoring", unit="buffer")
        rows = [recorded_buffers.rescore(recorded, source, judge) for recorded in shown]
    if not rows:
        raise ValueError(f"{run_dir} holds no scored clips: it was stopped before its first score; go on with it")
    equal = all(not row.different for row in rows)
    words = "every score is the recorded one, bit for bit" if equal else "scores differ from the bag's"
    if not all(row.same_reward for row in rows):
        words += "; the total is by other rewards than recorded, so it is not compared"
    if silent := sum(row.unanswered for row in rows):
        words += f"; {silent} clips that got no reward then are not compared"
    return Outcome(equal, [_table(rows), words], {"rewards": config.rewards, "buffers": [_row(row) for row in rows]})


@contextmanager
def _clip_judge(config: VideoRlConfig, run_dir: Path, contexts: Clips, fps: float) -> Iterator[BufferJudge | None]:
    """The run's reward agent with the answers that it kept; None where it is not among the rewards."""
    if not config.rewards.get(AGENT):
        yield None
        return

    def verdicts(
        recorded: RecordedClips, frames: Tensor, references: Clips
    ) -> tuple[Mapping[str, Tensor], tuple[Mapping[str, Any], ...]]:
        jobs = buffer_jobs(
            frames, references, recorded.sha256, config, given=config.model.num_conditioning, fps=fps
        )
        found = judge.judge(jobs)
        return agent_scores(found), tuple(verdict_row(verdict) for verdict in found)

    settings = for_task(judge_or_embedded(config.judge), config.task)
    judge = JudgeService(
        settings, seed=config.seed, reads=run_dir / READS, model_dir=shipped_model(config.task), device=config.device
    )
    with closing(judge):
        yield verdicts


def verdict_row(verdict: Verdict) -> dict[str, object]:
    return {name: getattr(verdict, name) for name in ("clip_id", "status", "reward", "level", "reason", "audit_id")}


def _row(row: Rescored) -> dict[str, object]:
    recorded = row.recorded
    return {
        "iteration": recorded.iteration, "policy_version": recorded.policy_version, "sha256": recorded.sha256,
        "recorded": recorded.total.tolist(), "again": row.total.tolist(), "different": list(row.different),
        "verdicts": list(row.verdicts),
    }


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
