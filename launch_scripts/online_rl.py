"""The main job: a policy that improves in the real simulator by training inside a learned world model.

python3 launch_scripts/online_rl.py [--preset P] [--task T] ...     # --help lists everything
"""

import sys

import wm_setup

if __name__ == "__main__":
    wm_setup.ensure()
    from wm_nodes.apps.train_policy import main

    raise SystemExit(main(sys.argv[1:]))
