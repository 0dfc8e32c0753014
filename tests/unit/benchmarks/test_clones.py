"""Clones by their inputs and the number of demonstrations."""

import json
from pathlib import Path

import pytest
from model_folders import make_model_folder

from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config


@pytest.mark.slow
@pytest.mark.rendering
def test_every_clone_is_made_once_from_the_first_demonstrations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model_folder(tmp_path / "model", load_config("smoke", {"task": "push"}))
    file, work = tmp_path / "rows.json", tmp_path / "work"
    words = ["benchmark", "clones", "--preset", "smoke", "--model-dir", str(model), "--tasks", "push", "--seeds", "0",
             "--inputs", "latents", "positions", "--demonstrations", "1", "2", "--json", str(file), "--work", str(work),
             "--evaluation.episodes", "1", "--data.num_workers", "1", "--sft.num_iterations", "2"]
    assert main(words) == 0
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert [(row["config"]["sft"]["num_demonstrations"], row["config"]["policy"]["inputs"]) for row in rows] == [
        (1, "latents"), (1, "positions"), (2, "latents"), (2, "positions")
    ]
    assert all(row["success"].keys() == {"train", "ood_object", "ood_combo"} for row in rows)
    assert "success of clones" in capsys.readouterr().out
    before = [path.stat().st_mtime for path in (work / "push_0").glob("*.safetensors")]
    assert main(words) == 0 and json.loads(file.read_text(encoding="utf-8"))["rows"] == rows
    assert [path.stat().st_mtime for path in (work / "push_0").glob("*.safetensors")] == before
