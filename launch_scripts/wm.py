"""Everything that a person does here but the main job and the tests: python3 launch_scripts/wm.py VERB ...

python3 launch_scripts/wm.py --help          # lists the verbs
python3 launch_scripts/wm.py VERB --help     # explains one
"""

import sys

from setup import ensure

if __name__ == "__main__":
    words = sys.argv[1:] or ["--help"]
    ensure(words)
    from wm_nodes.apps.cli import main

    raise SystemExit(main(words, "python3 launch_scripts/wm.py"))
