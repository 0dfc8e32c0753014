"""The main job: a policy that improves in the real simulator by training inside a learned world model.

python3 launch_scripts/online_rl.py [--preset P] [--task T] ...     # --help lists everything
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.apps.train_policy import main

    raise SystemExit(main(sys.argv[1:]))
