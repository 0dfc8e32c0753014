"""The main job, `wm train-policy`: a policy that improves in the simulator by training inside a learned world model.

python3 launch_scripts/online_rl.py [--preset P] [--task T] ...     # --help lists everything
"""

import sys

from setup import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.apps.cli import run_verb

    raise SystemExit(run_verb("train-policy", sys.argv[1:], "python3 launch_scripts/online_rl.py"))
