"""ros2 launch wm_bringup online_training.launch.py, or: python3 <this file> [--show-args] [name:=value ...]"""


def generate_launch_description():
    from wm_nodes.launching.launch_description import launch_description

    return launch_description("online_training")


if __name__ == "__main__":
    from setup import launch

    raise SystemExit(launch("online_training"))
