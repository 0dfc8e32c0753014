#!/usr/bin/env python3
"""Evaluate a bag's rewards again, bit by bit: python3 launch_scripts/bag_rescore.py runs/x/bags/training_120000."""

import sys

from setup.entry import ensure

ensure()

from wm_nodes.apps.rescore_rewards import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
