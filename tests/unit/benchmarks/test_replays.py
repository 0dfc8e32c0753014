"""Imagined successes of policies, replayed in the simulator."""

import json
from pathlib import Path

import pytest
from model_folders import make_model_folder

from benchmarks.environments.replays import of_split
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config


@pytest.mark.slow
@pytest.mark.rendering
def test_a_clone_is_replayed_in_every_split_and_a_policy_that_was_never_trained_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model_folder(tmp_path / "model", load_config("smoke", {"task": "push"}))
    file, work = tmp_path / "rows.json", tmp_path / "work"
    words = ["benchmark", "replays", "--preset", "smoke", "--model-dir", str(model), "--tasks", "push", "--seeds", "0",
             "--json", str(file), "--work", str(work), "--evaluation.episodes", "2", "--data.num_workers", "1",
             "--sft.num_iterations", "2", "--sft.num_demonstrations", "1", "--policy.inputs", "latents"]
    assert main([*words, "--trainings", "sft"]) == 0
    (row,) = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert row["replays"].keys() == {"train", "ood_object", "ood_combo"}
    assert all([len(them) for them in found.values()] == [2, 2, 2] for found in row["replays"].values())
    assert "imagined successes that are real" in capsys.readouterr().out
    assert main([*words, "--trainings", "world_model"]) == 2
    assert "holds no policies of the training 'world_model'" in capsys.readouterr().err


def test_the_share_is_of_the_imagined_successes() -> None:
    found = of_split({"imagined": [1, 1, 0, 1], "replayed": [1, 0, 1, 1], "held": [1, 1, 1, 1]})
    assert found.startswith("2 of 3: 67 % [") and found.endswith("held 3")
    assert of_split({"imagined": [0, 0], "replayed": [1, 0], "held": [1, 1]}) == "none"
