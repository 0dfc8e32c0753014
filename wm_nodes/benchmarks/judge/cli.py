"""The reward agent against labels: Table 2 of the paper (table), what its economy saves (efficiency); other papers'
rewards on the same clips (comparisons).
"""

import argparse
import asyncio
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.judge import (
    erring,
    fault_visibility,
    imagined_vs_real,
    metrics,
    pai_bench,
    speed,
    success_clips,
    tables,
)
from benchmarks.judge.compared import PROTOCOLS, ComparedRow, answer_file, compared, comparison_table, num_answers
from benchmarks.judge.efficiency import ARMS, measure_savings, savings_table, trials
from benchmarks.judge.judges import NAMES, open_comparison, open_judge
from benchmarks.judge.line_file import LineFile
from benchmarks.judge.run import JudgeTrial, Outcome, judge_rows
from benchmarks.judge.test_split_log import judge_name, notice, record_evaluation
from benchmarks.speed.results import write_results
from wm_nodes.apps.options import add_device, add_json, add_seed
from wm_nodes.core.device import CPU
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.agent.judge import Judge
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import Stage
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestRow
from wm_nodes.judge.dataset.rows import MIN_TEST_CLIPS, select_rows
from wm_nodes.judge.dataset.set_files import load_set

LOG_COLUMNS = 180
JUDGED = "judged"
"""Folder of a set that holds the outcomes, and the reads bought from a server."""
ROUTED = [stage for stage in Stage if stage is not Stage.REFLECT]
"""Stages that may have a judge of their own."""
console = Console()
OTHERS = {
    "imagined-vs-real": (imagined_vs_real, "the judge on imagined clips against what the simulator says"),
    "erring": (erring, "what planning, gates, votes and reflection gain and cost under a judge that errs"),
    "speed": (speed, "clips that the embedded judge reads per second"),
    "fault-visibility": (fault_visibility, "pixels by which a physical fault differs from its clean recording"),
    "success-clips": (success_clips, "labelled episodes of RoboRewardBench or of a table: MAE, AUROC, accuracy"),
    "pai-bench": (pai_bench, "the robot protocol of PAI-Bench over a folder of videos"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="EXPERIMENT")
    raw = argparse.RawDescriptionHelpFormatter
    for name, (measure, text) in EXPERIMENTS.items():
        command = experiments.add_parser(name, help=text, description=text, parents=[_common()])
        command.set_defaults(run=run, measure=measure)
        command.add_argument("--clips", type=int, help="the first so many in the order of their hashes; default: all")
        if name == "comparisons":
            command.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    for name, (module, text) in OTHERS.items():
        command = experiments.add_parser(name, help=text, description=module.__doc__, formatter_class=raw)
        command.set_defaults(run=module.run)
        module.add_options(command)


def _common() -> argparse.ArgumentParser:
    """Options of the experiments over a set of clips with known labels."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("set", type=Path, help="folder of a set, see wm build-judge-dataset")
    common.add_argument("--judge", choices=NAMES, default="embedded", help="simulator: a control that knows the labels")
    common.add_argument("--rubric", default="robot", help="a rubric pack, or a .yaml")
    common.add_argument("--part", choices=("test", "validation", "train"), default="test")
    common.add_argument("--again", default="", metavar="REASON", help="for a further evaluation on the test split")
    add_json(common)
    add_seed(common)
    add_device(common, CPU)
    common.add_argument("--at-once", type=int, default=1, help="clips under way together, behind a server")
    common.add_argument("--folder", type=Path, help="of the embedded judge; the shipped one by default")
    common.add_argument(
        "--conformal", type=float, default=0.0, metavar="COVERAGE",
        help="the embedded judge abstains where it is not sure at this coverage, e.g. 0.9; 0: it always decides",
    )
    common.add_argument("--stages", nargs="+", choices=ROUTED, default=[], help="that --model reads in its place")
    common.add_argument("--url", nargs="+", default=[], help="of chat servers, http://HOST:PORT/v1")
    common.add_argument("--model", default="", help="that they serve")
    common.add_argument("--api-key-env", default="", help="environment variable that holds their key")
    common.add_argument("--price", nargs=2, type=float, default=[], metavar="USD", help="per million tokens in and out")
    common.add_argument("--max-images", type=int, default=64, help="that it takes in one call")
    return common


def run(arguments: argparse.Namespace) -> None:
    """One of EXPERIMENTS; judged clips are kept, so that it goes on where it was interrupted."""
    if not console.is_terminal:
        console.width = LOG_COLUMNS
    asyncio.run(arguments.measure(arguments))


async def _table(arguments: argparse.Namespace) -> None:
    rubric = load_rubric(arguments.rubric)
    rows, outcomes, facts = await _judge_set(arguments, rubric, [JudgeTrial("table", rubric, seed=arguments.seed)])
    results = outcomes["table"]
    agreements = metrics.agreement(rows, results, rubric)
    patterns = metrics.pattern_rows(rows, results, tuple(rubric.hack.patterns))
    statuses, cost = metrics.statuses(results), metrics.cost_row(results, arguments.price)
    caption = f"{facts['judge']}; rubric {rubric.version}; {arguments.part}, {len(rows)} clips: {statuses}"
    splits = metrics.by_split(rows, results, rubric)
    console.print(tables.table2(agreements, caption), tables.split_table(splits))
    console.print(tables.confusion_table(agreements, patterns), tables.pattern_table(patterns))
    console.print(tables.cost_table({"agent, benchmark mode": cost}))
    below = [*metrics.missed_targets(agreements), *metrics.missed_patterns(patterns)]
    mistakes = metrics.mistakes(rows, results, rubric)
    _print_notes(arguments, len(rows), facts["notice"], below, metrics.most_frequent(mistakes))
    write_results(arguments, {
        "experiment": "table", **facts, "statuses": statuses, "cost": cost,
        "splits": {name: [asdict(row) for row in table] for name, table in splits.items()},
        "rows": [asdict(row) for row in agreements], "patterns": [asdict(row) for row in patterns],
        "missed": below, "mistakes": metrics.most_frequent(mistakes, 40),
    })


async def _efficiency(arguments: argparse.Namespace) -> None:
    wanted = trials(arguments.rubric, arguments.seed)
    rows, outcomes, facts = await _judge_set(arguments, load_rubric(arguments.rubric), wanted)
    costs = {ARMS[name]: metrics.cost_row(of_arm, arguments.price) for name, of_arm in outcomes.items()}
    savings = measure_savings(rows, outcomes)
    caption = f"{facts['judge']}; {arguments.part}, {len(rows)} clips"
    console.print(tables.cost_table(costs), savings_table(savings, caption))
    _print_notes(arguments, len(rows), facts["notice"], [], [])
    compared_rows = [asdict(row) for row in savings]
    write_results(arguments, {"experiment": "efficiency", **facts, "per_clip": costs, "compared": compared_rows})


async def _comparisons(arguments: argparse.Namespace) -> None:
    manifest = load_set(arguments.set)
    rows = select_rows(manifest, arguments.part, arguments.clips)
    results: list[ComparedRow] = []
    async with open_comparison(arguments) as judge:
        with tqdm(total=sum(num_answers(name, rows) for name in arguments.protocols), desc="asked") as bar:
            for name in arguments.protocols:
                bar.set_postfix_str(name)
                file = answer_file(arguments.set / JUDGED, name, arguments.model, arguments.seed)
                options: dict[str, Any] = {"at_once": arguments.at_once, "on_answer": bar.update}
                results.append(await compared(judge, name, arguments.set, rows, file, **options))
    caption = f"{arguments.model}; {arguments.part}, {len(rows)} clips; wins: hacked scores >= its clean recording"
    console.print(comparison_table(results, caption))
    write_results(arguments, {
        "experiment": "comparisons", "model": arguments.model, "part": arguments.part, "clips": len(rows),
        "seed": arguments.seed, "rows": [asdict(row) for row in results],
    })


async def _judge_set(
    arguments: argparse.Namespace, rubric: Rubric, wanted: Sequence[JudgeTrial]
) -> tuple[list[ManifestRow], dict[str, list[Outcome]], dict[str, Any]]:
    """The clips of the part, their outcomes by trial, and what the --json file says of the judge and the clips."""
    manifest, outcomes = load_set(arguments.set), dict[str, list[Outcome]]()
    rows = select_rows(manifest, arguments.part, arguments.clips)
    async with open_judge(arguments, rubric, manifest, arguments.set / JUDGED / "reads") as judge:
        said = _record_test_evaluation(arguments, manifest, judge, rubric)
        with tqdm(total=len(wanted) * len(rows), desc="judged", unit="clip") as bar:
            for trial in wanted:
                bar.set_postfix_str(trial.name)
                path = arguments.set / JUDGED / f"{trial.key(judge.capabilities)}.jsonl"
                outcomes[trial.name] = await judge_rows(
                    judge, trial, arguments.set, rows, LineFile(path, Outcome, "sha256"), at_once=arguments.at_once,
                    on_clip=bar.update,
                )
        who = judge_name(judge.capabilities)
    return rows, outcomes, {
        "judge": who, "rubric": rubric.version, "part": arguments.part, "clips": len(rows), "seed": arguments.seed,
        "notice": said,
    }


def _record_test_evaluation(arguments: argparse.Namespace, manifest: Manifest, judge: Judge, rubric: Rubric) -> str:
    """Record an evaluation on the test split; return what the output must say of it. Controls are not recorded."""
    if arguments.part != "test" or arguments.judge == "simulator":
        return ""
    others = record_evaluation(arguments.set, manifest, judge.capabilities, rubric.version, arguments.again)
    return notice(others, arguments.again)


def _print_notes(
    arguments: argparse.Namespace, count: int, said: str, below: Sequence[str], wrong: Sequence[tuple[str, int]]
) -> None:
    lines = [said] if said else []
    if count < MIN_TEST_CLIPS:
        lines.append(f"{count} clips: fewer than {MIN_TEST_CLIPS}, the intervals are too wide to claim a match")
    if arguments.judge == "simulator":
        lines.append("the judge knows the labels: a control of the machinery, not a result")
    if below:
        lines.append(f"missed, of the paper's figures and the targets: {', '.join(below)}")
    if wrong:
        lines.append(f"wrong most often: {', '.join(f'{name} ({times})' for name, times in wrong)}")
    for line in lines:
        console.print(line, style="bold", highlight=False, soft_wrap=True)


EXPERIMENTS = {
    "table": (_table, "agreement with the labels in the layout of Table 2, hacking patterns, cost"),
    "efficiency": (_efficiency, "calls, images, pixels and tokens against reading everything of every clip"),
    "comparisons": (_comparisons, "other papers' rewards through a chat server: ranking, hacked clips that win"),
}
