"""A run goes on from its folder alone; options that are given again must be those that it was begun with."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import yaml

from wm_nodes.apps import train_policy, train_video_model
from wm_nodes.apps.cli import Parser
from wm_nodes.config.load import FREE, ConfigError, dump_config, load_config
from wm_nodes.core.device import DeviceError
from wm_nodes.training.run_lock import NAME

BEGINNING = ["--preset", "smoke", "--ppo.updates", "3", "--seed", "4", "--task", "reach",
             "--model_refresh.num_rounds", "2",
             "--from-scratch", "--reward", "agent", "--judge", "http://a/v1,http://b/v1", "--judge-model", "judge",
             "--ppo.num_steps", "16", "--force"]

WITH_MODEL = [word for word in BEGINNING if word != "--from-scratch"]


@pytest.fixture
def any_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a manifest is a world model that fits."""
    for name in ("check_model", "model_spec", "read_world_manifest"):
        monkeypatch.setattr(train_policy, name, lambda *_: None)
    monkeypatch.setattr(train_policy, "with_reader", lambda config, folder: config)


def opened(words: Sequence[object], app: ModuleType = train_policy) -> tuple[dict[str, Any], str]:
    """The options and the configuration with which a command would go on."""
    parser = Parser()
    app.add_options(parser)
    arguments = parser.parse([*map(str, words)])
    with app.opened(arguments) as (config, run_dir):
        assert (run_dir / NAME).is_file()
    assert not (run_dir / NAME).exists()
    return vars(arguments), dump_config(config)


def refused(words: Sequence[object], app: ModuleType = train_policy) -> str:
    with pytest.raises(ConfigError) as caught:
        opened(words, app)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.usefixtures("any_model")
def test_the_folder_alone_brings_back_every_option_that_decides_the_run(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    model = tmp_path / "model"
    model.mkdir()
    (model / "manifest.json").touch()
    begun, config = opened([*WITH_MODEL, "--model-dir", model, *run])
    again, same = opened(run)
    assert same == config
    names = ("preset", "model_dir", "from_scratch", "reward", "force", "compose")
    assert {name: again[name] for name in names} == {name: begun[name] for name in names} == {
        "preset": "smoke", "model_dir": str(model), "from_scratch": False, "reward": "agent", "force": True,
        "compose": False,
    }
    assert opened([*WITH_MODEL, "--model-dir", model, *run])[1] == config, "options that are equal pass"
    assert opened(["--preset", "smoke", "--ppo.updates", "3", *run])[1] == config


def test_options_of_which_one_would_be_ignored_are_refused(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    assert "give one of them" in refused([*BEGINNING, "--model-dir", model_in(tmp_path / "model"), *run])
    assert not (tmp_path / "run").exists()
    assert opened([*BEGINNING, *run])[0]["from_scratch"] and opened(run)[0]["from_scratch"]


def test_each_option_that_differs_is_named_with_both_values_and_the_remedy(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    opened([*BEGINNING, *run])
    kept = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    text = refused(["--reward", "endogenous", "--ppo.updates", "4", "--seed", "5", *run])
    for part in ("--reward is 'agent' in this run, 'endogenous' is given", "--ppo.updates is 3 in this run, 4 is given",
                 "--seed is 4 in this run, 5 is given", "Leave them out to go on with it, or begin another run folder"):
        assert part in text
    for words, part in (
        (["--preset", "cpu"], "--preset is 'smoke' in this run, 'cpu' is given"),
        (["--task", "push_cube"], "--task is 'reach'"), (["--model_refresh.num_rounds", "3"], "num_rounds is 2"),
        (["--judge", "http://c/v1"], "--judge is ['http://a/v1', 'http://b/v1']"),
        (["--judge-model", "other"], "--judge-model is 'judge' in this run, 'other' is given"),
        (["--model-dir", "/other"], "--model-dir is None in this run, '/other' is given"),
    ):
        assert part in refused([*words, *run])
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == kept


def test_what_may_differ_takes_effect_and_is_kept(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    opened(["--preset", "smoke", *run])
    assert opened(["--force", "--compose", "--domain-id", "3", "--verbose", *run])[0]["force"] is True
    again = opened(run)[0]
    assert again["force"] and again["compose"] and not again["domain_id"] and not again["verbose"]
    video = ["--run-dir", tmp_path / "video"]
    opened(["--preset", "smoke", "--keep-buffers", "9", "--no-tensorboard", *video], train_video_model)
    assert opened(video, train_video_model)[0]["keep_buffers"] == 9
    assert opened(["--keep-buffers", "5", *video], train_video_model)[0]["tensorboard"] is False
    assert opened(video, train_video_model)[0]["keep_buffers"] == 5


def test_loop_2_goes_on_with_its_recordings_and_rewards(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    for name in "abc":
        (tmp_path / name).mkdir()
    bags = ["--bags", tmp_path / "a", tmp_path / "b", "--heldout-bags", tmp_path / "c"]
    _, config = opened(["--preset", "smoke", "--reward", "reference", *bags, *run], train_video_model)
    again, same = opened(run, train_video_model)
    assert same == config and again["bags"] == [str(tmp_path / "a"), str(tmp_path / "b")]
    opened(["--reward", "reference", *bags, *run], train_video_model)
    text = refused(["--bags", tmp_path / "a", "--heldout-bags", tmp_path / "c", *run], train_video_model)
    assert "--bags is" in text and "--heldout-bags" not in text
    assert "--reward is" in refused(["--reward", "agent", *run], train_video_model)
    assert "is a run of 'train-video-model', not of 'train-policy'" in refused(run)


def test_a_weight_that_is_given_by_name_is_mixed_into_the_reward_that_is_named(tmp_path: Path) -> None:
    run, reward = ["--run-dir", tmp_path / "run"], ["--reward", "reference", "--rewards.scenery", "-10"]
    _, config = opened([*reward, *run], train_video_model)
    assert yaml.safe_load(config)["rewards"] == {"tracking": 1.0, "scenery": -10}
    assert opened([*reward, *run], train_video_model)[1] == config
    with pytest.raises(ValueError, match="--reward and --rewards both say"):
        opened(["--reward", "agent", "--rewards", "{tracking: 1}", *run], train_video_model)


def model_in(folder: Path, text: str = "{}") -> Path:
    folder.mkdir()
    (folder / "manifest.json").write_text(text)
    return folder


@pytest.mark.usefixtures("any_model")
def test_a_moved_model_is_given_anew_and_another_one_refused(tmp_path: Path) -> None:
    run, model = ["--run-dir", tmp_path / "run"], model_in(tmp_path / "model")
    _, config = opened([*WITH_MODEL, "--model-dir", model, *run])
    moved, other = model.rename(tmp_path / "moved"), model_in(tmp_path / "other", '{"sha256": {}}')
    assert f"{model} holds no manifest.json; name the folder of a trained world model with --model-dir" in refused(run)
    text = refused(["--model-dir", other, *run])
    assert f"--model-dir is '{model}' in this run, '{other}' is given (which holds something else)" in text
    assert "--model-dir is" in refused(["--model-dir", tmp_path / "nothing", *run])
    again, same = opened(["--model-dir", moved, *run])
    assert again["model_dir"] == str(moved) and same == config
    assert opened(run)[0]["model_dir"] == str(moved), "the record has the new path"
    (tmp_path / "model").symlink_to(moved)
    assert opened(["--model-dir", model, *run])[0]["model_dir"] == str(moved), "a link is what it leads to"


@pytest.mark.usefixtures("any_model")
def test_a_record_without_contents_goes_on_where_the_old_path_leads_to_what_was_moved(tmp_path: Path) -> None:
    run, model = ["--run-dir", tmp_path / "run"], model_in(tmp_path / "model")
    opened([*WITH_MODEL, "--model-dir", model, *run])
    file = tmp_path / "run" / "config.yaml"
    values = yaml.safe_load(file.read_text())
    assert set(values["run"].pop("contents")) == {str(model)}
    file.write_text(yaml.safe_dump(values, sort_keys=False))
    moved = model.rename(tmp_path / "moved")
    assert f"(nobody knows what {model} held: if it was moved, link it there" in refused(["--model-dir", moved, *run])
    model.symlink_to(moved)
    opened(run)
    model.unlink()
    assert opened(["--model-dir", moved, *run])[0]["model_dir"] == str(moved)


def test_moved_demonstrations_are_given_anew_and_others_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_policy, "read_spec", lambda path: None)
    run, bags = ["--run-dir", tmp_path / "run"], [tmp_path / "a", tmp_path / "b"]
    for bag in bags:
        bag.mkdir()
        (bag / "metadata.yaml").write_text(bag.name)
    opened([*BEGINNING, "--demos", *bags, *run])
    a, b = (bag.rename(tmp_path / f"moved_{bag.name}") for bag in bags)
    assert f"{bags[0]} does not exist; name the recordings with --demos" in refused(run)
    assert "--demos is" in refused(["--demos", a, *run])
    assert "(which holds something else)" in refused(["--demos", b, a, *run])
    assert "--ppo.updates is 3 in this run, 4 is given" in refused(["--demos", a, b, "--ppo.updates", "4", *run])
    _, config = opened(["--demos", a, b, *run])
    assert yaml.safe_load(config)["sft"]["bags"] == [str(a), str(b)]
    assert opened(run)[1] == config, "the record has the new paths"


def test_recordings_that_a_setting_names_are_found_from_another_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_policy, "read_spec", lambda path: None)
    (tmp_path / "bag").mkdir()
    monkeypatch.chdir(tmp_path)
    run = ["--run-dir", tmp_path / "run"]
    _, config = opened([*BEGINNING, "--sft.bags", "[bag]", *run])
    assert yaml.safe_load(config)["sft"]["bags"] == [str(tmp_path / "bag")]
    monkeypatch.chdir("/")
    assert opened(run)[1] == config == opened(["--demos", tmp_path / "bag", *run])[1]


def test_one_file_holds_the_settings_and_the_options_and_its_settings_are_those_of_the_run(tmp_path: Path) -> None:
    _, config = opened([*BEGINNING, "--run-dir", tmp_path / "run"])
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["config.yaml"]
    values = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    run = values.pop("run")
    assert values == yaml.safe_load(config)
    assert run["preset"] == "smoke" and run["options"]["train-policy"]["reward"] == "agent"
    again = load_config(str(tmp_path / "run" / "config.yaml"))
    assert again == load_config("base", leaves(values)), "it is a preset, too"


def leaves(values: dict[str, Any], path: str = "") -> dict[str, Any]:
    """The settings below a section by their dotted names; free mappings as they are."""
    found = dict[str, Any]()
    for name, value in values.items():
        deeper = isinstance(value, dict) and name not in FREE
        found |= leaves(value, f"{path}{name}.") if deeper else {f"{path}{name}": value}
    return found


def test_a_changed_or_cut_record_is_one_clear_line(tmp_path: Path) -> None:
    file, run = tmp_path / "run" / "config.yaml", ["--run-dir", tmp_path / "run"]
    _, config = opened(["--preset", "smoke", *run])
    text = file.read_text()
    for changed, part in (
        (text[: len(text) // 2], "config.yaml"), ("", "it holds nothing"),
        (text.replace("seed: 0", "seed: 1"), "is not what the run was begun with (settings_sha256 differs)"),
        (config, "config.yaml does not say how the run was begun (section run)"),
        (f"{config}run: [1]\n", "does not say how the run was begun"),
    ):
        file.write_text(changed)
        assert part in refused(run)
    file.write_text(text)
    opened(run)


def test_settings_that_are_refused_leave_no_folder_and_a_preset_file_is_known_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ["--run-dir", tmp_path / "run"]
    refused(["--preset", "smoke", "--ppo.updates", "many", *run])
    refused(["--preset", "smoke", "--model-dir", tmp_path / "nowhere", *run])
    assert not (tmp_path / "run").exists()
    (tmp_path / "mine.yaml").write_text("seed: 3\n")
    monkeypatch.chdir(tmp_path)
    opened(["--preset", "mine.yaml", *run])
    monkeypatch.chdir("/")
    assert opened(["--preset", tmp_path / "mine.yaml", *run])[1] == dump_config(load_config("base", {"seed": 3}))
    assert "--preset is" in refused(["--preset", "other.yaml", *run])


@pytest.mark.parametrize("app", [train_policy, train_video_model])
def test_the_device_may_change_and_nothing_else_does(app: ModuleType, tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    saved = tmp_path / "run" / "config.yaml"
    _, config = opened(["--preset", "smoke", *run], app)
    begun = saved.read_text()
    saved.write_text(begun.replace("device: cpu\n", "device: cuda\n"))  # begun on a machine with a GPU
    _, there = opened(["--device", "cpu", *run], app)
    assert there == config and saved.read_text() == begun
    assert opened(["--device", "auto", *run], app)[1] == config.replace("device: cpu\n", "device: auto\n")
    for words in (run, ["--preset", "smoke", *run]):
        assert "device: auto\n" in opened(words, app)[1], "what is not said again stays"
    assert saved.read_text() == begun.replace("device: cpu\n", "device: auto\n")
    assert "--seed is 0 in this run, 1 is given" in refused(["--device", "cpu", "--seed", "1", *run], app)
    assert "device: auto\n" in saved.read_text(), "a refused command changes nothing"
    saved.write_text(saved.read_text().replace("seed: 0\n", "seed: 1\n"))
    assert "sha256 differs" in refused(["--device", "cpu", *run], app)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.parametrize("app", [train_policy, train_video_model])
def test_a_gpu_that_is_not_there_is_refused_before_anything_is_written(app: ModuleType, tmp_path: Path) -> None:
    run = ["--preset", "smoke", "--run-dir", tmp_path / "run"]
    with pytest.raises(DeviceError, match=r"device is cuda, but torch .* sees no GPU"):
        opened(["--device", "cuda", *run], app)
    assert not (tmp_path / "run" / "config.yaml").exists()
    opened(run, app)
    kept = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    with pytest.raises(DeviceError, match=r"device is cuda, but torch .* sees no GPU"):
        opened(["--device", "cuda", *run], app)
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == kept
