"""`python -m wm_nodes.recording.recover BAG`: see wm_nodes.recording.recovery."""

import sys

from wm_nodes.recording.recovery import main

if __name__ == "__main__":
    sys.exit(main())
