"""Several seeds and tasks: RL in the world model against RL in the simulator, with intervals.

python3 launch_scripts/study.py [--tasks ...] [--seeds ...] [--arms ...]     # --help lists everything
"""

import sys

import wm_setup

if __name__ == "__main__":
    wm_setup.ensure()
    from wm_nodes.apps.seed_study import main

    raise SystemExit(main(sys.argv[1:]))
