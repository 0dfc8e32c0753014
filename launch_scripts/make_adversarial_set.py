"""A set of clips with known labels from the simulator, to train and to compare judges on.

python3 launch_scripts/make_adversarial_set.py FOLDER --benchmark
"""

import sys

import wm_setup

if __name__ == "__main__":
    wm_setup.ensure()
    from wm_nodes.judge.dataset.build import main

    raise SystemExit(main(sys.argv[1:]))
