"""Bring back a recording whose process was killed: every complete message into a new, proper bag.

    wm recover-bag runs/x/bag.partial [--output runs/x/bag]

The original stays as it is.
"""

import argparse
from pathlib import Path

from wm_nodes.recording.recovery import recover


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", type=Path, help="the .partial folder, a bag folder or an .mcap file")
    parser.add_argument("--output", type=Path, help="the new bag (default: <name>_recovered)")


def run(arguments: argparse.Namespace) -> None:
    print(recover(arguments.bag, output=arguments.output).text())
