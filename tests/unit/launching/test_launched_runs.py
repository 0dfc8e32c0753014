"""A launch of an existing run folder goes on with its settings and arguments; what differs is named."""

from pathlib import Path

import pytest
from run_holders import holder

from wm_nodes.config.load import ConfigError, dump_config, load_config, load_video_config
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.launch_description import prepare_graph
from wm_nodes.launching.runner import main
from wm_nodes.training.run_record import keep_config, read_record


@pytest.fixture
def model(tmp_path: Path) -> str:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "manifest.json").write_text("{}")
    return str(tmp_path / "model")


def run_in(folder: Path) -> dict[str, str]:
    return {"run_dir": str(folder / "run")}


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "run").iterdir()}


def refused(scenario: str, given: dict[str, str]) -> str:
    with pytest.raises(ConfigError) as caught:
        launch_arguments.begin(scenario, given)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_folder_alone_brings_back_settings_and_arguments(
    tmp_path: Path, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    begun = {"preset": "smoke", "task": "reach", "seed": "3", "num_envs": "6", "model_dir": "model", "reward": "rule",
             "simulator_envs": "2", "learner_ranks": "2", "initial_policy": "weak.safetensors", "record": "false"}
    first, values = launch_arguments.begin("online_training", {**begun, **run_in(tmp_path), "domain_id": "7"})
    kept = files(tmp_path)
    monkeypatch.chdir("/")
    again, same = launch_arguments.begin("online_training", run_in(tmp_path))
    assert same == values | {"task": "", "domain_id": ""}, "the settings stand for the task"
    assert [node.label for node in again.nodes] == [node.label for node in first.nodes]
    assert again.node("wm/environment").parameters == first.node("wm/environment").parameters
    assert files(tmp_path) == kept and set(kept) == {"config.yaml"}
    assert load_config(str(tmp_path / "run" / "config.yaml")) == load_config("smoke", {"task": "reach", "seed": 3})
    again, same = launch_arguments.begin("online_training", {**begun, **run_in(tmp_path), "model_dir": model,
                                                             "initial_policy": str(tmp_path / "weak.safetensors")})
    assert same["seed"] == "3" and again.node("wm/environment").parameters["num_envs"] == 6
    assert prepare_graph("online_training", run_in(tmp_path), launch_arguments.sys.executable) == again


def test_a_run_that_was_moved_goes_on_with_its_own_files(tmp_path: Path, model: str) -> None:
    run, moved = tmp_path / "run", tmp_path / "moved"
    inside = {"initial_policy": "policies/weak.safetensors", "starts_file": "starts.safetensors"}
    elsewhere = f"{tmp_path}/mount{run}/first_frames.safetensors"
    begun = {"preset": "smoke", "model_dir": model, "first_frames_file": elsewhere}
    begun |= {name: str(run / file) for name, file in inside.items()}
    _, values = launch_arguments.begin("online_training", {**run_in(tmp_path), **begun})
    run.rename(moved)
    _, again = launch_arguments.begin("online_training", {"run_dir": str(moved)})
    assert {name: again[name] for name in inside} == {name: str(moved / file) for name, file in inside.items()}
    assert again["bag_uri"] == str(moved / Path(values["bag_uri"]).relative_to(run)) and again["model_dir"] == model
    assert again["first_frames_file"] == elsewhere, "only the run's own folder has moved"
    record = (moved / "config.yaml").read_text(encoding="utf-8")
    assert f"{run}/" not in record.replace(elsewhere, "")


def test_files_that_were_moved_are_given_anew_and_others_refused(tmp_path: Path, model: str) -> None:
    weak = tmp_path / "weak.safetensors"
    weak.write_bytes(b"weak")
    begun = {"preset": "smoke", "model_dir": model, "initial_policy": str(weak)}
    launch_arguments.begin("online_training", {**run_in(tmp_path), **begun})
    moved, other = Path(model).rename(tmp_path / "moved"), tmp_path / "other.safetensors"
    other.write_bytes(b"other")
    with pytest.raises(ValueError, match="as model_dir:=, also where this run's was moved"):
        launch_arguments.begin("online_training", run_in(tmp_path))
    anew = {"model_dir": str(moved), "initial_policy": str(weak.rename(tmp_path / "moved.safetensors"))}
    assert "initial_policy is" in refused("online_training", {**run_in(tmp_path), **anew, "initial_policy": str(other)})
    _, values = launch_arguments.begin("online_training", {**run_in(tmp_path), **anew})
    assert values["starts_file"] == str(moved / "starts.safetensors")
    _, again = launch_arguments.begin("online_training", run_in(tmp_path))
    assert {name: again[name] for name in anew} == anew


def test_given_arguments_that_differ_are_named_and_nothing_is_touched(tmp_path: Path, model: str) -> None:
    begun = {"preset": "smoke", "model_dir": model, "num_envs": "6", "reward": "agent", "judge": "http://a/v1",
             "judge_model": "judge"}
    preset = tmp_path / "mine.yaml"
    preset.write_text(dump_config(load_config("smoke", {"ppo.num_steps": 16})))
    launch_arguments.begin("online_training", {**begun, **run_in(tmp_path), "preset": str(preset)})
    kept = files(tmp_path)
    text = refused("online_training", {
        **run_in(tmp_path), "seed": "1", "num_envs": "5", "task": "reach", "ppo.num_steps": "8",
    })
    for part in ("seed is 0 in this run, 1 is given", "ppo.num_steps is 16 in this run, 8 is given",
                 "num_envs is '6' in this run, '5' is given",
                 "task is 'push_cube' in this run, 'reach' is given", "Leave them out", "begin another run folder"):
        assert part in text
    for given, part in (
        ({"preset": "smoke"}, f"preset is '{preset}' in this run, 'smoke' is given"),
        ({"judge": "http://b/v1"}, "judge is ['http://a/v1'] in this run, ['http://b/v1'] is given"),
        ({"judge_model": "other"}, "judge_model is 'judge' in this run, 'other' is given"),
        ({"reward": "rule"}, "reward is 'agent' in this run, 'rule' is given"),
        ({"learner.factory": "mine:learner"}, "learner.factory is '' in this run, 'mine:learner' is given"),
        ({"learner_ranks": "2"}, "learner_ranks is '1' in this run, '2' is given"),
    ):
        assert part in refused("online_training", {**run_in(tmp_path), **given})
    assert files(tmp_path) == kept
    free = {"record": "false", "domain_id": "7", "log_level": "debug", "namespace": "/lab", "compose": "true"}
    graph, _ = launch_arguments.begin("online_training", {**run_in(tmp_path), **free})
    assert graph.nodes[0].namespace == "/lab" and graph.environment["ROS_DOMAIN_ID"] == "7"
    _, values = launch_arguments.begin("online_training", run_in(tmp_path))
    assert (values["record"], values["domain_id"], values["log_level"]) == ("false", "", "info")


def test_another_scenario_joins_a_run_with_its_settings_and_arguments_of_its_own(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model}
    launch_arguments.begin("rollout_record", {**given, "preset": "smoke", "task": "reach", "seed": "4"})
    _, values = launch_arguments.begin("evaluate", {**given, "simulator_envs": "2", "preset": "smoke"})
    assert (values["seed"], values["simulator_envs"]) == ("4", "2")
    assert "preset is 'smoke' in this run, 'cpu' is given" in refused("evaluate", {**given, "preset": "cpu"})
    assert "simulator_envs is '2'" in refused("evaluate", {**given, "simulator_envs": "3"})
    record = read_record(tmp_path / "run")
    assert record is not None and set(record.options) == {"rollout_record", "evaluate"}
    assert load_config(str(tmp_path / "run" / "config.yaml")) == load_config("smoke", {"seed": 4, "task": "reach"})


def test_a_setting_is_given_by_its_name_and_a_wrong_one_answered_with_the_nearest(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model, "preset": "smoke", "device": "auto", "ppo.num_envs": "4"}
    for wrong, part in (("ppo.num_env", "did you mean 'ppo.num_envs'?"), ("poo.num_envs", "did you mean 'ppo'?")):
        assert part in refused("online_training", {**given, wrong: "4"})
    graph, values = launch_arguments.begin("online_training", given)
    assert values["num_envs"] == "4" and graph.node("wm/environment").parameters["num_envs"] == 4
    assert load_config(str(tmp_path / "run" / "config.yaml")) == load_config("smoke", {
        "device": "auto", "ppo.num_envs": 4,
    })


def test_an_unnamed_judge_is_the_embedded_one(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model, "preset": "smoke"}
    for _ in range(2):
        launch_arguments.begin("judge_clips", given)
    named = {"judge": "http://a/v1", "judge_model": "judge"}
    assert "judge is 'embedded' in this run" in refused("judge_clips", {**given, **named})


def test_loop_2_goes_on_with_its_own_settings(tmp_path: Path, model: str) -> None:
    begun = {"preset": "smoke", "video_model_dir": model, "context_bags": "/a,/b", "keep_buffers": "7",
             "reward": "agent", "judge": "embedded"}
    first, _ = launch_arguments.begin("world_model_rl", {**begun, **run_in(tmp_path)})
    again, same = launch_arguments.begin("world_model_rl", run_in(tmp_path))
    assert again == first and same["keep_buffers"] == "7"
    assert load_video_config(str(tmp_path / "run" / "config.yaml")).rewards == {"agent": 1.0}
    assert launch_arguments.begin("world_model_rl", {**begun, **run_in(tmp_path)})[0] == first
    assert "preset is 'smoke'" in refused("world_model_rl", {**run_in(tmp_path), "preset": "base"})
    assert "context_bags is '/a,/b'" in refused("world_model_rl", {**run_in(tmp_path), "context_bags": "/a"})
    assert "judge is 'embedded' in this run" in refused("world_model_rl", {**run_in(tmp_path), "judge": "http://a/v1"})
    assert "unknown setting 'iterations'" in refused("evaluate", run_in(tmp_path))
    weighed = {**begun, "rewards.closeness": "0.5", "run_dir": str(tmp_path / "weighed")}
    launch_arguments.begin("world_model_rl", weighed)
    assert load_video_config(str(tmp_path / "weighed" / "config.yaml")).rewards == {"agent": 1.0, "closeness": 0.5}


def test_a_graph_that_a_command_started_goes_on_by_its_launch_file_too(tmp_path: Path, model: str) -> None:
    keep_config(load_config("smoke", {"seed": 3}), tmp_path / "run")
    of_command = {"reward": "rule", "model_dir": model, "autostart": "false", "starts_file": str(tmp_path / "starts"),
                  "compose": "true", "domain_id": "9"}
    _, first = launch_arguments.prepare("online_training", {**run_in(tmp_path), **of_command})
    _, values = launch_arguments.begin("online_training", run_in(tmp_path))
    assert values == first | {"autostart": "true", "compose": "false", "domain_id": ""} and values["seed"] == "3"
    assert "seed is 3 in this run" in refused("online_training", {**run_in(tmp_path), "seed": "0"})
    other = {**run_in(tmp_path), **of_command, "starts_file": "/elsewhere"}
    assert launch_arguments.prepare("online_training", other)[1]["starts_file"] == "/elsewhere", "the command knows"


def test_a_file_of_settings_is_copied_and_may_go(tmp_path: Path, model: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(dump_config(load_config("smoke", {"ppo.updates": 9, "task": "reach", "seed": 5})))
    given = {**run_in(tmp_path), "model_dir": model}
    for _ in range(2):
        launch_arguments.begin("online_training", {**given, "preset": str(file)})
        file.unlink(missing_ok=True)
    launch_arguments.begin("online_training", given)
    config = load_config(str(tmp_path / "run" / "config.yaml"))
    assert (config.ppo.updates, config.task, config.seed) == (9, "reach", 5)


def test_a_refused_first_launch_leaves_nothing_to_go_on_with(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model, "preset": "smoke"}
    with pytest.raises(ValueError, match="num_envs must be a whole number"):
        launch_arguments.begin("online_training", {**given, "num_envs": "many"})
    assert not (tmp_path / "run").exists()
    launch_arguments.begin("online_training", {**given, "preset": "cpu", "num_envs": "4"})


def test_the_plain_starter_refuses_a_folder_in_use_and_forgets_a_wrong_start(
    tmp_path: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    words = ["preset:=smoke", f"model_dir:={model}", f"run_dir:={folder}", "domain_id:=7"]
    folder.mkdir()
    with holder(folder) as process:
        kept = files(tmp_path)
        assert main("evaluate", words) == 2
        text = capsys.readouterr().err
        assert f"run folder {folder} is in use by process {process.pid}" in text and text.count("\n") == 1
        assert files(tmp_path) == kept
    folder.rmdir()
    assert main("evaluate", [*words, "simulator_envs:=many"]) == 2
    assert "simulator_envs must be a whole number" in capsys.readouterr().err and not folder.exists()


def test_the_device_may_change_and_stays(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model}
    for device in ("cuda", "cpu"):
        launch_arguments.begin("rollout_record", {**given, "preset": "smoke", "device": device})
        for again in ({}, {"preset": "smoke"}):
            launch_arguments.begin("rollout_record", run_in(tmp_path) | again)
            saved = load_config(str(tmp_path / "run" / "config.yaml"))
            assert saved == load_config("smoke", {"device": device})
    assert "ppo.num_steps is" in refused("rollout_record", {**given, "device": "cuda", "ppo.num_steps": "16"})
    assert load_config(str(tmp_path / "run" / "config.yaml")).device == "cpu"
