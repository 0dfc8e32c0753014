"""Table 1 of RoboScape-R: its formula on the paper's own cells, its cells, and every kind of training end to end."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
from model_folders import make_model_folder

from benchmarks.environments import roboscape
from benchmarks.environments.figures import extreme_table
from benchmarks.environments.policies import Workplace, train_on
from benchmarks.environments.roboscape import (
    ALL_SCENES,
    JUDGE,
    MANY,
    MODEL,
    ONE_SCENE,
    OOD,
    PAPER,
    REFRESHED,
    SFT,
    TASKS,
    cell,
    gain,
    scene_of_seed,
    success_of,
)
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.config.scenes import splits
from wm_nodes.config.tasks import part_of
from wm_nodes.policy_rl.image_policy import ImagePolicy


def row(task: str, training: str, seed: int, ind: float, ood: float, **more: object) -> dict[str, Any]:
    rates = {"own": ind, OOD[0]: ood - 10, OOD[1]: ood + 10}
    success = {name: {"rate": rate / 100} for name, rate in rates.items()}
    return {"task": task, "model": training, "seed": seed, "scene": "own", "success": success, **more}


def test_the_papers_cells_give_the_papers_gain() -> None:
    rows = [row(task, name, 0, PAPER[name, "IND"][i], PAPER[name, "OOD"][i])
            for i, task in enumerate(TASKS) for name in (SFT, ONE_SCENE, MODEL)]
    assert gain(rows, ONE_SCENE) == "+44.7" and gain(rows, ALL_SCENES) == ""


def test_the_interval_of_a_gain_is_over_seeds_that_both_have() -> None:
    rows = [row("push", MODEL, seed, 90, 80 + seed) for seed in range(3)]
    rows += [row("push", ONE_SCENE, seed, 90, 60) for seed in range(2)]
    assert gain(rows, ONE_SCENE).startswith("+20.5 (+14.1 to +26.9 over 2 seeds")


def test_a_cell_says_its_mean_its_interval_and_whether_the_model_is_accepted() -> None:
    two = [row("push", MODEL, seed, 50 + 10 * seed, 20, accepted=True) for seed in range(2)]
    assert cell(two[:1], "IND") == "50.0" and cell(two[:1], "OOD") == "20.0" and cell([], "IND") == ""
    assert cell(two, "IND") == "55.0 (0.0 to 100.0)"
    assert cell([row("push", MODEL, 0, 50, 20, accepted=False)], "OOD") == "[20.0]"


def test_success_of_one_policy_for_several_tasks_is_told_by_the_seeds_of_its_episodes() -> None:
    first = 1_500_000
    won = [int(part_of(MANY, first + number) == "push") for number in range(40)]
    made = row(MANY, MODEL, 0, 50, 20, config={"evaluation": {"first_seed": first}})
    for name in ("own", *OOD):
        made["success"][name]["episodes_won"] = won
    assert success_of(made, "OOD", "push") == 100 and success_of(made, "IND", "pull") == 0
    made["success"]["own"]["episodes_won"] = won[:1]  # of push alone
    assert cell([made], "IND", "pull" if won[0] else "push") == "-"
    assert success_of(made, "IND") == 50 and cell([made], "OOD", "push") == "100.0"


def test_the_demonstrations_of_a_seed_are_of_one_training_scene() -> None:
    scenes = [scene_of_seed(seed) for seed in range(8)]
    assert len(set(scenes)) > 4 and set(scenes) <= set(splits()["train"])


@pytest.mark.slow
@pytest.mark.rendering
def test_every_training_is_made_once_and_measured_in_and_out_of_domain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    noises = list[float | None]()

    def train(workplace: Workplace, policy: ImagePolicy, imagined: Any, *arguments: Any) -> Iterator[float]:
        noises.append(getattr(imagined, "picture_noise", None))
        return train_on(workplace, policy, imagined, *arguments)

    monkeypatch.setattr(roboscape, "train_on", train)
    short = {"simulation.max_episode_steps": 20, "evaluation.episodes": 1, "acceptance.num_episodes": 2,
             "imagined_environment.picture_noise": 0.01, "policy.inputs": "latents",
             "acceptance.clone_episodes": 2, "acceptance.clone_scenes": ["ood_object"],
             "data.num_workers": 1, "sft.num_demonstrations": 1, "ppo.updates": 1,
             "tokenizer.foreground": "background", "ppo.num_steps": 20, "model_refresh.episodes_per_round": 1,
             "model_refresh.heldout_episodes": 2, "model_refresh.replay_episodes": 1,
             "model_refresh.refresh_iterations": 1, "model_refresh.own_starts": 0}
    model = make_model_folder(tmp_path / "model", load_config("smoke", {"task": "push", **short}))
    file = tmp_path / "rows.json"
    words = ["reproduce", "roboscape", "--preset", "smoke", "--model-dir", str(model), "--tasks", "push",
             "--seeds", "0", "--json", str(file), "--work", str(tmp_path / "work"),
             "--trainings", SFT, ONE_SCENE, ALL_SCENES, MODEL, JUDGE, REFRESHED,
             *(word for name, value in short.items() for word in (f"--{name}", str(value)))]
    assert main(words) == 0
    assert noises == [None, None, 0.01, 0.01]
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert [one["model"] for one in rows] == [SFT, ONE_SCENE, ALL_SCENES, MODEL, JUDGE, REFRESHED]
    assert all(one["success"].keys() == {scene_of_seed(0), *OOD} for one in rows)
    assert [len(one["course"]) for one in rows] == [0, 1, 1, 1, 1, 1] and rows[-2]["accepted"] is False
    asked = [row["name"].split(" (")[0] for row in rows[3]["acceptance"]["criteria"]]
    assert "done precision, cloned policy, ood_object" in asked
    assert rows[-1]["refresh"]["rows"][-1]["name"] == "done signal right"
    shown = capsys.readouterr().out
    assert "[0.0]" in shown and "RL in the simulator, all training scenes" in shown
    assert main([*words, "--figure", "4"]) == 0 and json.loads(file.read_text(encoding="utf-8"))["rows"] == rows
    strip = cv2.imread(str(tmp_path / "work" / "push_0" / f"push_{OOD[0]}.png"))
    assert strip is not None and len(strip) > len(rows) * 2 * 64  # a row of pictures for each policy


def test_the_table_of_extreme_actions_has_every_step_that_was_measured() -> None:
    metrics = {f"{name}_h{step}": 1.0 for name in ("psnr_shuffled_drop_db", "tool_command_cm") for step in ("01", "40")}
    table = extreme_table([{"task": "push", "domain": "train", "actions": "extreme", "metrics": metrics}])
    assert list(table.columns[3].cells) == ["1", "40"]


@pytest.mark.slow
@pytest.mark.rendering
def test_figure_9_follows_scripted_and_extreme_actions_in_every_domain_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model_folder(tmp_path / "model", load_config("smoke", {"task": "push"}))
    file = tmp_path / "rows.json"
    words = ["reproduce", "roboscape", "--figure", "9", "--preset", "smoke", "--model-dir", str(model), "--tasks",
             "push", "--json", str(file), "--work", str(tmp_path / "work"), "--evaluation.episodes", "2",
             "--data.num_workers", "1", "--simulation.max_episode_steps", "4"]
    assert main(words) == 0
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert [(row["domain"], row["actions"]) for row in rows] == [
        (domain, actions) for domain in ("train", *OOD) for actions in ("scripted", "extreme")
    ]
    assert all(Path(row["picture"]).exists() and "psnr_shuffled_drop_db_h04" in row["metrics"] for row in rows)
    assert "rollouts of extreme actions" in capsys.readouterr().out
    assert main(words) == 0 and json.loads(file.read_text(encoding="utf-8"))["rows"] == rows


@pytest.mark.slow
@pytest.mark.rendering
def test_figure_3_scores_every_reward_in_every_domain_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model_folder(tmp_path / "model", load_config("smoke", {"task": "push"}))
    file = tmp_path / "rows.json"
    words = ["reproduce", "roboscape", "--figure", "3", "--preset", "smoke", "--model-dir", str(model), "--tasks",
             "push", "--json", str(file), "--work", str(tmp_path / "work"), "--learned-from", "5",
             "--evaluation.episodes", "5", "--data.num_workers", "1", "--policy.inputs", "latents"]
    assert main(words) == 0
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert {row["domain"] for row in rows} == {"train", *OOD}
    rewards = ["done signal", "embedding head", "proxy network", "done signal, its largest value", "reward agent"]
    assert [row["reward"] for row in rows[:5]] == rewards
    assert "AUROC, empty hand" in capsys.readouterr().out
    assert main(words) == 0 and json.loads(file.read_text(encoding="utf-8"))["rows"] == rows


def test_a_table_and_a_figure_are_two_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "roboscape", "--table", "1", "--figure", "2"]) == 2
    assert "--table and --figure are two runs; give one of them" in capsys.readouterr().err
