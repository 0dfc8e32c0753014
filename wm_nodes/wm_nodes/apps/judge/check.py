"""Say what a judge is good for, by the labelled clips that are shipped with this package.

    wm judge check http://127.0.0.1:8000/v1 --model Qwen/Qwen3-VL-8B-Instruct
    wm judge check embedded
    wm judge check URL --model NAME --limit 16 --judge.extra_body '{chat_template_kwargs: {enable_thinking: false}}'

132 clips of robot tasks, half of them clean or edited so slightly that they must pass, half with a fault of the
picture, of time or of physics. Asked: some questions twice; every clip in mode reward, then in mode benchmark. Printed:
whether the server keeps to the JSON schema and gives probabilities of letters; invalid answers; how often the same
question gets another answer; time, calls and tokens; the paper's Table 2 for this judge; the share of clean and benign
clips that it pays, and of each kind of fault. The last line says what it is good enough for.
Exit code 0: good enough for a reward. At least 95 % of clean and benign successes are kept, at most 15 % of faults are
paid, at most 10 % of clips have no number, and the balanced accuracy of overall is at least 80 %. Exit code 1: not.
wm judge serve-help names models and the lines that serve them.
"""

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from wm_nodes.apps.options import add_device, add_json, add_settings, positive, settings
from wm_nodes.config.load import judge_or_embedded, judge_overrides, load_config
from wm_nodes.core.files import write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.judge.backends.factory import check_judge, judge_name
from wm_nodes.judge.check_report import CheckReport, Share, report
from wm_nodes.judge.check_run import MODES, choose, run_check
from wm_nodes.judge.check_set import load_check_set
from wm_nodes.judge.paper_table import paper_table
from wm_nodes.reports.console_table import make_table, percent, percent_interval


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("judge", metavar="URL|embedded|FOLDER", help="a server's base URL with /v1, or another judge")
    parser.add_argument("--model", default="", metavar="NAME", help="its name on the server")
    parser.add_argument("--key-env", default="", metavar="VARIABLE", help="environment variable with the server's key")
    parser.add_argument("--rubric", default="", help="rubric pack: a name, or a .yaml file")
    parser.add_argument("--limit", type=positive, metavar="N", help="only so many clips, evenly from all kinds")
    parser.add_argument("--reads", type=Path, metavar="FOLDER",
                        help="folder that keeps a server's answers; the same command goes on with them")
    add_settings(parser)
    add_device(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Check the judge, print the report, return 0 where it is good enough for a reward."""
    overrides = judge_overrides(arguments.judge, arguments.model, arguments.key_env, arguments.rubric)
    config = load_config("cpu", overrides | settings(arguments))
    judge = judge_or_embedded(config.judge)
    check_judge(judge)
    clips = load_check_set()
    if arguments.limit:
        clips = choose(clips, arguments.limit)
    print(f"{judge_name(judge)}: {len(clips)} clips in {len(MODES)} modes")
    with ExitStack() as stack:
        reads = arguments.reads or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="wm_judge_check_")))
        progress = stack.enter_context(tqdm(total=len(MODES) * len(clips), desc="asked", unit="clip", disable=None))

        def step() -> None:
            progress.update()

        try:
            answers = run_check(judge, clips, reads=reads, seed=config.seed, device=config.device, done=step)
        except KeyboardInterrupt:
            kept = "the same command goes on with the answers" if arguments.reads else "name --reads to keep answers"
            print(kept, file=sys.stderr)
            raise
    numbers = report(answers)
    show(numbers)
    if arguments.json:
        written = {"judge": judge_name(judge), "command": arguments.command, **numbers.numbers()}
        write_atomic(arguments.json, (json.dumps(written, indent=1) + "\n").encode())
    print(numbers.sentence)
    return int(bool(numbers.misses))


def show(numbers: CheckReport) -> None:
    """Print everything but the last sentence."""
    for what, measured in _answers(numbers):
        print(f"{what + ':':40} {measured}")
    console = Console(width=None if sys.stdout.isatty() else 180)
    console.print(paper_table("accuracy in the layout of the paper's Table 2, mode benchmark", numbers.rows))
    console.print(make_table(
        "paid in mode reward; of clean and benign successes: kept",
        ("clips", "near cameras", "policy's", "all", "percent (95 % Wilson)"),
        ((name, *(f"{part.count} of {part.of}" for part in parts.values()),
          f"{percent(parts['all'].value)} ({percent_interval(*parts['all'].interval)})")
         for name, parts in numbers.paid.items()),
        no_wrap=("clips", "percent (95 % Wilson)"),
    ))
    for reason, count in numbers.reasons:
        print(f"no number, {count} times: {reason}")
    for reason in dict.fromkeys(numbers.not_judged.values()):
        names = [name for name, why in numbers.not_judged.items() if why == reason]
        print(f"not judged, {len(names)} clips ({names[0]} to {names[-1]}): {reason}")


def _answers(numbers: CheckReport) -> list[tuple[str, str]]:
    mass = f", label mass {numbers.label_mass:.2f}" if numbers.label_mass == numbers.label_mass else ""
    told = {mode: ", ".join(f"{count} {name}" for name, count in by.items()) for mode, by in numbers.statuses.items()}
    costs = {mode: ", ".join(f"{value:.4g} {name}" for name, value in cost.items() if value)
             for mode, cost in numbers.cost.items()}
    return [
        ("JSON answers that keep to the schema", _share(numbers.schema)),
        ("letters with probabilities", _share(numbers.letters) + mass),
        ("same question, another answer", _share(numbers.flips)),
        ("clips without a number, mode reward", _share(numbers.invalid)),
        ("a call, s: median, 95 %", _seconds(numbers.call_s)),
        ("a clip in mode reward, s: median, 95 %", _seconds(numbers.clip_s)),
        *((f"verdicts in mode {mode}", told[mode] or "none") for mode in MODES),
        *((f"a clip costs in mode {mode}", costs[mode]) for mode in MODES),
    ]


def _share(share: Share) -> str:
    return f"{share.count} of {share.of}, {percent(share.value)} %" if share.of else "not asked"


def _seconds(values: tuple[float, float]) -> str:
    return ", ".join("-" if value != value else f"{value:.3g}" for value in values)
