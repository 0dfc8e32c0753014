"""Speed, side by side: the graph over DDS, the same loop in one process, the world model, the simulator.

python3 launch_scripts/benchmark.py [--json FILE]
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from benchmarks.speed.cli import main

    raise SystemExit(main(sys.argv[1:]))
