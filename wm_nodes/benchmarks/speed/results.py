"""The files of --json."""

import argparse
import json
import time
from typing import Any

from wm_nodes.core.files import write_atomic
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.summary import plain


def write_results(arguments: argparse.Namespace, results: dict[str, Any]) -> None:
    """Write what a command found to its `json`, if there is one: to five digits, with its `command`, the machine and
    the date. What is not finite is null."""
    if arguments.json is None:
        return
    facts = {"command": arguments.command, "machine": machine_facts(), "date": time.strftime("%Y-%m-%d")}
    text = json.dumps(plain({**results, **facts}))
    rounded = json.loads(text, parse_float=lambda digits: float(f"{float(digits):.5g}"))
    write_atomic(arguments.json, (json.dumps(rounded, indent=1) + "\n").encode())
