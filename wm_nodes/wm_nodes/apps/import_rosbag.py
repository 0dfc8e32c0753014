"""Plain ROS bags of your robot into one of ours, as a contract says.

    wm import rosbag CONTRACT BAG... [--out FOLDER]

CONTRACT is a YAML file: which topics are cameras, state and commands, where episodes begin and end, what a success is.
wm_nodes/recording/imported/example.yaml shows all of it. MCAP and sqlite3, split or compressed.

First a table: rates, gaps, share of ticks without a sample, clock offsets, commands beyond the limits. Without --out
that is all. An observation is the newest sample at or before its tick, an action what was commanded from there to the
next. A stretch with a gap is left out and counted, never filled.
"""

import argparse
from pathlib import Path

from wm_nodes.recording import BagError
from wm_nodes.recording.imported import load_contract, survey, write


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("contract", type=Path, help="what the topics mean, a YAML file")
    parser.add_argument("bags", type=Path, nargs="+", help="rosbag2 folders, or files of them")
    parser.add_argument("--out", type=Path, help="folder of the new bag (default: the table alone)")


def run(arguments: argparse.Namespace) -> None:
    """Print the table, then write."""
    if arguments.out is not None and arguments.out.exists():
        raise BagError(f"{arguments.out} exists already; choose another name or remove it")
    seen = survey(arguments.bags, load_contract(arguments.contract))
    print(seen.table())
    if arguments.out is None:
        seen.check()
        return
    number, damaged = write(seen, arguments.out)
    print(*(f"left out: {line}" for line in damaged), f"{arguments.out}: {number} episodes", sep="\n")
