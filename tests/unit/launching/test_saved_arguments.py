"""A launch of an existing run folder goes on with its settings and arguments; what differs is named."""

import json
import shutil
from pathlib import Path

import pytest
from run_holders import holder

from wm_nodes.config.load import ConfigError, dump_config, load_config, load_video_config
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.launch_description import prepare_graph
from wm_nodes.launching.runner import main
from wm_nodes.launching.saved_arguments import FILE


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
    assert same == values | {"preset": "cpu", "task": "push_cube", "domain_id": "", "initial_policy": str(
        tmp_path / "weak.safetensors")}, "the settings stand for preset and task"
    assert [node.label for node in again.nodes] == [node.label for node in first.nodes]
    assert again.node("wm/environment").parameters == first.node("wm/environment").parameters
    assert files(tmp_path) | {"graph.json": b""} == kept | {"graph.json": b""}
    assert load_config(same["config_file"]) == load_config("smoke", {"task": "reach", "seed": 3})
    again, same = launch_arguments.begin("online_training", {**begun, **run_in(tmp_path), "model_dir": model,
                                                             "initial_policy": str(tmp_path / "weak.safetensors")})
    assert same["seed"] == "3" and again.node("wm/environment").parameters["num_envs"] == 6
    assert prepare_graph("online_training", run_in(tmp_path), launch_arguments.sys.executable) == again


def test_given_arguments_that_differ_are_named_and_nothing_is_touched(tmp_path: Path, model: str) -> None:
    begun = {"preset": "smoke", "model_dir": model, "num_envs": "6", "reward": "agent", "judge": "http://a/v1",
             "judge_model": "judge"}
    preset = tmp_path / "mine.yaml"
    preset.write_text(dump_config(load_config("smoke", {"ppo.num_steps": 16})))
    launch_arguments.begin("online_training", {**begun, **run_in(tmp_path), "preset": str(preset)})
    kept = files(tmp_path)
    text = refused("online_training", {**run_in(tmp_path), "seed": "1", "num_envs": "5", "task": "reach"})
    for part in ("seed is '0' in this run, '1' is given", "num_envs is '6' in this run, '5' is given",
                 "task is 'push_cube' in this run, 'reach' is given", "Leave them out", "begin another run folder"):
        assert part in text
    for given, part in (
        ({"preset": "smoke"}, f"preset is '{preset}' in this run, 'smoke' is given"),
        ({"judge": "http://b/v1"}, "judge is ['http://a/v1'] in this run, ['http://b/v1'] is given"),
        ({"judge_model": "other"}, "judge_model is 'judge' in this run, 'other' is given"),
        ({"reward": "rule"}, "reward is 'agent' in this run, 'rule' is given"),
        ({"set": "learner.factory=mine:learner"}, "learner.factory is '' in this run, 'mine:learner' is given"),
        ({"learner_ranks": "2"}, "learner_ranks is '1' in this run, '2' is given"),
        ({"config_file": str(tmp_path / "other.yaml")}, "ppo.num_steps is 16 in this run"),
    ):
        (tmp_path / "other.yaml").write_text(dump_config(load_config("smoke")))
        assert part in refused("online_training", {**run_in(tmp_path), **given})
    assert files(tmp_path) == kept
    free = {"record": "false", "domain_id": "7", "log_level": "debug", "namespace": "/lab", "compose": "true"}
    graph, _ = launch_arguments.begin("online_training", {**run_in(tmp_path), **free})
    assert graph.nodes[0].namespace == "/lab" and graph.environment["ROS_DOMAIN_ID"] == "7"
    _, values = launch_arguments.begin("online_training", run_in(tmp_path))
    assert (values["record"], values["domain_id"], values["log_level"]) == ("false", "", "info")


def test_a_folder_without_kept_arguments_goes_on_with_its_configuration(tmp_path: Path, model: str) -> None:
    (tmp_path / "run").mkdir()
    config = load_config("smoke", {"seed": 4, "task": "reach"})
    (tmp_path / "run" / "config.yaml").write_text(dump_config(config))
    given = {**run_in(tmp_path), "model_dir": model}
    assert "seed is 4 in this run, 5 is given" in refused("rollout_record", {**given, "seed": "5"})
    assert "data.num_episodes is" in refused("rollout_record", {**given, "preset": "cpu", "task": "reach", "seed": "4"})
    for more in ({}, {"preset": "smoke", "task": "reach", "seed": "4"}, {}):
        _, values = launch_arguments.begin("rollout_record", {**given, **more})
        assert load_config(values["config_file"]) == config and values["seed"] == "4"
    _, values = launch_arguments.begin("evaluate", given)
    assert load_config(values["config_file"]) == config, "another scenario of the same run"
    assert set(json.loads((tmp_path / "run" / FILE).read_text())) == {"rollout_record", "evaluate"}


def test_an_unnamed_judge_is_the_embedded_one_also_when_a_preset_is_given_again(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model, "preset": "smoke"}
    launch_arguments.begin("judge_clips", given)
    (tmp_path / "run" / FILE).unlink()
    launch_arguments.begin("judge_clips", given)
    named = {"judge": "http://a/v1", "judge_model": "judge"}
    assert "judge is [] in this run" in refused("judge_clips", {**given, **named})


def test_loop_2_goes_on_with_its_own_settings(tmp_path: Path, model: str) -> None:
    begun = {"video_preset": "smoke", "video_model_dir": model, "context_bags": "/a,/b", "keep_buffers": "7",
             "reward": "agent", "judge": "embedded"}
    first, values = launch_arguments.begin("world_model_rl", {**begun, **run_in(tmp_path)})
    again, same = launch_arguments.begin("world_model_rl", run_in(tmp_path))
    assert again == first and same["keep_buffers"] == "7"
    assert load_video_config(same["config_file"]).rewards == {"agent": 1.0}
    assert launch_arguments.begin("world_model_rl", {**begun, **run_in(tmp_path)})[0] == first
    assert "video_preset is 'smoke'" in refused("world_model_rl", {**run_in(tmp_path), "video_preset": "base"})
    assert "context_bags is '/a,/b'" in refused("world_model_rl", {**run_in(tmp_path), "context_bags": "/a"})
    assert "judge is [] in this run" in refused("world_model_rl", {**run_in(tmp_path), "judge": "http://a/v1"})
    assert values["config_file"] == same["config_file"] == str(tmp_path / "run" / "video_config.yaml")


def test_a_graph_that_a_command_started_goes_on_by_its_launch_file_too(tmp_path: Path, model: str) -> None:
    saved = tmp_path / "run" / "config.yaml"
    saved.parent.mkdir()
    saved.write_text(dump_config(load_config("smoke", {"seed": 3})))
    of_command = {"config_file": str(saved), "reward": "rule", "model_dir": model, "seed": "3", "autostart": "false",
                  "starts_file": str(tmp_path / "starts"), "compose": "true", "domain_id": "9"}
    _, first = launch_arguments.prepare("online_training", {**run_in(tmp_path), **of_command})
    _, values = launch_arguments.begin("online_training", run_in(tmp_path))
    assert values == first | {"autostart": "true", "compose": "false", "domain_id": ""}
    launch_arguments.begin("online_training", {**run_in(tmp_path), "preset": "smoke", "seed": "3"})
    assert "seed is '3' in this run" in refused("online_training", {**run_in(tmp_path), "preset": "smoke", "seed": "0"})


def test_a_configuration_file_that_was_given_is_copied_and_may_go(tmp_path: Path, model: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(dump_config(load_config("smoke", {"ppo.updates": 9})))
    given = {**run_in(tmp_path), "model_dir": model}
    launch_arguments.begin("online_training", {**given, "config_file": str(file)})
    launch_arguments.begin("online_training", {**given, "config_file": str(file)})
    file.unlink()
    _, values = launch_arguments.begin("online_training", given)
    assert load_config(values["config_file"]).ppo.updates == 9
    assert values["config_file"] == str(tmp_path / "run" / "config.yaml")


def test_a_refused_first_launch_leaves_nothing_to_go_on_with(tmp_path: Path, model: str) -> None:
    given = {**run_in(tmp_path), "model_dir": model, "preset": "smoke"}
    with pytest.raises(ValueError, match="num_envs must be a whole number"):
        launch_arguments.begin("online_training", {**given, "num_envs": "many"})
    assert not (tmp_path / "run" / "config.yaml").exists() and not (tmp_path / "run" / FILE).exists()
    launch_arguments.begin("online_training", {**given, "preset": "cpu", "num_envs": "4"})
    (tmp_path / "run" / FILE).write_text("{")
    with pytest.raises(ModelFolderError, match=f"{FILE} cannot be read .*delete it"):
        launch_arguments.begin("online_training", given)


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


def test_a_settings_file_may_name_another_device_for_the_same_run(tmp_path: Path, model: str) -> None:
    saved, named = tmp_path / "run" / "config.yaml", tmp_path / "mine.yaml"
    named.write_text(dump_config(load_config("smoke", {"device": "cuda"})))
    given = {**run_in(tmp_path), "model_dir": model, "config_file": str(named)}
    saved.parent.mkdir()
    shutil.copy(named, saved)
    for device in ("cuda", "cpu"):
        named.write_text(dump_config(load_config("smoke", {"device": device})))
        _, values = launch_arguments.begin("rollout_record", given)
        assert load_config(values["config_file"]) == load_config("smoke", {"device": device})
        for again in ({}, {"preset": "smoke"}):
            _, values = launch_arguments.begin("rollout_record", run_in(tmp_path) | again)
            assert values["config_file"] == str(saved) and load_config(str(saved)).device == device
    named.write_text(dump_config(load_config("smoke", {"device": "cuda", "ppo.num_steps": 16})))
    assert "ppo.num_steps is" in refused("rollout_record", given) and load_config(str(saved)).device == "cpu"
