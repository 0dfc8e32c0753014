"""The files of --json."""

import argparse
import json
import time
from typing import Any

from wm_nodes.core.device import CPU
from wm_nodes.core.files import write_atomic
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.summary import plain


def write_results(
    arguments: argparse.Namespace, results: dict[str, Any], *, exact: bool = False, device: str = CPU
) -> None:
    """Write what a command found to its `json`, if there is one, with its `command`, the machine and the date.

    Numbers have five digits, or all of them where `exact`. What is not finite is null. device: as in machine_facts.
    """
    if arguments.json is None:
        return
    facts = {"command": arguments.command, "machine": machine_facts(device), "date": time.strftime("%Y-%m-%d")}
    text = json.dumps(plain({**results, **facts}))
    written = json.loads(text, parse_float=float if exact else lambda digits: float(f"{float(digits):.5g}"))
    write_atomic(arguments.json, (json.dumps(written, indent=1) + "\n").encode())
