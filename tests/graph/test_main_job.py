"""The main job as a user starts it, smallest preset: simulator, world model, seven node processes, report."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from graph.launched import train_policy
from judge_server import PickyServer, serving
from model_folders import make_model_folder
from safetensors.numpy import save_file

from wm_nodes.apps.cli import main
from wm_nodes.core.named_files import RUN_ENTRIES
from wm_nodes.recording import Bag, read_episodes
from wm_nodes.recording.rollouts import recorded_reward_name
from wm_nodes.reports.summary import read_summary
from wm_nodes.training.metrics import read_metrics
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.starts import INSTRUCTIONS

pytestmark = pytest.mark.graph
SMALL = ["--preset", "smoke", *(f"--{name}" for name in (
    "acceptance.num_episodes=2", "acceptance.clone_episodes=2", "data.num_workers=1", "simulation.max_episode_steps=12"
))]
RATES = ("real_before", "real_after", "imagined_before", "imagined_after")


@pytest.mark.slow
def test_the_main_job_stops_at_acceptance_and_when_forced_leaves_summary_report_and_bag(
    ros_domain: int, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    arguments = [*SMALL, "--acceptance.tool_error_ratio", "0.001", "--run-dir", str(run_dir),
                 "--exploit_meter.every", "2", "--exploit_meter.episodes", "3"]
    refused = train_policy(arguments, ros_domain)
    assert refused.returncode == 3, refused.stdout + refused.stderr
    said = refused.stderr
    assert "tool error / copying" in said and "or go on with --force" in said
    policies = sorted(path.name for path in (run_dir / "policies").iterdir())
    assert policies == ["policy_000001.safetensors", "weak.safetensors"], "trained in a model that failed"
    done = train_policy(["--run-dir", str(run_dir), "--force"], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = read_summary(run_dir)
    assert (summary["task"], summary["preset"], summary["seed"]) == ("push_cube", "smoke", 0)
    assert all(0 <= summary[name]["successes"] <= summary[name]["episodes"] for name in RATES)
    assert summary["real_before"]["episodes"] == summary["real_after"]["episodes"] == 4
    assert summary["imagined_steps_per_s"] > 0
    assert list(Path(summary["bag"]).glob("*.mcap"))
    bags = sorted((run_dir / "bags").glob("training_*"))  # the refused run's and the forced one's
    played = [episode.behaviour for bag in bags for episode in read_episodes(bag, namespace="/wm/sim")]
    assert played.count("before") >= 4 and played.count("after") >= 4
    assert [(row["step"], row["episodes"]) for row in summary["exploit_meter"]] == [(0, 3), (2, 3)], done.stdout
    assert played.count("exploit_meter") >= 2 * 4, "of 4 environments one repeats an episode"
    report = (run_dir / "report.html").read_text()
    assert "data:image/png;base64" in report and "Exploit meter: success of 3 episodes" in report
    assert json.loads((run_dir / "acceptance.json").read_text())["criteria"]
    assert main(["rescore", str(run_dir)]) == 0, "the recorded rewards, evaluated again, are others"


@pytest.mark.slow
def test_policies_of_places_that_a_model_reads_off_pictures_are_trained_and_measured(
    ros_domain: int, tmp_path: Path
) -> None:
    done = train_policy([*SMALL, "--task", "push", "--force", "--run-dir", str(tmp_path / "run")], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    bag = Path(read_summary(tmp_path / "run")["bag"])
    simulated, imagined = (list(read_episodes(bag, namespace=name)) for name in ("/wm/sim", "/wm"))
    assert len(simulated) >= 8 and imagined
    for episode in (*simulated, *imagined):
        assert episode.states.shape[1] == 16 and np.isfinite(episode.states).all()
        assert np.ptp(episode.states[:, 7:], axis=0).any(), "what is read or predicted changes"


def write_some_starts(path: Path) -> None:
    """Grey first frames: enough for a model without quality, and no simulator is needed for them."""
    path.parent.mkdir()
    images, states = np.full((8, 64, 128, 3), 128, np.uint8), np.tile(np.float32([0.6, 0.0, 0.1]), (8, 1))
    told = np.frombuffer(json.dumps([("push_cube", "push the blue cube forward")] * 8).encode(), np.uint8)
    save_file({"images": images, "states": states, INSTRUCTIONS: told}, path)


@pytest.mark.slow
def test_two_online_rounds_refresh_the_model_and_a_resumed_run_repeats_only_what_is_lost(
    ros_domain: int, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    model = make_model_folder(tmp_path / "model")
    write_some_starts(run_dir / "starts.safetensors")
    arguments = [*SMALL, "--force", "--model_refresh.num_rounds", "2", "--model-dir", str(model),
                 "--run-dir", str(run_dir), "--evaluation.episodes", "2", "--compose"]
    done = train_policy(arguments, ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.name for path in run_dir.iterdir()} <= RUN_ENTRIES, "a peer may write what is not listed there"
    first, last = read_summary(run_dir)["rounds"]
    assert (first["number"], last["number"], first["updates"], last["updates"]) == (1, 2, 1, 1)
    assert first["verdict"]["rows"] and not last["verdict"]
    assert (last["model_sha256"] != first["model_sha256"]) == first["verdict"]["accepted"]
    assert load_model_folder(run_dir / "rounds" / "1" / "model").sha256 != first["model_sha256"]
    assert "Online rounds" in (run_dir / "report.html").read_text()
    assert [line["step"] for line in read_metrics(run_dir, "ppo")] == [1, 2]
    measured = (run_dir / "rounds" / "1" / "evaluations" / "real_before.json").read_text()
    weak = hashlib.sha256((run_dir / "policies" / "weak.safetensors").read_bytes()).hexdigest()
    assert json.loads(measured)["identity"] == {"policy_sha256": weak}
    for lost in ("trained.json", "evaluations/real_before.json"):  # as if stopped after the last update of round 1
        (run_dir / "rounds" / "1" / lost).unlink()
    finished = {path: path.stat().st_mtime_ns for path in (run_dir / "rounds" / "2").rglob("*") if path.is_file()}
    done = train_policy(["--run-dir", str(run_dir)], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "training the policy in the world model: 0 updates" in done.stdout
    assert done.stdout.count("starting the graph") == 1
    assert (run_dir / "rounds" / "1" / "evaluations" / "real_before.json").read_text() == measured
    assert {
        path: path.stat().st_mtime_ns for path in (run_dir / "rounds" / "2").rglob("*") if path.is_file()
    } == finished
    assert [line["step"] for line in read_metrics(run_dir, "ppo")] == [1, 2]


@pytest.mark.slow
def test_the_agent_pays_the_policy_and_the_run_goes_on_with_that_reward_only(
    ros_domain: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_dir = tmp_path / "run"
    write_some_starts(run_dir / "starts.safetensors")
    arguments = [*SMALL, "--force", "--model-dir", str(make_model_folder(tmp_path / "model")),
                 "--run-dir", str(run_dir), "--evaluation.episodes", "2",
                 "--ppo.num_steps", "12", "--ppo.num_envs", "3", "--compose"]
    with serving(PickyServer()) as server:
        agent = ["--reward", "agent", "--judge", server.url, "--judge-model", "judge"]
        done = train_policy([*arguments, *agent], ros_domain)
        assert done.returncode == 0, done.stdout + done.stderr
        asked = len(server.requests)
        assert asked
        summary = read_summary(run_dir)
        assert (summary["reward"], summary["judge"]) == ("agent", f"judge at {server.url}")
        assert f"reward agent (judge at {server.url})" in (run_dir / "report.html").read_text()
        assert [line["step"] for line in read_metrics(run_dir, "ppo")] == [1, 2]
        with Bag(Path(summary["bag"])) as bag:
            assert bag.count("/wm/reward/verdict")
        assert recorded_reward_name(Path(summary["bag"])) == "agent"
        capfd.readouterr()
        assert main(["train-policy", *arguments, "--reward", "endogenous"]) == 2
        error = capfd.readouterr().err
        assert "--reward is 'agent' in this run, 'endogenous' is given" in error and error.count("\n") == 1
        for options in ([*arguments, *agent], ["--run-dir", str(run_dir)]):
            assert main(["train-policy", *options]) == 0
            assert "training is done already" in capfd.readouterr().out
        assert len(server.requests) == asked


def test_a_wrong_setting_ends_with_one_clear_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["train-policy", "--ppo.updates", "many", "--run-dir", str(tmp_path)]) == 2
    error = capfd.readouterr().err
    assert "ppo.updates" in error and "many" in error and "Traceback" not in error
    meter = ["--exploit_meter.every", "1", "--evaluation.episodes", "3"]
    assert main(["train-policy", *meter, "--run-dir", str(tmp_path)]) == 2
    assert "exploit_meter.episodes is 32, and this run has 24 first frames" in capfd.readouterr().err
