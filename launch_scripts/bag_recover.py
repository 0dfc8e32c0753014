#!/usr/bin/env python3
"""Bring back a killed recording: python3 launch_scripts/bag_recover.py runs/x/bag.partial [--output FOLDER]."""

import sys

from setup.entry import ensure

ensure()

from wm_nodes.recording.recovery import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
