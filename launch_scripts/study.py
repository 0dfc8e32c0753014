"""Several seeds and tasks: RL in the world model against RL in the simulator, with intervals.

python3 launch_scripts/study.py [--tasks ...] [--seeds ...] [--arms ...]     # --help lists everything
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.apps.seed_study import main

    raise SystemExit(main(sys.argv[1:]))
