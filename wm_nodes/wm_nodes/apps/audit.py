"""Work on audit logs of the judge: verify, recover, sample, view, agree, people, replay; see docs/audit.md."""

import argparse
import asyncio
import json
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

from rich.console import Console

from wm_nodes.apps.options import add_json, add_seed
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.audit.agreement import join_labels, report, table
from wm_nodes.judge.audit.entries import plain
from wm_nodes.judge.audit.labels import read_labels
from wm_nodes.judge.audit.log import AuditError, AuditLog, recover
from wm_nodes.judge.audit.people import HumanJudge
from wm_nodes.judge.audit.reading import read_record, verify
from wm_nodes.judge.audit.replay import judge_again, reaggregate, replay_evaluation
from wm_nodes.judge.audit.sampling import draw, read_sample, write_sample
from wm_nodes.judge.audit.viewer import FILE_NAME, write_view

OVERPAID, SHOWN = 0.1, 10
"""`people` names so many clips whose reward is higher by more than this."""


def add_options(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], int | None], about: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=about, description=about)
        one.set_defaults(run=run)
        one.add_argument("log", type=Path, help="folder of the audit log")
        return one

    one = command("verify", _verify, "check every line, verdict and picture; name what was changed")
    one.add_argument("--no-pictures", action="store_true", help="check the lines and verdicts only")
    one.add_argument("--head", default="", help="a head noted earlier: fail where the log has lost it")
    command("recover", _recover, "cut off a last line that a crash has torn, and keep it beside the log")
    one = command("sample", _sample, "choose the clips of a round that a person should look at")
    one.add_argument("--round", type=int, default=0)
    add_seed(one)
    one.add_argument("--size", type=int, help="another number of clips than 200 + 400 (1 - mean reward)")
    one.add_argument("--output", type=Path, help="default: sample-ROUND.json in the log's folder")
    one = command("view", _view, "write the page on which people look at clips and label them")
    one.add_argument("--round", type=int, help="only this round")
    one.add_argument("--sample", type=Path, help="only the clips that `sample` chose")
    one.add_argument("--second", action="store_true", help="only those for a second annotator")
    one.add_argument("--output", type=Path, help=f"default: {FILE_NAME} in the log's folder; pictures stay there")
    one = command("agree", _agree, "compare the verdicts with exported labels, row by row of the paper's Table 2")
    one.add_argument("--labels", type=Path, nargs="+", required=True, help="files exported by the page")
    one.add_argument("--sample", type=Path, nargs="*", default=[], help="weight labels to the rounds drawn from")
    add_json(one)
    one = command("people", _people, "what labelled clips earn with people as the judge, and which ones are overpaid")
    one.add_argument("--labels", type=Path, nargs="+", required=True, help="files exported by the page")
    one.add_argument("--output", type=Path, required=True, help="folder of the new log")
    one = command("replay", _replay, "work verdicts out again, equal bit for bit or under a rubric with other numbers")
    one.add_argument("--round", type=int, help="only this round")
    one.add_argument("--rubric", help="pack or .yaml file with the same questions and other numbers")
    one.add_argument("--output", type=Path, help="with --rubric: folder of the new log")


def _verify(arguments: argparse.Namespace) -> int:
    checked = verify(arguments.log, pictures=not arguments.no_pictures, expected_head=arguments.head)
    for problem in checked.problems:
        print(f"FAULT {problem}")
    if checked.head:
        print(f"{checked.num_lines} lines, {checked.num_evaluations} evaluations, {checked.unfinished} without verdict")
        print(f"head     {checked.head}")
        print(f"verdicts {checked.verdicts}")
    print("sound" if not checked.problems else f"{len(checked.problems)} faults")
    return int(bool(checked.problems))


def _recover(arguments: argparse.Namespace) -> None:
    print(recover(arguments.log))


def _sample(arguments: argparse.Namespace) -> None:
    sample = draw(read_record(arguments.log), arguments.round, seed=arguments.seed, size=arguments.size)
    path = arguments.output or arguments.log / f"sample-{arguments.round}.json"
    write_sample(path, sample)
    drawn = Counter(clip.stratum for clip in sample.chosen)
    by = ", ".join(f"{drawn[name]} of {count} {name}" for name, count in sample.sizes.items())
    print(f"{len(sample.chosen)} of {sample.population} clips of round {sample.round_number}, mean reward "
          f"{sample.mean_reward:.3f}: {by}; {sum(clip.second for clip in sample.chosen)} for two people")
    print(f"wrote {path}")


def _view(arguments: argparse.Namespace) -> None:
    record = read_record(arguments.log)
    sample = read_sample(arguments.sample) if arguments.sample else None
    wanted = {clip.evaluation for clip in sample.chosen if clip.second or not arguments.second} if sample else None
    chosen = [e for e in record.judged(arguments.round) if wanted is None or e.number in wanted]
    path = write_view(arguments.output or arguments.log / FILE_NAME, record, chosen, sample)
    print(f"wrote {path} with {len(chosen)} clips; open it in a browser, press ? for its keys")


def _agree(arguments: argparse.Namespace) -> None:
    samples = [read_sample(path) for path in arguments.sample]
    judged = join_labels(read_record(arguments.log), [read_labels(path) for path in arguments.labels], samples)
    rounds = sorted({clip.evaluation.round_number for clip in judged})
    parts = [*rounds, None] if len(rounds) > 1 else rounds
    reports = [report(judged, number, weighted=bool(samples)) for number in parts]
    console = Console(width=None if sys.stdout.isatty() else 180)
    for numbers in reports:
        console.print(table(numbers))
    if arguments.json:
        text = json.dumps([plain(asdict(numbers)) for numbers in reports], indent=1, allow_nan=False)
        write_atomic(arguments.json, (text + "\n").encode())
        print(f"wrote {arguments.json}")


def _people(arguments: argparse.Namespace) -> None:
    record, labels = read_record(arguments.log), [read_labels(path) for path in arguments.labels]
    chosen = [clip.evaluation for clip in join_labels(record, labels)]
    judge, progress = HumanJudge(labels), tqdm(chosen, desc="people", disable=None)
    with AuditLog(arguments.output) as log:
        by_people = asyncio.run(judge_again(record, progress, lambda e: (judge, record.rubric(e)), log))
    pairs = [(evaluation.verdict, new) for evaluation, new in zip(chosen, by_people)]
    both = [(old.clip_id, (old.reward, new.reward)) for old, new in pairs if old.valid and new.valid]
    rewards = [pair for _, pair in both]
    print(f"{len(by_people)} clips, {sum(new.valid for new in by_people)} with a reward by people, {len(both)} by both")
    if both:
        means = [fmean(pair[k] for pair in rewards) for k in (0, 1)]
        print(f"mean reward: judge {means[0]:.3f}, people {means[1]:.3f}")
        overpaid = sorted((new - old, clip_id, old, new) for clip_id, (old, new) in both if old - new > OVERPAID)
        print(f"paid over {OVERPAID} more than people would: {len(overpaid)} of {len(both)}")
        for _, clip_id, old, new in overpaid[:SHOWN]:
            print(f"  {clip_id}: judge {old:.3f}, people {new:.3f}")
    print(f"wrote {arguments.output}; view and verify it as any log")


def _replay(arguments: argparse.Namespace) -> int:
    record = read_record(arguments.log)
    evaluations = record.judged(arguments.round)
    progress = tqdm(evaluations, desc="replay", disable=None)
    if arguments.rubric:
        if arguments.output is None:
            raise AuditError("a replay under another rubric needs --output, the folder of its own log")
        rubric = load_rubric(arguments.rubric)
        with AuditLog(arguments.output) as log:
            verdicts = asyncio.run(reaggregate(record, progress, rubric, log))
        open_ones = sum(not verdict.valid for verdict in verdicts)
        print(f"{len(verdicts)} verdicts under {rubric.version} in {arguments.output}, {open_ones} without a number")
        return 0
    results = [asyncio.run(replay_evaluation(record, evaluation)) for evaluation in progress]
    for result in results:
        if result.after is not None and not result.equal:
            print(f"evaluation {result.evaluation.number} of {result.evaluation.clip_id}: another verdict now")
    lost = sum(result.after is None for result in results)
    equal = sum(result.equal for result in results)
    print(f"{equal} of {len(results)} verdicts equal bit for bit, {lost} ran out of time then and cannot be repeated")
    return int(equal + lost != len(results))
