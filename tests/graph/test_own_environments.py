"""Environments that the product has never heard of, an arm of its own file and one of Gymnasium, up to a policy that is
trained in a model of them: recorded by the graph, modelled from the recording, trained in over DDS."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import drawn_pendulum
import gymnasium
import numpy as np
import pytest
import torch
from graph.harness import Graph, Probe, own_domain
from graph.launched import train_policy

from examples import own_environment
from wm_msgs.action import Rollout, Train
from wm_msgs.srv import StopRecording
from wm_nodes.apps.cli import DONE, NOT_ACCEPTED, main
from wm_nodes.apps.policy_pictures import write_pictures
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.specs import SpecMismatch, agree
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.factories import UNTRAINED, make_imagined_environment, make_policy
from wm_nodes.policy_rl.gym import ID
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.recording import read_episodes, read_spec
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.reports.summary import read_summary
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model import DeviceEnvironment, load_model_folder
from wm_nodes.world_model.validation.acceptance import accept_world_model

pytestmark = [pytest.mark.graph, pytest.mark.slow]
STEPS = 480
"""Of all environments of a recording together."""
NUM_ENVS = {"arm": 1, "pendulum": 4}
"""A real robot is one, although 4 are asked for."""
OWN = {
    "arm": {"environment.factory": "examples.own_environment:make"},
    "pendulum": drawn_pendulum.SETTINGS,
}
SMALL = {
    "task": "", "tokenizer.width": 32, "tokenizer.patch_px": 8, "tokenizer.num_iterations": 60,
    "tokenizer.decoder_iterations": 0, "tokenizer.probe_iterations": 0, "world_model.width": 32,
    "world_model.num_iterations": 60, "world_model.batch_size": 8, "world_model.rollout_steps": [2],
    "reward.dense_weight": 0.0, "ppo.num_envs": 4, "ppo.updates": 1,
}
of_the_arm = pytest.mark.parametrize("own", ["arm"], indirect=True, scope="module")


@pytest.fixture(scope="module", params=[*OWN])
def own(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def config(own: str) -> RunConfig:
    torch.set_num_threads(1)
    return load_config("smoke", {**SMALL, **OWN[own]})


@pytest.fixture(scope="module")
def bag(config: RunConfig, own: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What the recorder heard while a policy acted at random in them."""
    steps = STEPS // NUM_ENVS[own]
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path_factory.mktemp("own") / "run", config), Probe(domain)
        graph.start("recorder", record_at_start=True)
        graph.start("environment", backend="environment", num_envs=4)
        graph.start_reward()
        graph.start("policy", policy__factory=UNTRAINED,
                    await_nodes=["environment", "reward_evaluator", "recorder"])
        acted = probe.finish(probe.send(probe.action(Rollout, "rollout"), Rollout.Goal(steps=steps, reset=True)))
        stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
        probe.close()
        codes = graph.stop()
        assert acted.termination_reason == Rollout.Result.FINISHED, acted.message
        assert stopped.gaps == 0 and not any(codes.values()), codes
        yield Path(stopped.bag_uri)


@pytest.fixture(scope="module")
def model_dir(bag: Path, config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `wm train-model` makes of the recording."""
    folder = tmp_path_factory.mktemp("trained")
    preset = folder / "own.yaml"
    preset.write_text(dump_config(config), encoding="utf-8")
    given = ["--bags", str(bag), "--preset", str(preset), "--out", str(folder / "out")]
    assert main(["train-model", *given]) in (DONE, NOT_ACCEPTED)
    return folder / "out" / "model"


def test_the_recording_holds_the_spec_and_the_success_that_the_environment_says(
    bag: Path, config: RunConfig, own: str
) -> None:
    spec, episodes = read_spec(bag), list(read_episodes(bag))
    assert spec.spec_hash == configured_spec(config, NUM_ENVS[own]).spec_hash
    assert spec.measured == tuple(range(spec.state_dim)) and not spec.ground_truth_names
    won = [episode.success.any() for episode in episodes]
    assert any(won) and not all(won)
    stacked = stack_episodes(episodes, (spec.task,))
    np.testing.assert_array_equal(stacked.success[..., 0].any(1), won)


def test_the_model_knows_its_environment_from_its_manifest_and_reads_no_positions(
    model_dir: Path, bag: Path, config: RunConfig
) -> None:
    models, spec = load_model_folder(model_dir), configured_spec(config)
    assert agree(models.spec, read_spec(bag), "the bag has") is None
    assert models.tasks == (spec.task,) and models.probe is None and models.text is None
    assert models.tokenizer.probe is None
    assert (models.tokenizer.height, models.tokenizer.width) == (spec.height, spec.width)
    assert json.loads((model_dir / "manifest.json").read_text())["spec"]["env_id"] == spec.env_id


@of_the_arm
def test_it_imagines_how_measured_joints_move_and_not_what_the_action_asked_for(
    model_dir: Path, config: RunConfig
) -> None:
    imagined = make_imagined_environment(config, model_dir, model_dir / STARTS, num_envs=4, seed=0)
    before = imagined.reset().state
    action = np.full((4, 6), 0.8, np.float32)
    moved = imagined.step(action).observation.state - before
    asked, made = 0.25 * 0.8, 0.7 * 0.25 * 0.8
    assert abs(moved.mean() - made) < abs(moved.mean() - asked)
    device = DeviceEnvironment.beside(imagined)
    device.reset(torch.ones(4, dtype=torch.bool), imagined.episodes.starts_N)
    with torch.inference_mode():
        device.step(torch.from_numpy(action))
    np.testing.assert_allclose(device.states_NP.numpy(), imagined.current().state, atol=1e-6)


@of_the_arm
def test_the_model_is_an_environment_of_gymnasium_without_a_task(model_dir: Path) -> None:
    envs = gymnasium.make_vec(ID, 2, model_dir=model_dir)
    shown, _ = envs.reset(seed=0)
    assert envs.observation_space.contains(shown)
    assert (shown["image"].shape, shown["state"].shape) == ((2, 72, 96, 3), (2, 6))
    following, rewards, *_ = envs.step(np.full((2, 6), 0.5, np.float32))
    assert rewards.shape == (2,) and (following["state"] != shown["state"]).all()


def test_acceptance_judges_the_done_signal_and_says_that_it_cannot_judge_positions(
    model_dir: Path, bag: Path, config: RunConfig
) -> None:
    models, spec = load_model_folder(model_dir), read_spec(bag)
    heldout = stack_episodes(read_episodes(bag), models.tasks, num_steps=spec.max_episode_steps)
    report = accept_world_model(models, heldout, config)
    names = [row.name.split(", step")[0] for row in report.criteria]
    assert names == ["done precision in time on rollouts", "done recall on rollouts", "feature distance / copying",
                     "feature distance, other / recorded actions", "varying pixels, unexplained"]
    assert report.task == spec.task and "Positions were not judged" in report.notes[0]


def test_one_ppo_update_in_the_model_runs_over_dds(
    model_dir: Path, graph: Graph, probe: Probe, config: RunConfig
) -> None:
    graph = Graph(graph.domain, graph.folder, config)
    graph.start("environment", backend="world_model", model_dir=model_dir, starts_file=model_dir / STARTS, num_envs=4)
    graph.start_reward()
    graph.start("learner", model_dir=model_dir)
    graph.start("policy", model_dir=model_dir, await_nodes=["environment", "reward_evaluator", "learner"])
    result = probe.finish(probe.send(probe.action(Train, "train"), Train.Goal(updates=1)))
    codes = graph.stop()
    assert (result.termination_reason, result.updates) == (Train.Result.FINISHED, 1), result.message
    assert not any(codes.values()), codes
    made = {path.name: path.read_bytes() for path in (graph.folder / "policies").glob("*.safetensors")}
    assert made["policy_000001.safetensors"] != made["policy_000002.safetensors"]


@of_the_arm
def test_the_example_records_an_environment_through_the_graph(
    config: RunConfig, ros_domain: int, tmp_path: Path
) -> None:
    settings = [word for name, value in OWN["arm"].items() for word in (f"--{name}", str(value))]
    done = subprocess.run(
        [sys.executable, "-m", "examples.record", str(tmp_path / "bag"), *settings, "--policy.factory", UNTRAINED,
         "--steps", "40", "--num-envs", "2", "--domain-id", str(ros_domain)],
        capture_output=True, encoding="utf-8", timeout=200, check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    episodes = [*read_episodes(tmp_path / "bag", expected=configured_spec(config))]
    ended = [episode for episode in episodes if episode.terminated or episode.truncated]
    won = sum(episode.success.any() for episode in ended)
    assert f"{len(ended)} episodes, {won} succeed" in done.stdout and len(ended) >= 4


def test_the_example_records_what_trained_weights_do_in_the_real_environment(
    model_dir: Path, config: RunConfig, own: str, ros_domain: int, tmp_path: Path
) -> None:
    trained, weights = make_policy(config.with_values(seed=7), model_dir), tmp_path / "trained.safetensors"
    save_weights(trained, weights)
    settings = [word for name, value in OWN[own].items() if name != "task" for word in (f"--{name}", str(value))]
    done = subprocess.run(
        [sys.executable, "-m", "examples.record", str(tmp_path / "bag"), *settings, "--model-dir", str(model_dir),
         "--initial-policy", str(weights), "--deterministic", "--steps", "40", "--num-envs", "2",
         "--domain-id", str(ros_domain)],
        capture_output=True, encoding="utf-8", timeout=200, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    episodes = [*read_episodes(tmp_path / "bag", expected=configured_spec(config))]
    assert len(episodes) >= 4 and {episode.behaviour for episode in episodes} == {"policy"}
    for episode in episodes:
        wanted = trained.act(episode.images[:-1], episode.states[:-1]).actions
        np.testing.assert_allclose(episode.actions, wanted, atol=1e-5)


@pytest.mark.parametrize("own", ["pendulum"], indirect=True, scope="module")
def test_a_report_shows_what_the_policy_does_in_gymnasium_beside_what_the_model_imagines(
    model_dir: Path, config: RunConfig, tmp_path: Path
) -> None:
    config = config.with_values(evaluation=config.evaluation.with_values(environment="gymnasium"))
    pictures = write_pictures(tmp_path, config, model_dir, make_policy(config, model_dir), 7)
    moving, *strips = [picture.path for picture in pictures]
    assert moving.suffix == ".gif" and [strip.suffix for strip in strips] == [".png"] * 2
    assert all(path.stat().st_size > 1000 for path in (moving, *strips))


@of_the_arm
@pytest.mark.slow
@pytest.mark.parametrize("measured_in", ["none", "examples.own_environment:make"])
def test_train_policy_needs_no_task_and_says_where_nothing_real_was_measured(
    model_dir: Path, bag: Path, config: RunConfig, ros_domain: int, tmp_path: Path, measured_in: str
) -> None:
    preset = tmp_path / "arm.yaml"
    preset.write_text(dump_config(config), encoding="utf-8")
    done = train_policy([
        "--preset", str(preset), "--model-dir", str(model_dir), "--demos", str(bag), "--force",
        "--evaluation.environment", measured_in, "--sft.num_demonstrations", "2",
        "--run-dir", str(tmp_path / "run"),
    ], ros_domain)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = read_summary(tmp_path / "run")
    assert summary["task"] == "touch_the_post" and summary["imagined_after"]["episodes"] == 32
    when_made = json.loads((model_dir / "acceptance.json").read_text())["criteria"]
    assert len(when_made) == 4 and summary["acceptance"]["criteria"][:4] == when_made
    report = (tmp_path / "run" / "report.html").read_text()
    assert ("Nothing real was measured" in report) is (measured_in == "none")
    assert re.findall("<h2>(Real and imagined|Training)", report) == ["Training"], "nothing is played on a robot"
    assert (summary["real_after"] or {"episodes": None})["episodes"] == (None if measured_in == "none" else 4)


@of_the_arm
def test_train_policy_without_a_task_names_what_is_missing(
    model_dir: Path, bag: Path, config: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "arm.yaml"
    preset.write_text(dump_config(config), encoding="utf-8")
    begun = ["train-policy", "--preset", str(preset), "--run-dir", str(tmp_path / "run")]
    for given, words in (
        ([], "task is empty; name a model of your recordings with --model-dir"),
        (["--model-dir", str(model_dir)], "task is empty; name recordings of demonstrations with --demos"),
        (["--model-dir", str(model_dir), "--demos", str(bag)], "task is empty, and environment maniskill simulates"),
        (["--model-dir", str(model_dir), "--demos", str(bag), "--model_refresh.num_rounds", "2",
          "--evaluation.environment", "none"],
         "model_refresh.num_rounds is 2, and rounds collect in the simulator"),
    ):
        assert main([*begun, *given]) == 2
        assert words in capsys.readouterr().err


@of_the_arm
def test_the_trained_policy_acts_on_the_arm_and_another_robot_s_is_refused_by_what_differs(
    model_dir: Path, config: RunConfig
) -> None:
    arm = own_environment.make(config, 2, 1)
    shown = arm.reset()
    output = make_policy(config, model_dir).act(shown.image, shown.state)
    assert arm.step(output.actions).valid.all()
    with pytest.raises(SpecMismatch, match=r"cameras .*action_names .*it is another robot: .*train a model on them"):
        agree(arm.spec, configured_spec(load_config("cpu")), "the policy needs")
