"""A set of clips with known labels from the simulator, to train and to compare judges on.

python3 launch_scripts/make_adversarial_set.py FOLDER --benchmark
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.judge.dataset.build import main

    raise SystemExit(main(sys.argv[1:]))
