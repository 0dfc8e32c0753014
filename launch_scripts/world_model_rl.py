"""Loop 2: post-train the video world model by DynDiff-GRPO on clips that it samples, as a ROS 2 graph.

python3 launch_scripts/world_model_rl.py [--preset P] ...     # --help lists everything
python3 launch_scripts/world_model_rl.py rescore RUN          # score a run's recorded clips again, compare bit for bit
python3 launch_scripts/world_model_rl.py retrain RUN          # train on them again, without sampling
"""

import sys

from setup.entry import ensure

if __name__ == "__main__":
    ensure()
    from wm_nodes.apps.train_video_model import main

    raise SystemExit(main(sys.argv[1:]))
