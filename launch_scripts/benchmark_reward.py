"""The reward agent against labels: Table 2, efficiency, hacking resistance, rewards of other papers.

python3 launch_scripts/benchmark_reward.py table|efficiency|hacking|comparisons SET --judge embedded|openai|simulator
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from benchmarks.judge.cli import main

    raise SystemExit(main(sys.argv[1:]))
