"""Checks a video model before GRPO trains it: ratio, KL, ODE step, mask, buffer, memory.

python3 launch_scripts/doctor.py [--video-model FOLDER --context-bags BAG ... | --public FOLDER]
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.apps.check_video_model import main

    raise SystemExit(main(sys.argv[1:]))
