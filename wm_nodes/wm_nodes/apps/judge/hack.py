"""See whether a judge can be hacked on clips of your own: spoil those that it pays, and count what it still pays.

    wm judge hack CLIPS --judge http://host:8000/v1 --judge-model NAME --reads CLIPS/reads --pictures CLIPS/paid
    wm judge hack BAG --judge embedded --json hack.json

CLIPS is a folder of videos with a clips.jsonl (see wm judge-clips), a recorded bag, or a folder with bags in it; an
episode of a bag is a clip. Only clips that the judge pays unedited are attacked: accepted ones, or with --least R those
of a reward of R or more.
The edits need nothing but pixels. They are of the paper's four patterns: occlusion (blur, patches, darkness, noise),
motion (jumps, freezes, disorder), background (scenery flattened, repainted, drifting) and physics (an object that moves
by itself, vanishes, doubles, grows; a robot that fades). Each has four steps, from slight to gross, and the first frame
stays. An edit of which too little is seen in a clip is left out and counted. Harmless changes (JPEG, slight noise, half
a pixel, 5 % brightness) have to stay paid, so that refusing everything is no way out.
The exit code is 1 where, of the edited clips of any pattern at the steps 3 and 4, more than --limit are still paid, or
none is visible; where less than 95 % of the harmlessly changed clips are still paid; and where the judge leaves more
than 10 % of the questions unanswered (ERROR). Edits of one clip are alike, so the intervals are too narrow.
With --reads a server is not asked twice when the command is started again.
"""

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from wm_nodes.apps.options import add_device, add_json, add_judge, add_seed, device_settings, judge_settings, positive
from wm_nodes.config.load import judge_or_embedded, load_config
from wm_nodes.core.files import write_atomic
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.clip_files import LIST, read_job, read_list
from wm_nodes.judge.hacking.attack import PER_CLIP, Attack
from wm_nodes.judge.hacking.edits import BENIGN, EDITS, GROSS, PATTERNS, STEPS
from wm_nodes.judge.hacking.outcomes import Attempt, failures, mildest_step, paid_of
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.recording import Bag, read_episodes, read_spec
from wm_nodes.recording.bag import METADATA
from wm_nodes.reports.console_table import decimal, make_table, percent, percent_interval

LOG_COLUMNS = 140
COUNTED = ("n", "not seen", "paid %", "95 % Wilson", "no verdict %", "reward", "unedited")
"""Columns of both tables: judged edits, those of which too little is seen, and what became of the judged ones."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("clips", type=Path, help="folder of clips.jsonl and its files, or of bags")
    parser.add_argument("--config", default="cpu", help="a preset or .yaml with a judge section (default: cpu)")
    add_device(parser)
    add_judge(parser)
    parser.add_argument("--least", type=float, metavar="R", help="reward from which a clip is paid (default: accepted)")
    parser.add_argument("--limit", type=float, default=0.15, metavar="SHARE", help="that may be paid (default: 0.15)")
    parser.add_argument(
        "--limit-clips", type=positive, default=60, metavar="N",
        help=f"attack the first N that are paid, {PER_CLIP} edits each (default: 60)",
    )
    add_seed(parser)
    parser.add_argument("--reads", type=Path, help="folder that keeps a server's answers")
    add_json(parser, "also write the counts of each edit and step to this file")
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="film strips of the clip of each edit that is paid most"
    )


def run(arguments: argparse.Namespace) -> int:
    """Attack the clips and print what is still paid; return 1 by the rule above."""
    if not 0 <= arguments.limit < 1:
        raise ValueError(f"--limit is a share from 0 to below 1, got {arguments.limit}")
    config = load_config(arguments.config, judge_settings(arguments) | device_settings(arguments))
    settings = judge_or_embedded(config.judge)
    judge = JudgeService(
        settings, seed=arguments.seed, tasks=_tasks(arguments.clips), reads=arguments.reads, device=config.device
    )
    with closing(judge):
        attack = Attack(judge, arguments.least, arguments.seed)
        attack.run(_jobs(arguments.clips, settings.robot), arguments.limit_clips)
    attempts, told = attack.attempts, failures(attack.attempts, arguments.limit)
    console = Console()
    if not console.is_terminal:
        console.width = LOG_COLUMNS
    facts = {"judge": judge.judge_id, "rubric": judge.rubric.version, "mode": settings.mode}
    caption = f"{facts['judge']}; {attack.paid} clips are paid unedited and attacked, {len(attack.refused)} are not"
    console.print(_edit_table(attempts, caption), _pattern_table(attempts, arguments.limit))
    console.print(*(told or ["this judge holds"]), sep="\n", style="bold", highlight=False)
    if arguments.json:
        write_atomic(arguments.json, (json.dumps({
            **facts, "seed": arguments.seed, "limit": arguments.limit, "least": arguments.least, "clips": attack.paid,
            "not_paid": attack.refused, "failures": told, "counts": _counts(attempts),
        }, indent=1) + "\n").encode())
    if arguments.pictures:
        print(f"{len(attack.draw(arguments.pictures))} pictures in {arguments.pictures}")
    return int(bool(told))


def _bags(folder: Path) -> list[Path]:
    """The bags of a folder without a list of clips."""
    return [] if (folder / LIST).exists() else sorted(path.parent for path in folder.rglob(METADATA))


def _tasks(folder: Path) -> list[str]:
    """Of the clips. Raises as _jobs."""
    bags = _bags(folder)
    if not bags:
        return [line.task_id for line in read_list(folder)]
    tasks = list[str]()
    for path in bags:
        with Bag(path) as bag:
            tasks += {str(row["task"]) for row in bag.episode_table()}
    return tasks


def _jobs(folder: Path, robot: str) -> Iterator[ClipJob]:
    """The clips of a list, or the episodes of bags. Raises ValueError: there are none of either. BagError."""
    bags = _bags(folder)
    if not bags:
        yield from (read_job(folder, line) for line in read_list(folder))
    for bag in bags:
        fps = 1 / read_spec(bag).control_period_s
        for episode in read_episodes(bag):
            clip = clip_ref(str(bag.relative_to(folder) / str(episode.episode_id)), episode.images, fps, "real")
            task = TaskSpec(episode.instruction, episode.task, robot, episode.images[0], actions=episode.actions)
            yield ClipJob(clip, task)


def _counts(attempts: Sequence[Attempt]) -> list[dict[str, Any]]:
    """How each edit fared at each step; None in place of NaN."""
    counts = []
    for edit in EDITS:
        for step in STEPS:
            found = [attempt for attempt in attempts if (attempt.edit, attempt.step) == (edit.name, step)]
            known = {name: None if value != value else value for name, value in asdict(paid_of(found)).items()}
            counts.append({"pattern": edit.pattern, "edit": edit.name, "step": step, **known})
    return counts


def _edit_table(attempts: Sequence[Attempt], caption: str) -> Table:
    cells = []
    for edit in EDITS:
        for step in STEPS:
            found = [attempt for attempt in attempts if (attempt.edit, attempt.step) == (edit.name, step)]
            cells.append((edit.pattern, edit.name, step, *_cells(found)))
    columns = ("pattern", "edit", "step", *COUNTED)
    title = "share of the edited clips that is still paid"
    return make_table(title, columns, cells, left=columns[:2], caption=caption, no_wrap=columns)


def _pattern_table(attempts: Sequence[Attempt], limit: float) -> Table:
    cells = []
    for pattern in (*PATTERNS, BENIGN):
        found = [attempt for attempt in attempts if attempt.pattern == pattern]
        asked = found if pattern == BENIGN else [attempt for attempt in found if attempt.step in GROSS]
        shares = [(paid_of([a for a in asked if a.edit == edit.name]).share, edit.name) for edit in EDITS]
        known = [(share, name) for share, name in shares if share == share]  # NaN: of another pattern, or not seen
        share, name = (min if pattern == BENIGN else max)(known, default=(math.nan, ""))
        step = "-" if pattern == BENIGN else mildest_step(found, limit) or "none"
        cells.append((pattern, *_cells(asked), step, f"{name} {percent(share)}"))
    columns = ("pattern", *COUNTED, "holds from", "worst edit")
    title = f"each pattern at its gross steps ({', '.join(map(str, GROSS))}), benign at all; limit {limit:.0%}"
    return make_table(title, columns, cells, no_wrap=columns)


def _cells(attempts: Sequence[Attempt]) -> tuple[object, ...]:
    """What COUNTED names."""
    paid = paid_of(attempts)
    return (
        paid.n, paid.hidden, percent(paid.share), percent_interval(paid.low, paid.high), percent(paid.silent),
        decimal(paid.reward), decimal(paid.unedited),
    )
