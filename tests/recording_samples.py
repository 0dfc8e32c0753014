"""Episodes, specs and foreign bags for the recording tests: small, random, every field different from its default."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.typestore import typestore


def make_spec(num_envs: int = 1, height: int = 8, width: int = 12, **changes: Any) -> EnvironmentSpec:
    spec = EnvironmentSpec(
        env_id="maniskill/push_cube",
        task="push_cube",
        instruction="push the cube to the goal",
        source=1,
        num_envs=num_envs,
        height=height,
        width=width,
        cameras=("front", "wrist"),
        action_names=("dx", "dy", "dz"),
        action_units=("m",) * 3,
        action_scale=(0.05, 0.05, 0.05),
        state_names=("x", "y", "z"),
        state_units=("m",) * 3,
        ground_truth_names=GROUND_TRUTH_NAMES,
        control_period_s=0.1,
        max_episode_steps=16,
        state_low=(-0.6, -0.3, 0.01),
        state_high=(0.1, 0.3, 0.4),
    )
    return replace(spec, **changes)


def make_episode(spec: EnvironmentSpec, index: int = 0, steps: int = 5, **changes: Any) -> Episode:
    rng = np.random.default_rng(index)
    frames = steps + 1
    episode = Episode(
        images=rng.integers(0, 256, (frames, spec.height, spec.width, 3), dtype=np.uint8),
        states=rng.normal(size=(frames, spec.state_dim)).astype(np.float32),
        actions=rng.uniform(-1, 1, (steps, spec.action_dim)).astype(np.float32),
        ground_truth=rng.normal(size=(frames, spec.ground_truth_dim)).astype(np.float32),
        success=rng.random(frames) > 0.5,
        rewards=rng.normal(size=steps).astype(np.float32),
        terminated=index % 2 == 0,
        truncated=index % 2 == 1,
        task=spec.task,
        instruction=spec.instruction,
        behaviour=("expert", "noisy", "near_miss")[index % 3],
        seed=1000 + index,
        episode_id=index,
        source=spec.source,
        policy_version=index // 2,
        extra={"index": index},
    )
    return replace(episode, **changes)


def assert_same_episode(found: Episode, expected: Episode) -> None:
    for field in fields(Episode):
        ours, theirs = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(theirs, np.ndarray):
            assert ours.dtype == theirs.dtype, field.name
            np.testing.assert_array_equal(ours, theirs, err_msg=field.name)
        else:
            assert ours == theirs, field.name


def foreign_copy(
    source: Path, path: Path, plugin: StoragePlugin = StoragePlugin.MCAP, mode: CompressionMode = CompressionMode.NONE
) -> Path:
    """The bag as rosbags' writer writes it: its texts of the definitions have none of our comments."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with Bag(source) as bag, writer:
        topics = {c.topic: add(writer, c.topic, c.msgtype, list(c.ext.offered_qos_profiles)) for c in bag.connections}
        for topic, time_ns, data in bag.messages():
            writer.write(topics[topic], time_ns, data)
    return path


def add(writer: Writer, topic: str, msgtype: str, qos: Any = ()) -> Any:
    return writer.add_connection(topic, msgtype, typestore=typestore(), offered_qos_profiles=qos)
