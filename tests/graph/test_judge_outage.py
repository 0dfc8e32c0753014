"""Loop 2 while the judge's server is down and another judge is configured: rounds, diagnostics, scoring again."""

import shutil
from pathlib import Path

import pytest
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.video_loop import VideoLoop, settings
from judge_server import PickyServer, serving

from wm_msgs.action import TrainVideo
from wm_msgs.srv import StopRecording
from wm_nodes.apps.cli import main
from wm_nodes.launching.scenarios import VIDEO_TOPICS

pytestmark = [pytest.mark.graph, pytest.mark.alone]


def test_another_judge_takes_the_rounds_of_an_outage_and_each_round_is_scored_again_by_the_one_it_had(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(PickyServer()) as server, serving(PickyServer()) as other, own_domain() as domain:
        fallback = {"endpoints": [other.url], "model": "other"}
        config = settings(**{
            "rewards": {"agent": 1.0}, "judge.endpoints": [server.url], "judge.model": "judge", "judge.tries": 1,
            "judge.fallbacks": [fallback],
        })
        graph, probe = Graph(domain, tmp_path / "graph"), Probe(domain)
        try:
            loop = VideoLoop(graph, probe, config)
            probe.listen("reward/verdict")
            graph.start("recorder", topics=list(VIDEO_TOPICS), bag_uri="bags/rounds")
            loop.start("video_model")
            loop.start("clip_evaluator")
            loop.start("video_learner", await_nodes=["recorder"])
            loop.wait_active()
            for down in (False, True, False):
                server.down = down
                _assert_judged_by(f"openai-chat:{'other' if down else 'judge'}", loop, warned=down)
            probe.call(StopRecording, "recorder/stop", StopRecording.Request())
        finally:
            server.down = False
            probe.close()
            assert set(graph.stop().values()) == {0}
        run = graph.folder
        shutil.copytree(loop.bag, run / "data" / "train" / "shard_00000000")
        shutil.copyfile(run / "video_config.yaml", run / "config.yaml")
        asked = len(server.requests), len(other.requests)
        assert main(["rescore", str(run)]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert "bit for bit" in said and (len(server.requests), len(other.requests)) == asked


def _assert_judged_by(judge_id: str, loop: VideoLoop, *, warned: bool) -> None:
    """Train on one more round, which this judge alone must have judged."""
    probe, verdicts = loop.probe, loop.probe.messages["reward/verdict"]
    verdicts.clear()
    result = loop.train(1)
    assert (result.termination_reason, result.message) == (TrainVideo.Result.FINISHED, "")
    wait_until("verdicts", lambda: len(verdicts) == 6)
    assert {verdict.judge_id for verdict in verdicts} == {judge_id}
    assert {verdict.clip for verdict in verdicts} == set(range(6)) and all(verdict.reward > 0 for verdict in verdicts)
    wait_until("its name", lambda: probe.value("/wm/reward_evaluator", "judge") == judge_id)
    said = f"the round went to {judge_id}"
    wait_until("the warning", lambda: (said in probe.diagnostics["/wm/reward_evaluator"].message) == warned)
