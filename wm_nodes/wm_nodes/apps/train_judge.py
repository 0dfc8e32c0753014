"""Train the embedded judge on sets of clips with known labels, or measure a trained one (RA-17 to RA-20).

The sets' own division says which episodes train, which calibrate, and which nobody has seen. Started again, it takes up
finished stages that lie in OUT.

    wm train-judge OUT SET [SET ...] --seed 0
    wm train-judge OUT SET [SET ...] --measure test
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from wm_nodes.apps.options import add_device, add_seed, add_threads, positive, prepare_torch
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.files import write_atomic
from wm_nodes.judge.dataset.build import SIDE_PX
from wm_nodes.judge.dataset.policy_camera import policy_models, policy_window
from wm_nodes.judge.evidence.head import load_head, save_head
from wm_nodes.judge.evidence.trees import TreeSettings
from wm_nodes.judge.training.data import load_sets
from wm_nodes.judge.training.heads import CONFORMAL, TARGETS, conformal_errors, measure_target
from wm_nodes.judge.training.train import JudgePlan, collect_evidence, make_judge
from wm_nodes.reports.machine import machine_facts
from wm_nodes.world_model import load_model_folder


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, help="folder of the judge, and of finished stages")
    parser.add_argument("sets", type=Path, nargs="+", help="folders made by build-judge-dataset, of one division")
    add_seed(parser)
    parser.add_argument("--segmenter-steps", type=int, default=JudgePlan.segmenter_steps, help="batches of 16 pictures")
    parser.add_argument(
        "--readers", type=int, default=JudgePlan.readers, help="networks over time per half of the recordings; 0: none"
    )
    parser.add_argument("--reader-epochs", type=positive, default=JudgePlan.reader_epochs, help="times each sees it")
    parser.add_argument("--trees", type=int, default=TreeSettings.num_trees, help="per question")
    add_device(parser, CPU)
    add_threads(parser)
    parser.add_argument(
        "--policy-view", nargs="?", type=Path, const=Path(), metavar="MODEL_DIR",
        help="the sets were made with this option; the judge reads what the loops of this world model show",
    )
    parser.add_argument("--measure", choices=("train", "validation", "test"), help="train nothing, measure this part")


def run(arguments: argparse.Namespace) -> None:
    """Train or measure, and print a line per target."""
    if arguments.readers < 0:
        raise ValueError(f"--readers must be at least 0, got {arguments.readers}")
    prepare_torch(arguments.threads)
    device = compute_device(arguments.device)
    print(table(_measured(arguments, device) if arguments.measure else _trained(arguments, device)))


def _trained(arguments: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    window = None
    if arguments.policy_view is not None:
        models = load_model_folder(policy_models(arguments.policy_view))
        window = policy_window(models.simulation, SIDE_PX)
    plan = JudgePlan(
        tuple(arguments.sets), arguments.segmenter_steps, arguments.readers, arguments.reader_epochs,
        TreeSettings(arguments.trees), arguments.seed, window,
    )
    head = make_judge(arguments.out, plan, device=device)
    made = {"command": arguments.command, "machine": machine_facts(arguments.device)}
    head = replace(head, story={"made": made, **head.story})
    save_head(arguments.out, head)
    return dict(head.story["validation"])


def _measured(arguments: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    head = load_head(arguments.out, device)
    part = arguments.measure
    examples = collect_evidence(arguments.out, load_sets(arguments.sets), part, head.segmenter, head.readers)
    if not len(examples.rows):
        raise ValueError(f"the sets have no {part} clips; build larger ones")
    found: dict[str, Any] = {t: measure_target(head.questions, t, examples) for t in TARGETS}
    known = head.familiarity
    foreign = known.distance(examples.evidence) > known.limit
    found["foreign"] = {
        split: [int(sum(foreign[i] for i in chosen)), len(chosen)]
        for split in sorted({row.split for row in examples.rows})
        if (chosen := [i for i, row in enumerate(examples.rows) if row.split == split])
    }
    if head.story.get("conformal"):
        found["conformal"] = {
            f"{coverage:g}": conformal_errors(head.questions, head.conformal(coverage), examples)
            for coverage in CONFORMAL
        }
    write_atomic(arguments.out / f"measured-{part}.json", (json.dumps(found, indent=1) + "\n").encode())
    return found


def table(report: Mapping[str, Any]) -> str:
    """One line per target; of hacking patterns the share flagged (of clips with it, of others) and what could be
    flagged at 5 % of the others; then how many clips of each split are too foreign to judge."""
    columns = ("n", "fails", "acc", "bal.", "AUROC", "ECE", "level", "flag", "false", "at 5 %")
    lines = [f"{'target':16} " + " ".join(f"{name:>6}" for name in columns)]
    for name in TARGETS:
        found = report[name]
        more = " ".join(
            f"{100 * found[key]:6.1f}" if key in found else " " * 6
            for key in ("level_accuracy", "flagged", "false_flags", "recall_at_5")
        )
        lines.append(
            f"{name:16} {found['n']:6} {found['fails']:6} {100 * found['accuracy']:6.1f} "
            f"{100 * found['balanced_accuracy']:6.1f} {found['auroc']:6.3f} {found['ece']:6.3f} {more}".rstrip()
        )
    for coverage, at in report.get("conformal", {}).items():
        lines.append(f"abstaining at conformal coverage {coverage}: {100 * at['answered']:.1f} % of the clips answered")
        for name, of in at["targets"].items():
            if of["silent"] >= 0.002:
                errors = [
                    f"{words} {' -> '.join(f'{100 * share:.1f}' for share in of[key])} %"
                    for key, words in (("fail_as_pass", "fail called pass"), ("pass_as_fail", "pass called fail"))
                ]
                lines.append(f"  {name:16} silent {100 * of['silent']:.1f} %; {'; '.join(errors)}")
    lines += [f"too foreign to judge, {split}: {a} of {n}" for split, (a, n) in report.get("foreign", {}).items()]
    return "\n".join(lines)
