"""The node of loop 2 with the embedded judge alone, no server and no GPU."""

import functools
import json
from pathlib import Path

import pytest
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.video_loop import MODEL_DIR, STRIDE, VideoLoop, settings
from recording_samples import make_spec
from video_toys import far_sighted_judge

from benchmarks.video_rl.judged import JudgedContexts
from wm_msgs.action import TrainVideo
from wm_msgs.msg import ClipVerdict
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.service import clip_fps
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.reference_reward import load_probe

pytestmark = [pytest.mark.graph, pytest.mark.alone]


def test_a_round_is_judged_in_the_node_without_any_server_as_in_one_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = functools.partial(make_spec, instruction="push the cube into the target")
    monkeypatch.setattr("graph.video_loop.make_spec", spec)
    rubric = tmp_path / "own.yaml"
    rubric.write_text(json.dumps({"extends": "robot", "name": "own"}))
    config = settings(**{
        "rewards": {"agent": 1.0}, "judge.kind": "embedded", "judge.folder": str(far_sighted_judge(tmp_path / "judge")),
        "judge.rubric": str(rubric),
    })
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path / "graph"), Probe(domain)
        try:
            loop = VideoLoop(graph, probe, config)
            verdicts: list[ClipVerdict] = probe.listen("reward/verdict")
            loop.start("video_model")
            loop.start("clip_evaluator", audit_dir="audit")
            loop.start("video_learner")
            loop.wait_active()
            result = loop.train(1)
            assert (result.termination_reason, result.message) == (TrainVideo.Result.FINISHED, "")
            wait_until("verdicts", lambda: len(verdicts) == 6)
            for verdict in verdicts:
                assert verdict.status == ClipVerdict.OK and 0 <= verdict.reward <= 1, verdict.reason
                assert verdict.judge_id.startswith("embedded:") and verdict.rubric_version.startswith("own-1-")
            judge = verdicts[0].judge_id
            wait_until("diagnostics", lambda: probe.value("/wm/reward_evaluator", "verdicts") == "6")
            assert probe.value("/wm/reward_evaluator", "judge") == judge
            assert probe.value("/wm/reward_evaluator", "abstained") == "0"
            assert f"one-class judge {judge.removeprefix('embedded:')}" in graph.log("/wm/clip_evaluator")
        finally:
            probe.close()
            assert set(graph.stop().values()) == {0}
        entries = read_record(graph.folder / "audit").judged()
        assert [entry.evidence for entry in entries] == [{}] * 6, "its own numbers are no second opinion"
        folder, contexts = load_video_folder(loop.model), load_clips([loop.bag], STRIDE)
        with JudgedContexts(folder, contexts, config, load_probe(MODEL_DIR), clip_fps(loop.bag, STRIDE)) as source:
            request = source.request(0, 0)
            buffer = source.score(request, source.sample(request))
        in_graph = {verdict.clip_id: (verdict.audit_id, verdict.reward) for verdict in verdicts}
        assert in_graph == {verdict.clip_id: (verdict.audit_id, verdict.reward) for verdict in source.verdicts}
        assert buffer.rewards["total"].tolist() == [verdict.reward for verdict in source.verdicts], "as in one process"
