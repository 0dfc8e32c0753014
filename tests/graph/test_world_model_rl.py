"""Loop 2 as a user starts it, smallest preset: simulator bags, video model, four node processes, GRPO, a bag."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from wm_nodes.config.shipped import shipped_model
from wm_nodes.learning.clip_generation import ClipGenerator
from wm_nodes.learning.clip_scores import mixed, score_clips
from wm_nodes.learning.metrics import read_metrics
from wm_nodes.learning.video_config import load_video_config
from wm_nodes.learning.video_data import load_clips
from wm_nodes.learning.video_folder import load_video_folder
from wm_nodes.learning.video_run import VideoRun, rewarded, version_uri
from wm_nodes.nodes.video_model_node import film_strip
from wm_nodes.recording.bag import Bag
from wm_nodes.world_model import load_model_folder

pytestmark = pytest.mark.graph
PROGRAM = "import sys; from wm_nodes.world_model_job import main; sys.exit(main(sys.argv[1:]))"


def start(arguments: list[str], domain: int) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "COLUMNS": "160", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", PROGRAM, "--domain-id", str(domain), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)


@pytest.mark.slow
def test_post_training_over_dds_gives_the_weights_of_the_same_loop_in_one_process(
    ros_domain: int, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    done = start(["--preset", "smoke", "--run-dir", str(run_dir)], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["version"] == 4 and summary["scores"]["tool_cm"]["before"] > 0
    assert (run_dir / "strips" / "strip_0.png").is_file()
    assert [line["step"] for line in read_metrics(run_dir, "grpo")] == [1, 2]

    torch.set_num_threads(1)
    config = load_video_config("smoke")
    folder = load_video_folder(run_dir / "video_model")
    bags = sorted((run_dir / "data" / "train").glob("shard_*"))
    generator = ClipGenerator(folder, load_clips(bags, config.model.stride), config)
    probe = load_model_folder(Path(str(shipped_model(config.task)))).probe
    assert probe is not None
    run = VideoRun(folder.network, config, tmp_path / "local")
    frames = []
    for iteration in range(config.iterations):
        request = generator.request(iteration, run.version)
        buffer = generator.sample(request)
        frames.append(folder.codec.decode(buffer.rollout.latents))
        scores = score_clips(frames[-1], generator.references(request), probe, 1).named()
        run.train(rewarded(buffer, scores, mixed(scores, config.rewards)))
    assert (tmp_path / "local" / version_uri(4)).read_bytes() == (run_dir / version_uri(4)).read_bytes()

    with Bag(Path(summary["bag"])) as bag:
        types = {connection.topic: connection.msgtype for connection in bag.connections}
        messages: dict[str, list[Any]] = {}
        for topic, _, data in bag.messages():
            messages.setdefault(topic, []).append(bag.decode(data, types[topic]))
    assert [m.iteration for m in messages["/wm/clips"]] == [0, 1]
    assert [m.buffer_sha256 for m in messages["/wm/clips/scores"]] == [m.sha256 for m in messages["/wm/clips"]]
    for image, expected in zip(messages["/wm/clips/image"], frames, strict=True):
        np.testing.assert_array_equal(np.asarray(image.data), film_strip(expected).reshape(-1))

    again = start(["--preset", "smoke", "--run-dir", str(run_dir)], ros_domain)
    assert again.returncode == 0 and "starting the graph" not in again.stdout


def test_wrong_settings_end_with_one_clear_line(ros_domain: int, tmp_path: Path) -> None:
    done = start(["--set", "rollout.sampler.eta=1.2", "--run-dir", str(tmp_path)], ros_domain)
    assert done.returncode == 2
    assert "eta must be in [0, 1] for dyndiff, got 1.2" in done.stdout and "Traceback" not in done.stdout + done.stderr
