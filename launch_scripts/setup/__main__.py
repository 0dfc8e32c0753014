"""`python3 launch_scripts/setup`: see entry.py."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])

from setup.entry import main  # noqa: E402  (found by the line above)

raise SystemExit(main())
