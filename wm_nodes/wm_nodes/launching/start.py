"""What a launch file calls that is started by Python: the runner, with Ctrl-C answered from the first moment."""

import signal
import sys

from wm_nodes.core.interrupts import leaving_when_interrupted


def start(scenario: str) -> int:
    """Run a scenario with the arguments of the command line; return the exit code."""
    try:
        with leaving_when_interrupted():
            from wm_nodes.launching.runner import main
        return main(scenario)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
