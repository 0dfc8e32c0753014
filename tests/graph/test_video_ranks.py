"""A learner of loop 2 that is two processes. The first buffers are trained on by one."""

import pytest
import torch
from graph.harness import Graph, Probe
from graph.video_loop import VideoLoop, settings

from wm_msgs.action import TrainVideo
from wm_nodes.training.weights import unpack_weights

pytestmark = pytest.mark.graph


@pytest.mark.slow
@pytest.mark.kills  # torchrun answers SIGINT with a non-zero code
def test_two_ranks_under_torchrun_go_on_with_the_update_of_one(graph: Graph, probe: Probe) -> None:
    loop = VideoLoop(graph, probe, settings())
    for node in ("video_model", "clip_evaluator", "video_learner"):
        loop.start(node)
    loop.wait_active()
    loop.assert_undisturbed(loop.train(2))
    loop.stop("video_learner")
    port = str(29500 + loop.graph.domain)
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", port)
    loop.start("video_learner", launcher=torchrun)
    loop.wait_active("video_learner")
    result = loop.train(2)
    assert result.termination_reason == TrainVideo.Result.FINISHED, result.message
    found, _ = unpack_weights(loop.newest(result))
    expected, _ = unpack_weights(loop.local.weights(result.iterations))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
