"""Settings of the middleware that every node has, launched or not. Standard library only."""

import os
import shutil
from pathlib import Path

PROFILE = Path(__file__).with_name("fastdds_profile.xml")
"""Fast DDS: shared-memory segment of 32 MiB, messages up to 8 MiB (larger images would be lost, or wait 12 ms)."""

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
SEGMENT_BYTES = 40 * 2**20
"""Shared memory that one process may take with the profile."""

_USUAL_NODES = 8


def set_node_defaults() -> None:
    """Give a node that no launcher started the launchers' defaults: this host only, and the Fast DDS profile.

    Called before rclpy.init. What is set stays; an empty profile variable (the runner's word for "/dev/shm is too
    small") is removed.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if os.environ.get(PROFILE_VARIABLE) == "":
        del os.environ[PROFILE_VARIABLE]
    elif Path("/dev/shm").is_dir() and shutil.disk_usage("/dev/shm").free >= _USUAL_NODES * SEGMENT_BYTES:
        os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))
