"""Work on audit logs of the judge: verify, recover, sample, view, agree, people, replay, adopt; see docs/audit.md."""

import argparse
import asyncio
import hashlib
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
from wm_nodes.judge.audit.adoption import MARGIN, Registry, compare, decide
from wm_nodes.judge.audit.agreement import join_labels, report, table
from wm_nodes.judge.audit.entries import plain
from wm_nodes.judge.audit.labels import load_all
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
        return one

    def of_log(name: str, run: Callable[[argparse.Namespace], int | None], about: str) -> argparse.ArgumentParser:
        one = command(name, run, about)
        one.add_argument("log", type=Path, help="folder of the audit log")
        return one

    one = of_log("verify", _verify, "check every line, verdict and picture; name what was changed")
    one.add_argument("--no-pictures", action="store_true", help="check the lines and verdicts only")
    one.add_argument("--head", default="", help="a head noted earlier: fail where the log has lost it")
    of_log("recover", _recover, "cut off a last line that a crash has torn, and keep it beside the log")
    one = of_log("sample", _sample, "choose the clips of a round that a person should look at")
    one.add_argument("--round", type=int, default=0)
    add_seed(one)
    one.add_argument("--size", type=int, help="another number of clips than 200 + 400 (1 - mean reward)")
    one.add_argument("--output", type=Path, help="default: sample-ROUND.json in the log's folder")
    one = of_log("view", _view, "write the page on which people look at clips and label them")
    one.add_argument("--round", type=int, help="only this round")
    one.add_argument("--sample", type=Path, help="only the clips that `sample` chose")
    one.add_argument("--second", action="store_true", help="only those for a second annotator")
    one.add_argument("--output", type=Path, help=f"default: {FILE_NAME} in the log's folder; pictures stay there")
    one = of_log("agree", _agree, "compare the verdicts with exported labels, row by row of the paper's Table 2")
    one.add_argument("--labels", type=Path, nargs="+", required=True, help="files exported by the page")
    one.add_argument("--sample", type=Path, nargs="*", default=[], help="weight labels to the rounds drawn from")
    add_json(one)
    one = of_log("people", _people, "what labelled clips earn with people as the judge, and which ones are overpaid")
    one.add_argument("--labels", type=Path, nargs="+", required=True, help="files exported by the page")
    one.add_argument("--output", type=Path, required=True, help="folder of the new log")
    one = of_log("replay", _replay, "work verdicts out again, equal bit for bit or under a rubric with other numbers")
    one.add_argument("--round", type=int, help="only this round")
    one.add_argument("--rubric", help="pack or .yaml file with the same questions and other numbers")
    one.add_argument("--output", type=Path, help="with --rubric: folder of the new log")
    one = command("adopt", _adopt, "put a new rubric in force if it is no worse on the frozen set and better now")
    pair = ("OLD_LOG", "NEW_LOG")
    one.add_argument("registry", type=Path, help="folder of the rubric in force and of the decisions")
    one.add_argument("--frozen", nargs=2, type=Path, required=True, metavar=pair, help="both on the frozen set")
    one.add_argument("--frozen-labels", type=Path, nargs="+", required=True)
    one.add_argument("--newest", nargs=2, type=Path, required=True, metavar=pair, help="the same on the newest round")
    one.add_argument("--newest-labels", type=Path, nargs="+", required=True)
    one.add_argument("--margin", type=float, default=MARGIN, help="loss on the frozen set that may be chance")
    add_seed(one)


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
    judged = join_labels(read_record(arguments.log), load_all(arguments.labels), samples)
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
    record, labels = read_record(arguments.log), load_all(arguments.labels)
    chosen = [clip.evaluation for clip in join_labels(record, labels)]
    judge, progress = HumanJudge(labels), tqdm(chosen, desc="people", disable=None)
    with AuditLog(arguments.output) as log:
        by_people = asyncio.run(judge_again(record, progress, lambda e: (judge, record.rubric(e)), log))
    pairs = [(e.verdict, new) for e, new in zip(chosen, by_people) if e.verdict is not None]
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


def _adopt(arguments: argparse.Namespace) -> int:
    registry = Registry(arguments.registry)
    logs = [read_record(path) for path in (*arguments.frozen, *arguments.newest)]
    frozen = compare(logs[0], logs[1], load_all(arguments.frozen_labels), seed=arguments.seed)
    newest = compare(logs[2], logs[3], load_all(arguments.newest_labels), seed=arguments.seed)
    versions = [{e.agent.rubric_version for e in log.judged()} for log in logs]
    if versions[0] != versions[2] or versions[1] != versions[3]:
        raise AuditError(f"old and new must be one rubric each in both sets, got {[sorted(v) for v in versions]}")
    (old,), (new,) = versions[0], versions[1]
    decided = decide(frozen, newest, old, new, margin=arguments.margin)
    digest = hashlib.sha256()
    for path in sorted(arguments.frozen_labels):
        digest.update(path.read_bytes())
    if registry.frozen_set not in ("", digest.hexdigest()):
        print("NOTE the frozen set is another one than at the last decision")
    facts = {"heads": [log.head for log in logs], "margin": arguments.margin, "seed": arguments.seed}
    registry.record(decided, {**logs[0].rubrics, **logs[1].rubrics}, digest.hexdigest(), facts)
    for name, (before, after) in frozen.rows.items():
        later = newest.rows.get(name)
        text = f"{100 * later[0]:.1f} -> {100 * later[1]:.1f}" if later else "-"
        print(f"{name:16} balanced accuracy, frozen {100 * before:.1f} -> {100 * after:.1f}, newest {text}")
    print(f"{'ADOPTED' if decided.adopted else 'NOT ADOPTED'} {new}: {decided.reason}")
    print(f"in force: {registry.current}, in {registry.folder}")
    return int(not decided.adopted)
