"""Loop 2 with bounded staleness: the next buffer is sampled while this one is trained on, by the version before; and a
learner of two ranks. The graph is shared: each test goes on where the one before stopped."""

import time
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.video_loop import VideoLoop, settings

from wm_msgs.action import GenerateClips, TrainVideo
from wm_nodes.recording.messages import time_ns
from wm_nodes.training.metrics import read_metrics
from wm_nodes.training.weights import unpack_weights

pytestmark = pytest.mark.graph


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VideoLoop]:
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path_factory.mktemp("prefetch") / "run"), Probe(domain)
        try:
            config = settings(**{"grpo.max_staleness": 2, "window.size": 12})  # training takes a while
            loop = VideoLoop(graph, probe, config, lag=1)
            for node in ("video_model", "clip_evaluator", "video_learner"):
                loop.start(node)
            loop.wait_active()
            yield loop
        finally:
            probe.close()
            graph.stop()


@pytest.mark.slow
def test_prefetching_gives_the_weights_of_the_delayed_loop_and_counts_its_staleness(loop: VideoLoop) -> None:
    clips, versions = loop.probe.listen("clips"), loop.probe.listen("video/version")
    wait_until("matching", lambda: versions and loop.probe.node.count_publishers("/wm/clips"))
    loop.assert_undisturbed(loop.train(3))
    loop.assert_undisturbed(loop.train(1))
    assert [(batch.iteration, batch.policy_version) for batch in clips] == [(0, 0), (1, 0), (2, 2), (3, 4)]
    assert [line["staleness"] for line in read_metrics(loop.graph.folder, "grpo")] == [0, 2, 2, 2]
    wait_until("the gauge", lambda: loop.probe.value("/wm/learner", "staleness") == "2")
    announced = {message.version: time_ns(message.header.stamp) for message in versions}
    began = [time_ns(batch.header.stamp) - int(1e9 * batch.sample_s) for batch in clips]
    assert began[1] < announced[2] and began[2] < announced[4], "sampled after the training, not during it"
    assert began[3] > announced[6], "a goal has asked for more than its own buffers"


@pytest.mark.slow
def test_cancel_leaves_no_goal_under_way(loop: VideoLoop) -> None:
    fed = list[Any]()
    handle = loop.send(100000, fed.append)
    wait_until("a trained buffer", lambda: fed)
    assert loop.cancel(handle).termination_reason == TrainVideo.Result.CANCELED
    time.sleep(0.5)
    client = loop.probe.action(GenerateClips, "video/generate")
    version = loop.train(0).policy_version
    handle = loop.probe.send(client, GenerateClips.Goal(iteration=7, policy_version=version))
    assert loop.probe.finish(handle).termination_reason == GenerateClips.Result.FINISHED
    loop.assert_undisturbed(loop.train(2))


@pytest.mark.slow
@pytest.mark.kills
def test_a_killed_learner_and_video_model_go_on_with_the_version_before(loop: VideoLoop) -> None:
    fed = list[Any]()
    loop.send(100000, fed.append)
    wait_until("two trained buffers, so that the version before is not the model's own folder", lambda: fed[1:])
    for node in ("video_learner", "video_model"):
        loop.graph.kill(f"/wm/{node}")
    for node in ("video_learner", "video_model"):  # who comes later knows only what is latched
        loop.start(node)
        loop.wait_active(node)
    loop.assert_undisturbed(loop.train(2))


@pytest.mark.slow
@pytest.mark.kills  # torchrun answers SIGINT with a non-zero code
def test_two_ranks_under_torchrun_go_on_with_the_update_of_one(loop: VideoLoop) -> None:
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
