"""The seed study in a small model and the real simulator."""

from pathlib import Path

import pytest
from model_folders import make_model_folder

from wm_nodes.apps import seed_study
from wm_nodes.apps.cli import main
from wm_nodes.apps.seed_study import read_results
from wm_nodes.world_model import load_model_folder


@pytest.mark.slow
def test_a_study_in_rounds_refreshes_the_model_and_keeps_finished_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seed_study, "IMAGINED_EPISODES", 8)
    model, out = make_model_folder(tmp_path / "model"), tmp_path / "study"
    words = ["seed-study", "--preset", "smoke", "--tasks", "push_cube", "--seeds", "0", "--arms", "world_model",
             "--threads", "1", "--model-dir", str(model), "--out", str(out), "--model_refresh.num_rounds", "2",
             "--exploit_meter.every", "1", "--exploit_meter.episodes", "2", "--evaluation.episodes", "2",
             "--simulation.max_episode_steps", "12"]
    assert main(words) == 0
    (row,) = read_results(out)
    (refresh,) = row["refreshes"]
    assert [reading["update"] for reading in row["exploit_meter"]] == [0, 1, 1, 2]
    assert len(row["course"]) == 2 and {entry["name"] for entry in refresh["rows"]} >= {"done signal right"}
    refreshed = load_model_folder(out / "push_cube_0" / "rounds" / "1" / "model")
    assert refreshed.manifest["refreshed"][0]["episodes"] == 8, "4 of the policy and 4 scripted ones"
    assert (out / "push_cube_0" / "rounds" / "1" / "starts.safetensors").exists()
    assert main(words) == 0 and read_results(out) == [row]
