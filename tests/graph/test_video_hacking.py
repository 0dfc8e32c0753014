"""Reward hacking is visible: a learner whose reward rises while held-out clips get worse says so."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diagnostic_msgs.msg import DiagnosticStatus
from graph.harness import Graph, Probe, wait_until
from graph.video_loop import MODEL_DIR, VideoLoop, settings

from wm_msgs.action import TrainVideo
from wm_nodes.training.metrics import read_metrics

pytestmark = pytest.mark.graph


def write_buffers(loop: VideoLoop, rewards: list[float], version: int = 0) -> list[str]:
    """Clips of the base model, rewarded for being unlike their recordings; the mean reward is given.

    version: of the learner now. The clips say that they are by the weights that train on them.
    """
    uris, updates = [], loop.config.grpo.updates_per_buffer
    for iteration, reward in enumerate(rewards):
        buffer = replace(loop.local.buffer(iteration, 0), policy_version=version + updates * iteration)
        likeness = buffer.rewards["psnr_db"]
        buffer = buffer.with_rewards({"total": reward + likeness.mean() - likeness})
        uris.append(f"unlike_{reward:g}.safetensors")
        (Path(loop.graph.folder) / uris[-1]).write_bytes(buffer.to_bytes())
    return uris


@pytest.mark.slow
def test_a_reward_for_bad_pictures_is_named_in_log_diagnostics_and_metrics_until_it_falls(
    graph: Graph, probe: Probe
) -> None:
    torch.set_num_threads(1)
    watch = {"evaluation.every": 1, "evaluation.window": 4, "evaluation.contexts": 3}
    free = {"grpo.learning_rate": 3e-2, "grpo.kl.beta": 0.0, "grpo.clip": 10.0}
    loop = VideoLoop(graph, probe, settings(**watch, **free))
    loop.start("video_learner", heldout_bags=f"['{loop.bag}']", model_dir=MODEL_DIR)
    loop.wait_active("video_learner")
    result = loop.train(from_buffers=write_buffers(loop, [1, 2, 3, 4]))
    assert result.termination_reason == TrainVideo.Result.FINISHED, result.message
    last = read_metrics(graph.folder, "heldout")[-1]
    worse = [name.removeprefix("hacked_") for name in last if name.startswith("hacked_")]
    assert last["hacked"] == len(worse) >= 1 and last["reward_slope"] == pytest.approx(1.0)
    assert all(last[f"hacked_{name}"] < 0 for name in worse)
    status = wait_until("the warning", lambda: probe.diagnostics["/wm/learner"].level == DiagnosticStatus.WARN
                        and probe.diagnostics["/wm/learner"])
    assert "the training reward rises by 1 per evaluation" in status.message and f"{worse[0]} by" in status.message
    assert f"reward hacking: {status.message}" in graph.log("/wm/video_learner")
    result = loop.train(from_buffers=write_buffers(loop, [-1, -2, -3, -4], result.policy_version))
    assert result.termination_reason == TrainVideo.Result.FINISHED, result.message
    assert read_metrics(graph.folder, "heldout")[-1]["hacked"] == 0
    wait_until("no warning", lambda: probe.diagnostics["/wm/learner"].level == DiagnosticStatus.OK)
