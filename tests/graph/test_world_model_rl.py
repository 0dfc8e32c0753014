"""Loop 2 as a user starts it, smallest preset: simulator bags, video model, four node processes, GRPO, a bag, a report;
then its recording scored and trained on again."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from graph.harness import Probe, own_domain, wait_until
from graph.launched import launched
from metric_docs import documented, written

from wm_msgs.action import TrainVideo
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.nodes.video_model_node import film_strip
from wm_nodes.recording import BagError
from wm_nodes.recording.bag import Bag
from wm_nodes.reports.summary import read_summary
from wm_nodes.training.metrics import read_metrics
from wm_nodes.training.run_lock import NAME
from wm_nodes.training.weights import load_weights
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.execution_reward import EXECUTION_SCORES
from wm_nodes.video_rl.recorded_buffers import RecordedClips, read_clips, rescore
from wm_nodes.video_rl.reference_reward import CLIP_SCORES, PICTURE_SCORES, load_probe
from wm_nodes.video_rl.sampling import RecordedContexts
from wm_nodes.video_rl.train import post_train, sample_buffers
from wm_nodes.video_rl.training_run import CHECKPOINT, VIDEO_FILES, VideoRun, progress
from wm_nodes.video_rl.validation import context_scores
from wm_nodes.world_model.position_probe import PositionProbe

pytestmark = pytest.mark.graph
PROGRAM = "import sys; from wm_nodes.apps.cli import main; sys.exit(main(['train-video-model', *sys.argv[1:]]))"
SETTINGS = {"rewards.closeness": 0.5, "rewards.execution": 0.5}
ARGUMENTS = ["--preset", "smoke", *(f"--{name}={value}" for name, value in SETTINGS.items())]


def start(arguments: list[str], domain: int) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "COLUMNS": "160", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", PROGRAM, "--domain-id", str(domain), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a finished run."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("world_model_rl") / "run"
    with own_domain() as domain:
        done = start([*ARGUMENTS, "--run-dir", str(folder)], domain)
    assert done.returncode == 0, done.stdout + done.stderr
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def config() -> VideoRlConfig:
    return load_video_config("smoke", SETTINGS)


@pytest.fixture
def contexts(run_dir: Path, config: VideoRlConfig) -> Clips:
    return load_clips(sorted((run_dir / "data" / "train").glob("shard_*")), config.model.stride)


@pytest.fixture
def probe(config: VideoRlConfig) -> PositionProbe:
    return load_probe(shipped_model(config.task))


def recorded(run_dir: Path) -> list[RecordedClips]:
    return list(read_clips(Path(read_summary(run_dir)["bag"]), pictures=True))


@pytest.mark.slow
def test_the_graph_gives_the_weights_of_video_rl_train_bit_for_bit(
    run_dir: Path, tmp_path: Path, config: VideoRlConfig, contexts: Clips, probe: PositionProbe
) -> None:
    folder = load_video_folder(run_dir / "video_model")
    run = VideoRun(folder.network, config, tmp_path)
    source, frames = RecordedContexts(folder, contexts, config, probe), []
    for buffer, _ in post_train(run, sample_buffers(source, run, config.iterations)):
        frames.append(folder.codec.decode(buffer.rollout.latents))
    run.close()
    assert (tmp_path / VIDEO_FILES.uri(4)).read_bytes() == (run_dir / VIDEO_FILES.uri(4)).read_bytes()

    with Bag(Path(read_summary(run_dir)["bag"])) as bag:
        types = {connection.topic: connection.msgtype for connection in bag.connections}
        messages: dict[str, list[Any]] = {}
        for topic, _, data in bag.messages():
            messages.setdefault(topic, []).append(bag.decode(data, types[topic]))
    assert [m.iteration for m in messages["/wm/clips"]] == [0, 1]
    assert [m.buffer_sha256 for m in messages["/wm/clips/scores"]] == [m.sha256 for m in messages["/wm/clips"]]
    for image, expected in zip(messages["/wm/clips/image"], frames, strict=True):
        np.testing.assert_array_equal(np.asarray(image.data), film_strip(expected).reshape(-1))


@pytest.mark.slow
def test_the_newest_weights_are_measured_after_and_the_base_model_once_before(
    run_dir: Path, config: VideoRlConfig, probe: PositionProbe
) -> None:
    summary, folder = read_summary(run_dir), load_video_folder(run_dir / "video_model")
    before = json.loads((run_dir / "evaluations" / "before.json").read_text())
    assert before["of"]["sha256"] == folder.manifest["sha256"]["network.safetensors"]
    for name, row in summary["scores"].items():
        assert row["before"] == pytest.approx(folder.manifest["heldout"][name], rel=1e-12)
    heldout = load_clips(sorted((run_dir / "data" / "heldout").glob("shard_*")), config.model.stride)
    load_weights(folder.network, (run_dir / VIDEO_FILES.uri(4)).read_bytes())
    found = {name: values.mean() for name, values in context_scores(folder, heldout, probe, config).items()}
    last = read_metrics(run_dir, "heldout")[-1]
    for name, row in summary["scores"].items():
        assert row["after"] == pytest.approx(float(found[name]), rel=1e-12)
        assert last[name] == pytest.approx(float(found[name]), rel=1e-12)
    assert (summary["version"], summary["evaluations"]) == (4, 2)


@pytest.mark.slow
def test_every_metric_is_in_the_document_and_tensorboard_has_them_too(run_dir: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    scores = {*CLIP_SCORES, *PICTURE_SCORES, *EXECUTION_SCORES}
    assert [line["step"] for line in read_metrics(run_dir, "grpo")] == [1, 2]
    assert [line["step"] for line in read_metrics(run_dir, "heldout")] == [1, 2]
    for line in read_metrics(run_dir):
        missing = written(line, scores) - documented(f"section `{line['section']}`")
        assert not missing, f"not in docs/metrics.md: {missing}"
    assert read_summary(run_dir).keys() == documented("summary.json of loop 2")
    events = EventAccumulator(str(run_dir / "tensorboard")).Reload()
    assert [event.value for event in events.Scalars("heldout/tracking")] == pytest.approx(
        [line["tracking"] for line in read_metrics(run_dir, "heldout")]
    )


@pytest.mark.slow
def test_the_report_holds_table_pictures_command_and_settings(run_dir: Path) -> None:
    text = (run_dir / "report.html").read_text()
    assert text.count("data:image/png;base64") == 4
    for part in ("object error, cm", "Not watched: 2 held-out evaluations", "wm.py retrain", "closeness: 0.5",
                 "rescore"):
        assert part in text


@pytest.mark.slow
def test_a_finished_run_starts_no_graph_again_even_without_its_metrics(
    run_dir: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (run_dir / "metrics.jsonl").rename(run_dir / "metrics.kept")
    try:
        assert main(["train-video-model", *ARGUMENTS, "--run-dir", str(run_dir)]) == 0
    finally:
        (run_dir / "metrics.kept").rename(run_dir / "metrics.jsonl")
    assert "starting the graph" not in capfd.readouterr().out
    assert read_summary(run_dir)["iterations"] == 2


@pytest.mark.slow
def test_recorded_clips_are_scored_again_to_the_same_bits(
    run_dir: Path, config: VideoRlConfig, contexts: Clips, probe: PositionProbe, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rescore", str(run_dir)]) == 0
    assert "bit for bit" in capsys.readouterr().out
    found = json.loads((run_dir / "rescored.json").read_text())
    assert found["equal"] and [row["iteration"] for row in found["buffers"]] == [0, 1]
    assert all(row["recorded"] == row["again"] for row in found["buffers"])
    first, folder = recorded(run_dir)[0], load_video_folder(run_dir / "video_model")
    for name in ("closeness", "execution"):
        assert first.weights[name] == 0.5 and first.scores[name].isfinite().all() and first.scores[name].std() > 0
    again = partial(rescore, source=RecordedContexts(folder, contexts, config, probe))
    values = first.scores["tool_cm"].clone()
    values[3] = torch.nextafter(values[3], torch.tensor(torch.inf, dtype=torch.float64))
    changed = replace(first, scores={**first.scores, "tool_cm": values})
    assert again(changed).different == ("tool_cm",)
    assert first.picture is not None
    dark = replace(first, picture=first.picture // 2)
    assert {"psnr_db", "execution", "total"} <= set(again(dark).different)
    with pytest.raises(BagError, match="picture of iteration 0 is not in the bag"):
        again(replace(first, picture=None))
    with pytest.raises(BagError, match="beauty cannot be scored again"):
        again(replace(first, scores={"beauty": values}))


@pytest.mark.slow
def test_other_weights_of_the_rewards_give_exit_code_1(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    text = (copy / "config.yaml").read_text()
    assert "scenery: -5.0" in text
    (copy / "config.yaml").write_text(text.replace("scenery: -5.0", "scenery: -4.0"))
    assert main(["rescore", str(copy), "--json", str(tmp_path / "scores.json")]) == 1
    rows = json.loads((tmp_path / "scores.json").read_text())["buffers"]
    assert [row["different"] for row in rows] == [["total"], ["total"]]


@pytest.mark.slow
def test_training_again_from_the_recording_gives_the_same_weights_and_other_rewards_give_others(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live = {path.name: path.read_bytes() for path in (run_dir / "video_policies").iterdir()}
    assert main(["retrain", str(run_dir), "--run-dir", str(tmp_path / "same"), "--no-tensorboard"]) == 0
    shutil.copytree(run_dir, tmp_path / "copy")
    assert main(["retrain", str(tmp_path / "copy"), "--run-dir", str(tmp_path / "same")]) == 2
    assert f"run is '{run_dir}' in this run, '{tmp_path / 'copy'}' is given" in capsys.readouterr().err
    for name in ("video_000002.safetensors", "video_000004.safetensors"):
        assert (tmp_path / "same" / "video_policies" / name).read_bytes() == live[name]
    assert read_metrics(tmp_path / "same") == read_metrics(run_dir)
    scores = {name: row["after"] for name, row in read_summary(run_dir)["scores"].items()}
    assert {name: row["after"] for name, row in read_summary(tmp_path / "same")["scores"].items()} == scores
    other = ["--run-dir", str(tmp_path / "other"), "--rewards.object_cm", "-0.1", "--no-tensorboard"]
    assert main(["retrain", str(run_dir), *other]) == 0
    assert (tmp_path / "other" / VIDEO_FILES.uri(4)).read_bytes() != live["video_000004.safetensors"]
    assert read_metrics(tmp_path / "other", "grpo")[0]["reward_mean"] == pytest.approx(
        np.mean(recorded(run_dir)[0].total.numpy() - 0.1 * recorded(run_dir)[0].scores["object_cm"].numpy())
    )


@pytest.mark.slow
def test_training_again_names_a_buffer_that_is_gone_or_another_one(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_dir / "buffers" / "buffer_000001.safetensors"
    data = path.read_bytes()
    try:
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        assert main(["retrain", str(run_dir), "--run-dir", str(tmp_path / "a"), "--no-tensorboard"]) == 2
        assert "the bag says" in capsys.readouterr().err
        path.unlink()
        assert main(["retrain", str(run_dir), "--run-dir", str(tmp_path / "b"), "--no-tensorboard"]) == 2
        assert "--keep-buffers" in capsys.readouterr().err
    finally:
        path.write_bytes(data)
    assert main(["retrain", str(run_dir), "--run-dir", str(tmp_path / "b"), "--no-tensorboard"]) == 0  # goes on
    assert (tmp_path / "b" / VIDEO_FILES.uri(4)).read_bytes() == (run_dir / VIDEO_FILES.uri(4)).read_bytes()
    shutil.move(run_dir / CHECKPOINT, tmp_path / "checkpoint")
    try:
        assert main(["retrain", str(run_dir), "--run-dir", str(tmp_path / "c")]) == 2
        assert "has no checkpoint" in capsys.readouterr().err
    finally:
        shutil.move(tmp_path / "checkpoint", run_dir / CHECKPOINT)


@pytest.mark.slow
def test_recordings_that_are_named_stand_in_for_new_episodes(
    run_dir: Path, tmp_path: Path, ros_domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    """Those of a run, from a folder of their own, make that run's weights again."""
    kept = {name: shutil.copytree(run_dir / "data" / name, tmp_path / name) for name in ("train", "heldout")}
    named = [f"--bags={kept['train'] / 'shard_00000000'}", f"--heldout-bags={kept['heldout'] / 'shard_00500000'}"]
    done = start([*ARGUMENTS, *named, "--run-dir", str(tmp_path / "run")], ros_domain)
    assert done.returncode == 0 and "recordings" in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "run" / VIDEO_FILES.uri(4)).read_bytes() == (run_dir / VIDEO_FILES.uri(4)).read_bytes()
    assert main(["rescore", str(tmp_path / "run")]) == 0
    swapped = [f"--bags={kept['heldout'] / 'shard_00500000'}", f"--heldout-bags={kept['train'] / 'shard_00000000'}"]
    assert main(["train-video-model", *ARGUMENTS, *swapped, "--run-dir", str(tmp_path / "run")]) == 2
    assert "begun with other options: --bags is ['" in capfd.readouterr().err


@pytest.mark.slow
def test_an_interrupted_run_goes_on_from_its_folder_alone_to_the_same_weights(
    run_dir: Path, tmp_path: Path, ros_domain: int
) -> None:
    kept = {name: shutil.copytree(run_dir / "data" / name, tmp_path / name) for name in ("train", "heldout")}
    named = [f"--bags={kept['train'] / 'shard_00000000'}", f"--heldout-bags={kept['heldout'] / 'shard_00500000'}"]
    folder = tmp_path / "run"
    command = [sys.executable, "-c", PROGRAM, *ARGUMENTS, *named, "--run-dir", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_until("the first update", lambda: process.poll() is not None or progress(folder)[1] == 1, 200)
    assert (folder / NAME).is_file(), "nobody holds the folder"
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and "name the run folder with --run-dir to go on" in said, said
    assert progress(folder) == (2, 1) and not (folder / NAME).exists()
    done = start(["--run-dir", str(folder)], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / VIDEO_FILES.uri(4)).read_bytes() == (run_dir / VIDEO_FILES.uri(4)).read_bytes()
    assert read_summary(folder)["preset"] == "smoke"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--bags", "a"], "--bags and --heldout-bags go together"),
        (["--heldout-bags", "a"], "--bags and --heldout-bags go together"),
        (["--bags", "a", "b", "--heldout-bags", "./b"], "b cannot be trained on and held out"),
        (["--bags", "nowhere", "--heldout-bags", "neither"], "nowhere is no recording; name bags"),
    ],
)
def test_recordings_that_cannot_be_used_end_with_one_clear_line(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        (tmp_path / name).mkdir()
    assert main(["train-video-model", "--preset", "smoke", *options, "--run-dir", str(tmp_path / "run")]) == 2
    assert words in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_no_kept_buffer_is_refused_before_anything_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--preset", "smoke", "--keep-buffers", "0", "--run-dir", str(tmp_path / "run")]
    assert main(["train-video-model", *given]) == 2
    assert "--keep-buffers must be at least 1, got 0" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_offline_work_on_a_folder_that_is_no_run_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for action in ("rescore", "retrain"):
        assert main([action, str(tmp_path)]) == 2
        assert "holds no config.yaml; name the run folder" in capsys.readouterr().err


def test_wrong_settings_end_with_one_clear_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["train-video-model", "--rollout.sampler.eta", "1.2", "--run-dir", str(tmp_path)]) == 2
    said = "".join(capfd.readouterr())
    assert "eta must be in [0, 1] for dyndiff, got 1.2" in said and "Traceback" not in said


@pytest.mark.slow
def test_the_launch_file_trains_a_given_model_on_given_recordings_and_records_its_clips(
    run_dir: Path, domain: int, tmp_path: Path
) -> None:
    bags = ",".join(map(str, sorted((run_dir / "data" / "train").glob("shard_*"))))
    given = [
        "preset:=smoke", f"video_model_dir:={run_dir / 'video_model'}", f"context_bags:={bags}",
        f"run_dir:={tmp_path / 'run'}", f"domain_id:={domain}",
    ]
    operator = Probe(domain)
    try:
        with launched("world_model_rl", given, tmp_path / "starter.log"):
            client = operator.action(TrainVideo, "video/train")
            result = operator.finish(operator.send(client, TrainVideo.Goal(iterations=1)))
            assert (result.termination_reason, result.iterations) == (TrainVideo.Result.FINISHED, 1), result.message
    finally:
        operator.close()
    (clips,) = read_clips(tmp_path / "run" / "bags" / "world_model_rl")
    assert clips.iteration == 0 and bool(clips.total.isfinite().all())


def test_settings_that_the_graphs_model_or_the_ratio_cannot_have_are_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for setting, said in (
        ("grpo.kl.anchor=lora_off", "the graph's video model has none: take frozen"),
        ("grpo.objective=nft", "objective nft has no KL, got kl.beta 0.5; set kl.beta 0"),
    ):
        run_dir = tmp_path / "run"
        assert main(["train-video-model", f"--{setting}", "--run-dir", str(run_dir)]) == 2
        assert said in capfd.readouterr().err and not run_dir.exists()
