"""Judge clips of your own by the reward agent: videos in a folder, with a clips.jsonl that says what each should show.

    wm judge-clips CLIPS --judge http://host:8000/v1 --judge-model NAME --audit CLIPS/audit
    wm judge-clips CLIPS --judge embedded

A line of clips.jsonl: {"file": "a.mp4", "instruction": "push the red bar away from the robot", "task_id":
"push"}; also clip_id, robot, fps (of a .npy), reference (the picture that the clip had to start from), goal, and
sha256, which is checked.
Verdicts are appended to CLIPS/verdicts.jsonl (`accepted`: whether the clip is a success; null where the judge cannot
tell); started again, it goes on with the clips that were not judged by this judge, under these settings, with this task
and these pictures (`key`, their hash). Verdicts with another key, those of older versions included, stay in the file,
and their clips are judged again: the last line of a clip counts. A clip that cannot be read has an ERROR of its own.
The exit code is 1 where a clip has an ERROR, or no clip at all has a reward.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from statistics import fmean
from typing import Any

from wm_nodes.apps.options import add_device, add_json, add_judge, device_settings, judge_settings
from wm_nodes.config.load import judge_or_embedded, load_config
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.agent.types import Status, media_sha
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.calls import sha_of
from wm_nodes.judge.clip_files import AT_ONCE, read_job, read_list
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.service import ClipJob, JudgeService

VERDICTS = "verdicts.jsonl"
CHANGES_NO_ANSWER = {
    "folder", "api_key_env", "robot", "concurrency", "max_in_flight", "clip_budget_s", "tries", "json_timeout_s",
    "label_timeout_s", "repeat_share", "keep_reads",
}
"""Settings that may be others in a verdict that is kept. An embedded judge's identity says what is in its folder."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("clips", type=Path, help="folder of clips.jsonl and its files")
    parser.add_argument("--config", default="cpu", help="a preset or .yaml with a judge section (default: cpu)")
    add_device(parser)
    add_judge(parser)
    parser.add_argument(
        "--mode", choices=("reward", "benchmark", "topreward"),
        help="benchmark: every component is read; topreward: the reward is a server's probability of True for 'the "
        "task is completed', and nothing else is read",
    )
    parser.add_argument("--audit", type=Path, help="folder of an audit log to write, for the viewer and for people")
    parser.add_argument("--round", type=int, default=0, metavar="N", help="of these clips in that log (default: 0)")
    parser.add_argument("--reads", type=Path, help="folder that keeps a server's answers")
    add_json(parser, f"default: {VERDICTS} beside the clips")


def run(arguments: argparse.Namespace) -> int:
    """Judge what is not judged yet and print a summary; return 1 where a clip has an ERROR, or none has a reward."""
    overrides = judge_settings(arguments) | device_settings(arguments)
    overrides |= {"judge.mode": arguments.mode} if arguments.mode else {}
    config, lines = load_config(arguments.config, overrides), read_list(arguments.clips)
    path = arguments.json or arguments.clips / VERDICTS
    settings = judge_or_embedded(config.judge)
    judge = JudgeService(
        settings, seed=config.seed, tasks=[line.task_id for line in lines], reads=arguments.reads,
        audit=arguments.audit, device=config.device,
    )
    with closing(judge), path.open("a+", encoding="utf-8") as written:
        by = {"rubric": judge.version, "mode": settings.mode, "seed": config.seed}
        judges = {task: judge.judge_of(task) for task in {line.task_id for line in lines}}
        written.seek(0)
        before = written.read()
        written.write("" if before.endswith("\n") or not before else "\n")  # after a line that a crash has torn
        asked = {task: [judge_id, by, settings.model_dump(mode="json", exclude=CHANGES_NO_ANSWER)]
                 for task, judge_id in judges.items()}
        done = _judged_before(before)
        rows, waiting = list[dict[str, Any]](), list[ClipJob]()
        progress = tqdm(total=len(lines), desc="judged", unit="clip", disable=None)

        def flush() -> None:
            for job, verdict in zip(waiting, judge.judge(waiting, round_number=arguments.round), strict=True):
                task = job.task.task_id
                rows.append({"key": _key(job, asked[task]), **_row(job, verdict), **by, "judge_id": judges[task]})
                written.write(json.dumps(rows[-1]) + "\n")
            written.flush()
            progress.update(len(waiting))
            waiting.clear()

        with progress:
            for job in (read_job(arguments.clips, line) for line in lines):
                if (known := done.get(_key(job, asked[job.task.task_id]))) is not None:
                    rows.append(known)
                    progress.update()
                    continue
                waiting.append(job)
                if len(waiting) >= max(AT_ONCE, settings.concurrency):
                    flush()
            flush()
    _summarise(rows, path)
    unpaid = bool(rows) and all(row["reward"] is None for row in rows)
    if unpaid:
        print("error: not one clip has a reward; the reasons are above", file=sys.stderr)
    return int(unpaid or any(row["status"] == Status.ERROR for row in rows))


def _key(job: ClipJob, asked: list[Any]) -> str:
    """SHA-256 of a clip and of all that its answers hang on."""
    task, fps = job.task, job.clip.fps
    pictures = [None if one is None else media_sha(one, fps) for one in (task.reference_frame, task.goal_image)]
    return sha_of([job.clip.sha256, task.task_id, task.instruction, task.robot, pictures, asked])


def _row(job: ClipJob, verdict: Verdict) -> dict[str, Any]:
    return {
        "clip_id": job.clip.clip_id, "status": str(verdict.status),
        "reward": verdict.reward if verdict.valid else None, "accepted": accepts(verdict), "level": verdict.level,
        "stages": {str(s.stage): s.s for s in verdict.stages if s.status is Status.OK},
        "hacks": [flag.pattern for flag in verdict.hack_flags if flag.confirmed],
        "reason": verdict.reason, "audit_id": verdict.audit_id,
    }


def _judged_before(written: str) -> dict[str, dict[str, Any]]:
    """Rows by key; an ERROR is asked again, a torn line is passed over."""
    found = dict[str, dict[str, Any]]()
    for text in written.removeprefix("\ufeff").split("\n"):
        try:
            row = json.loads(text)
        except ValueError:
            continue
        if row.get("status") != Status.ERROR:
            found[row.get("key", "")] = row
    return found


def _summarise(rows: Sequence[dict[str, Any]], path: Path) -> None:
    counts = Counter(row["status"] for row in rows)
    told = ", ".join(f"{count} {status}" for status, count in counts.items())
    rewards = [row["reward"] for row in rows if row["reward"] is not None]
    mean = f", mean reward {fmean(rewards):.3f}" if rewards else ""
    print(f"{len(rows)} clips ({told or 'none'}){mean}")
    for row in [row for row in rows if row["status"] != Status.OK][:5]:
        print(f"  {row['clip_id']}: {row['status']}, {row['reason']}")
    print(f"wrote {path}")
