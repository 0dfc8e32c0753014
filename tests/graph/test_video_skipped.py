"""Buffers whose rewards differ in no group: the learner goes on, counts them, and ends when there are too many."""

from pathlib import Path

import pytest
import torch
from graph.harness import Graph, Probe, wait_until
from graph.video_loop import VideoLoop, settings

from wm_msgs.action import TrainVideo
from wm_nodes.training.metrics import read_metrics
from wm_nodes.video_rl.grpo import MAX_SKIPPED

pytestmark = pytest.mark.graph


@pytest.mark.slow
def test_a_buffer_without_spread_is_skipped_and_counted_and_too_many_in_a_row_fail_the_goal(
    graph: Graph, probe: Probe
) -> None:
    torch.set_num_threads(1)
    loop = VideoLoop(graph, probe, settings())
    loop.start("video_learner")
    loop.wait_active("video_learner")
    buffer = loop.local.buffer(0, 0)
    (Path(graph.folder) / "equal.safetensors").write_bytes(
        buffer.with_rewards({"total": torch.full((len(buffer),), 0.5)}).to_bytes()
    )
    result = loop.train(from_buffers=["equal.safetensors"] * 2)
    assert result.termination_reason == TrainVideo.Result.FINISHED, result.message
    assert (result.policy_version, result.iterations) == (0, 2)
    assert [line["skipped"] for line in read_metrics(graph.folder, "grpo")] == [1, 2]
    wait_until("the count", lambda: probe.value("/wm/learner", "skipped_buffers") == "2")
    result = loop.train(from_buffers=["equal.safetensors"] * MAX_SKIPPED)
    assert result.termination_reason == TrainVideo.Result.FAILED
    assert "2 no spread; 4 buffers before it were skipped" in result.message
    assert (result.policy_version, result.iterations) == (0, MAX_SKIPPED - 1)
