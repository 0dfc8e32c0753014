"""Speed, side by side: the graph over DDS, the same loop in one process, the world model, the simulator.

python3 launch_scripts/benchmark.py [--json FILE]
"""

import sys

import wm_setup

if __name__ == "__main__":
    wm_setup.ensure()
    from benchmarks.speed.cli import main

    raise SystemExit(main(sys.argv[1:]))
