"""The reward agent under a judge that errs, and any judge on other people's labelled episodes."""

import argparse

from benchmarks.judge import erring, success_clips

EXPERIMENTS = {
    "erring": (erring, "what planning, gates, votes and reflection gain and cost under a judge that errs"),
    "success-clips": (success_clips, "labelled episodes of RoboRewardBench or of a table: MAE, AUROC, accuracy"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="EXPERIMENT")
    raw = argparse.RawDescriptionHelpFormatter
    for name, (module, text) in EXPERIMENTS.items():
        command = experiments.add_parser(name, help=text, description=module.__doc__, formatter_class=raw)
        command.set_defaults(run=module.run)
        module.add_options(command)
