"""Models as environments: rank correlation by hand, what is kept, and a ranking of real policies."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_pendulum import SETTINGS
from model_folders import make_model_folder, make_stepped_folder, write_starts

from benchmarks.environments import experiments
from benchmarks.environments.experiments import Ranking, _over_seeds, is_finished
from benchmarks.environments.policies import (
    SIMULATOR,
    WORLD_MODEL,
    Workplace,
    known_policy,
    rank_policies,
    spearman,
    train_in,
)
from benchmarks.experiment import rounded
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.core.files import file_sha256
from wm_nodes.policy_rl.factories import UNTRAINED, make_policy
from wm_nodes.policy_rl.initial_policy import start_files
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model import load_model_folder

SMALL = {"simulation.max_episode_steps": 12, "evaluation.episodes": 2}


def test_the_rank_correlation_is_that_of_a_number_worked_by_hand() -> None:
    """Spearman's 1 - 6 sum d^2 / (n (n^2 - 1)) with d = (0, 1, -1, 0, 0), n = 5: 0.9; monotone maps change nothing."""
    x, y = np.array([1, 2, 3, 4, 5]), np.array([0.1, 30, 2, 400, 5000])
    correlation, low, high = spearman(x, y, seed=0)
    assert correlation == pytest.approx(0.9)
    assert -1 <= low < correlation <= high <= 1
    assert spearman(x, np.exp(-y / 1000), seed=0)[0] == pytest.approx(-0.9)
    assert spearman([1, 1, 2, 2], [1, 1, 2, 2], seed=0)[0] == pytest.approx(1)


def test_without_spread_there_is_no_correlation_and_pairs_must_match() -> None:
    assert all(math.isnan(value) for value in spearman([0.5, 0.5, 0.5], [1, 2, 3], seed=0))
    with pytest.raises(ValueError, match="needs pairs"):
        spearman([1, 2], [1, 2, 3], seed=0)


def test_each_model_is_ranked_against_the_simulator() -> None:
    rows = [
        {"real": {"rate": real}, "imagined": {"a": {"rate": real / 2}, "b": {"rate": 1 - real}}}
        for real in np.linspace(0, 1, 8)
    ]
    found = rank_policies(rows, ["a", "b"], seed=0)
    assert (found["a"]["correlation"], found["b"]["correlation"]) == (pytest.approx(1), pytest.approx(-1))


@pytest.fixture
def work(tmp_path: Path) -> Workplace:
    config = load_config("smoke", SMALL)
    work = Workplace(config, make_model_folder(tmp_path / "model"), tmp_path / "push_cube_0")
    starts, weak = start_files(work.folder)
    weak.parent.mkdir(parents=True)
    vars(work)["start"] = (write_starts(starts), weak)
    save_weights(make_policy(config, work.model_dir), weak)
    return work


@pytest.mark.slow
@pytest.mark.rendering
def test_the_control_is_trained_and_measured_in_the_simulator(work: Workplace) -> None:
    row, ppo = train_in(work, SIMULATOR), work.config.ppo
    assert (row["model"], row["updates"], len(row["course"])) == ("simulator", ppo.updates, ppo.updates)
    assert row["real_before"]["episodes"] == row["real_after"]["episodes"] == work.config.evaluation.episodes
    assert row["imagined_after"]["episodes"] == 5  # as many as there are starts
    (trained,) = (Path(path) for path in row["policies"])
    assert trained.parent.name == "simulator" and file_sha256(trained) != file_sha256(work.start[1])


def test_imagined_success_is_measured_in_each_model(work: Workplace, tmp_path: Path) -> None:
    """One episode from each of the model's five starts."""
    models = [WORLD_MODEL, str(make_stepped_folder(tmp_path / "video_model"))]
    imagined = [work.imagined(work.policy(), work.environment(model)) for model in models]
    assert [result.episodes for result in imagined] == [5, 5]
    assert imagined[1].successes > 0


def row_of(work: Workplace, model: str = WORLD_MODEL, **changes: object) -> dict[str, Any]:
    config = load_config("smoke", SMALL | changes)
    other = Workplace(config, work.model_dir, work.folder)
    return {"real_before": {}, **rounded(other.identity(model, ["train"]))}


def test_a_row_is_known_by_every_setting_by_the_models_and_by_the_scenes(work: Workplace, tmp_path: Path) -> None:
    row = row_of(work)
    assert is_finished([row], work.identity(WORLD_MODEL, ["train"]))
    assert not is_finished([row], work.identity(WORLD_MODEL, [])) and not is_finished([row], work.identity(SIMULATOR))
    for changes in ({"ppo.learning_rate": 1e-5}, {"evaluation.episodes": 3}, {"seed": 1}, {"ppo.advantage": "group"}):
        other = Workplace(load_config("smoke", SMALL | changes), work.model_dir, work.folder)
        assert not is_finished([row], other.identity(WORLD_MODEL, ["train"])), changes
    precise = Workplace(load_config("smoke", SMALL | {"ppo.learning_rate": 1.234567e-4}), work.model_dir, work.folder)
    row = row_of(work, **{"ppo.learning_rate": 1.234567e-4})
    assert is_finished([row], precise.identity(WORLD_MODEL, ["train"])), "a file holds five digits"
    assert precise.rounds != work.rounds, "models that another policy refreshed"
    video = make_stepped_folder(tmp_path / "video_model")
    assert len(work.identity(str(video))["models_sha256"]) == 2
    old = {"model": WORLD_MODEL, "task": "push_cube", "seed": 0, "updates": work.config.ppo.updates}
    assert not is_finished([old], work.identity(WORLD_MODEL, [])), "nobody knows its settings"


def test_a_ranking_is_of_its_own_policies_by_these_settings_in_these_models(
    work: Workplace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither other settings, nor a policy that was trained again since, nor another video model."""
    weights, file, asked = work.start[1], tmp_path / "rows.json", list[int]()

    def measure(place: Workplace, path: Path, models: list[str]) -> dict[str, Any]:
        imagined = {model: {"rate": 0.5} for model in models}
        return {**known_policy(place, path, models), "real": {"rate": 0.5}, "imagined": imagined}

    monkeypatch.setattr(experiments, "measure_policy", measure)
    monkeypatch.setattr(experiments, "rank_policies", lambda rows, models, seed: asked.append(len(rows)) or {})
    for settings, models in ((SMALL, ()), (SMALL, ()), (SMALL | {"evaluation.episodes": 3}, ()), (SMALL, ("video",))):
        videos = tuple(make_stepped_folder(tmp_path / name) for name in models)
        Ranking(preset="smoke", model_dir=work.model_dir, policies=(weights,), json=file, settings=settings,
                video_models=videos).run()
    weights.write_bytes(weights.read_bytes() + b" ")
    Ranking(preset="smoke", model_dir=work.model_dir, policies=(weights,), json=file, settings=SMALL).run()
    assert asked == [1] * 5 and len(json.loads(file.read_text(encoding="utf-8"))["rows"]) == 4


def test_rows_of_one_seed_are_not_counted_as_several(work: Workplace) -> None:
    """One was measured in further scenes, too, and one is of a model that was trained anew."""
    row = row_of(work) | {"task": "push_cube", "seed": 0, "success_before": [0, 1], "success_after": [1, 1]}
    assert not _over_seeds([row, row | {"scenes": []}, row | {"models_sha256": ["another"]}])
    assert _over_seeds([row, row | {"seed": 1, "config": row["config"] | {"seed": 1}}])[0][2] == "0, 1"


@pytest.mark.slow
@pytest.mark.rendering
def test_trained_in_prints_acceptance_keeps_refused_rows_and_trains_again_only_by_other_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, file = make_model_folder(tmp_path / "model"), tmp_path / "rows.json"
    words = ["benchmark", "trained-in", "--preset", "smoke", "--model-dir", str(model), "--seeds", "0",
             "--json", str(file), "--work", str(tmp_path / "work"), "--data.num_workers", "1",
             "--evaluation.episodes", "2", "--acceptance.num_episodes", "2",
             "--acceptance.clone_episodes", "2", "--simulation.max_episode_steps", "12"]

    def rows() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["rows"]
        return found

    assert main(words) == 0
    (row,) = rows()
    assert row["accepted"] is False and row["acceptance"]["outcome"] == "failed" and row["acceptance"]["criteria"]
    assert "acceptance failed (object error" in " ".join(capsys.readouterr().out.split()) and len(row["course"]) == 2
    assert main(words) == 0 and rows() == [row]
    assert main([*words, "--ppo.learning_rate", "1e-5"]) == 0
    rates = [found["config"]["ppo"]["learning_rate"] for found in rows()]
    assert rates == [row["config"]["ppo"]["learning_rate"], 1e-5]
    assert main([*words, "--sft.num_demonstrations", "3"]) == 2
    assert "were made with sft.num_demonstrations 4, not 3; take another folder" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.rendering
def test_training_in_rounds_refreshes_the_model_and_reads_the_exploit_meter(tmp_path: Path) -> None:
    model, file = make_model_folder(tmp_path / "model"), tmp_path / "rows.json"
    assert main([
        "benchmark", "trained-in", "--preset", "smoke", "--model-dir", str(model), "--seeds", "0", "--json", str(file),
        "--work", str(tmp_path / "work"), "--model_refresh.num_rounds", "2", "--exploit_meter.every", "1",
        "--exploit_meter.episodes", "2", "--evaluation.episodes", "2", "--simulation.max_episode_steps", "12",
    ]) == 0
    (row,) = json.loads(file.read_text(encoding="utf-8"))["rows"]
    (refresh,), (folder,) = row["refreshes"], (tmp_path / "work" / "push_cube_0").glob("rounds_*/rounds/1")
    assert [reading["update"] for reading in row["exploit_meter"]] == [0, 1, 1, 2]
    assert len(row["course"]) == 2 and {entry["name"] for entry in refresh["rows"]} >= {"done signal right"}
    refreshed = load_model_folder(folder / "model").manifest["refreshed"]
    assert refreshed[0]["episodes"] == 8, "4 of the policy and 4 scripted ones"
    assert (folder / "starts.safetensors").exists()


def test_a_policy_is_measured_in_an_environment_of_ones_own_with_what_that_measures_beside_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.json"
    settings = {**SETTINGS, "evaluation.environment": "gymnasium", "evaluation.episodes": 5,
                "gymnasium.measures": ["height"], "policy.factory": UNTRAINED}
    words = ["benchmark", "policy", "--preset", "smoke", "--json", str(file),
             *(word for name, value in settings.items() if name != "task" for word in (f"--{name}", json.dumps(value)))]
    assert main(words) == 0
    shown, (row,) = capsys.readouterr().out, json.loads(file.read_text(encoding="utf-8"))["rows"]
    mean, low, high = row["measures"]["height"]
    assert (row["policy"], row["episodes"]) == (UNTRAINED, 5) and -1 <= low <= mean <= high <= 1
    assert f"{row['successes']} of 5" in shown and f"{mean:.3f}" in shown
    assert main(words) == 0 and json.loads(file.read_text(encoding="utf-8"))["rows"] == [row]
