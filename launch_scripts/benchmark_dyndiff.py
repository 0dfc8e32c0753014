"""DynDiff-GRPO against its rivals, every arm on one learner: diversity and learning on a toy world and on PushCube
clips, cost of the KL.

python3 launch_scripts/benchmark_dyndiff.py CLAIM [--json FILE]      # the claims: --help
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from benchmarks.video_rl.cli import main

    raise SystemExit(main(sys.argv[1:]))
