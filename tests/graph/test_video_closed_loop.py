"""Loop 2 on continuations of the model's own frames: the nodes and the loop in one process make the same history."""

from pathlib import Path

import pytest
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.video_loop import VideoLoop, settings

from wm_nodes.video_model import RolloutBuffer

pytestmark = pytest.mark.graph


@pytest.mark.slow
def test_the_graph_trains_on_self_made_histories_as_one_process_does_bit_for_bit(tmp_path: Path) -> None:
    config = settings(**{
        "groups.history": 1, "model.training.given_frames": 2, "model.training.new_frames": 1, "rollout.num_steps": 4,
    })
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path / "run"), Probe(domain)
        try:
            loop = VideoLoop(graph, probe, config)
            for node in ("video_model", "clip_evaluator", "video_learner"):
                loop.start(node)
            loop.wait_active()
            clips = probe.listen("clips")
            wait_until("matching", lambda: probe.node.count_publishers("/wm/clips"))
            loop.assert_undisturbed(loop.train(2))
            wait_until("two buffers", lambda: len(clips) == 2)
            given = 2
            assert [batch.num_frames for batch in clips] == [3, 3]
            kept = RolloutBuffer.from_bytes((graph.folder / clips[1].buffer_uri).read_bytes())
            assert kept.condition.num_conditioning == given and kept.policy_version == clips[1].policy_version > 0
        finally:
            probe.close()
            graph.stop()
