"""DynDiff-GRPO against its rivals on a toy world: diversity, learning, cost of the KL; every arm on one learner.

python3 launch_scripts/benchmark_dyndiff.py diversity|learning|ablations|hacking|cost|clips|base [--json FILE]
"""

import sys

import wm_setup

if __name__ == "__main__":
    wm_setup.ensure()
    from wm_nodes.benchmark.video_cli import main

    raise SystemExit(main(sys.argv[1:]))
