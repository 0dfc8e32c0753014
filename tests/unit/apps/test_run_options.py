"""A run goes on from its folder alone; options that are given again must be those that it was begun with."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import yaml

from wm_nodes.apps import train_policy, train_video_model
from wm_nodes.apps.run_options import BEGUN
from wm_nodes.config.load import ConfigError, dump_config, load_config
from wm_nodes.core.device import DeviceError
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.run_lock import NAME

BEGINNING = ["--preset", "smoke", "--set", "ppo.updates=3", "--seed", "4", "--task", "reach", "--rounds", "2",
             "--from-scratch", "--reward", "agent", "--judge", "http://a/v1,http://b/v1", "--judge-model", "judge",
             "--set", "ppo.num_steps=16", "--force"]


def opened(words: Sequence[object], app: ModuleType = train_policy) -> tuple[dict[str, Any], str]:
    """The options and the configuration with which a command would go on."""
    parser = argparse.ArgumentParser()
    app.add_options(parser)
    arguments = parser.parse_args([*map(str, words)])
    with app.opened(arguments) as (config, run_dir):
        assert (run_dir / NAME).is_file()
    assert not (run_dir / NAME).exists()
    return vars(arguments), dump_config(config)


def refused(words: Sequence[object], app: ModuleType = train_policy) -> str:
    with pytest.raises(ConfigError) as caught:
        opened(words, app)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_folder_alone_brings_back_every_option_that_decides_the_run(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    model = tmp_path / "model"
    model.mkdir()
    (model / "manifest.json").touch()
    begun, config = opened([*BEGINNING, "--model-dir", model, *run])
    again, same = opened(run)
    assert same == config
    names = ("preset", "model_dir", "from_scratch", "reward", "force", "compose")
    assert {name: again[name] for name in names} == {name: begun[name] for name in names} == {
        "preset": "smoke", "model_dir": str(model), "from_scratch": True, "reward": "agent", "force": True,
        "compose": False,
    }
    assert opened([*BEGINNING, "--model-dir", model, *run])[1] == config, "options that are equal pass"
    assert opened(["--preset", "smoke", "--set", "ppo.updates=3", *run])[1] == config


def test_each_option_that_differs_is_named_with_both_values_and_the_remedy(tmp_path: Path) -> None:
    run = ["--run-dir", tmp_path / "run"]
    opened([*BEGINNING, *run])
    kept = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    text = refused(["--reward", "endogenous", "--set", "ppo.updates=4", "--seed", "5", *run])
    for part in ("--reward is 'agent' in this run, 'endogenous' is given", "ppo.updates is 3 in this run, 4 is given",
                 "--seed is 4 in this run, 5 is given", "Leave them out to go on with it, or begin another run folder"):
        assert part in text
    for words, part in (
        (["--preset", "cpu"], "--preset is 'smoke' in this run, 'cpu' is given"),
        (["--task", "push_cube"], "--task is 'reach'"), (["--rounds", "3"], "--rounds is 2"),
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


def test_a_folder_from_before_the_options_were_kept_goes_on_as_before(tmp_path: Path) -> None:
    run_dir, run = tmp_path / "run", ["--run-dir", tmp_path / "run"]
    (tmp_path / "manifest.json").touch()
    options = ["--preset", "smoke", "--from-scratch", "--reward", "agent", "--set", "ppo.num_steps=16"]
    _, config = opened([*options, *run])
    (run_dir / BEGUN).unlink()
    comments = "# begun with --from-scratch\n# begun with --reward agent\n"
    text = config.replace("\nacceptance:", "\ngate:").replace("\nmodel_refresh:", "\nrounds:") + comments
    (run_dir / "config.yaml").write_text(text)
    for words in (run, [*options, *run], [*options, "--model-dir", tmp_path, *run]):
        again, same = opened(words)
        assert same == config and again["from_scratch"] and again["reward"] == "agent"
    assert (run_dir / "config.yaml").read_text() == text
    assert "--seed is 0 in this run, 1 is given" in refused([*options, "--seed", "1", *run])
    assert "ppo.num_steps is 16 in this run" in refused(["--preset", "smoke", "--from-scratch", *run])
    assert "--reward is 'agent'" in refused(["--reward", "endogenous", *run])
    (run_dir / "config.yaml").write_text(config)
    assert "--from-scratch is False in this run, True is given" in refused(["--from-scratch", *run])
    video = tmp_path / "video"
    _, config = opened(["--preset", "smoke", "--run-dir", video], train_video_model)
    (video / BEGUN).unlink()
    (video / "config.yaml").write_text(f"{config}# begun with --bags /a\n# begun with --bags /b\n"
                                       "# begun with --heldout-bags /c\n")
    again, _ = opened(["--run-dir", video], train_video_model)
    assert (again["bags"], again["heldout_bags"], again["from_scratch"]) == (["/a", "/b"], ["/c"], False)


def test_a_changed_configuration_or_broken_options_are_one_clear_line(tmp_path: Path) -> None:
    run_dir, run = tmp_path / "run", ["--run-dir", tmp_path / "run"]
    _, config = opened(["--preset", "smoke", *run])
    for text in (config[: len(config) // 2], "", config.replace("seed: 0", "seed: 1")):
        (run_dir / "config.yaml").write_text(text)
        assert "config.yaml" in refused(run)
    (run_dir / "config.yaml").write_text(config)
    (run_dir / BEGUN).write_text(json.dumps(["smoke"]))
    with pytest.raises(ModelFolderError, match=f"{BEGUN} holds no JSON object; restore it"):
        opened(run)


def test_settings_that_are_refused_leave_no_folder_and_a_preset_file_is_known_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ["--run-dir", tmp_path / "run"]
    refused(["--preset", "smoke", "--set", "ppo.updates=many", *run])
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
    kept = (tmp_path / "run" / BEGUN).read_bytes()
    saved.write_text(config.replace("device: cpu\n", "device: cuda\n"))  # begun on a machine with a GPU
    _, there = opened(["--device", "cpu", *run], app)
    assert there == config and yaml.safe_load(saved.read_text()) == yaml.safe_load(config)
    assert opened(["--set", "device=auto", *run], app)[1] == config.replace("device: cpu\n", "device: auto\n")
    for words in (run, ["--preset", "smoke", *run]):
        assert "device: auto\n" in opened(words, app)[1], "what is not said again stays"
    assert (tmp_path / "run" / BEGUN).read_bytes() == kept
    assert "--seed is 0 in this run, 1 is given" in refused(["--device", "cpu", "--seed", "1", *run], app)
    assert "device: auto\n" in saved.read_text(), "a refused command changes nothing"
    saved.write_text(saved.read_text().replace("seed: 0\n", "seed: 1\n"))
    assert "sha256 differs" in refused(["--device", "cpu", *run], app)


def test_an_old_folder_that_names_no_device_goes_on_with_any(tmp_path: Path) -> None:
    run_dir, run = tmp_path / "run", ["--run-dir", tmp_path / "run"]
    _, config = opened(["--preset", "smoke", *run])
    old = config.replace("device: cpu\n", "") + "# begun with --reward endogenous\n"
    (run_dir / BEGUN).unlink()
    (run_dir / "config.yaml").write_text(old)
    opened(run)
    assert (run_dir / "config.yaml").read_text() == old
    opened(["--device", "auto", *run])
    assert (run_dir / "config.yaml").read_text() == f"{old}device: auto\n"


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
