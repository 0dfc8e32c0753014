"""Build of the package wm_nodes, by pip and by colcon. Versions of what it needs are pinned in ../requirements."""

import re
from pathlib import Path

from setuptools import find_packages, setup

NODES = (
    "environment", "policy", "reward_evaluator", "learner", "recorder", "player", "evaluation",
    "video_model", "clip_evaluator", "video_learner", "viewer",
)

KINDS = ("xml", "yaml", "json", "jsonl", "css", "html", "js", "safetensors", "txt", "png")
"""Of data files."""

HEAD = (Path(__file__).with_name("wm_nodes") / "__init__.py").read_text(encoding="utf-8")
VERSION = re.search('__version__ = "(.+)"', HEAD)

setup(
    name="wm_nodes",
    version=VERSION[1],
    description="Online world-model reinforcement learning as a ROS 2 graph",
    license="Apache-2.0",
    python_requires=">=3.11,<3.13",
    packages=find_packages(include=["wm_nodes", "wm_nodes.*"]),
    package_data={"": ["py.typed", *(f"**/*.{kind}" for kind in KINDS)]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/wm_nodes"]),
        ("share/wm_nodes", ["package.xml"]),
    ],
    install_requires=["jinja2", "mcap", "numpy", "pydantic", "pyyaml", "rosbags", "safetensors", "setuptools", "torch"],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            *(f"{node}_node = wm_nodes.nodes.{node}_node:main" for node in NODES),
            "wm_compose = wm_nodes.nodes.compose:main",
            "wm = wm_nodes.apps.cli:main",
        ]
    },
)
