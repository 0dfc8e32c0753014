"""python -m wm_nodes.judge.audit COMMAND ...: the paper's rounds of refinement as commands. See docs/audit.md."""

import sys

from wm_nodes.judge.audit.commands import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
