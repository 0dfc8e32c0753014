"""`wm collect` in the simulator: an interrupted collection goes on, the index and the table tell what was collected."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from wm_nodes.apps.cli import main
from wm_nodes.config.scenes import SCENES
from wm_nodes.environments import collection, record
from wm_nodes.environments.collection import behaviour_of
from wm_nodes.environments.record import success_table
from wm_nodes.recording import read_episodes

SHARES = {"expert": 0.5, "detour": 0.25, "near_miss": 0.25}


def arguments(folder: Path, episodes: int = 3) -> list[str]:
    shares = [f"--data.behaviours={{{', '.join(f'{name}: {share}' for name, share in SHARES.items())}}}"]
    return [
        "collect", str(folder), "--tasks", "push", "--episodes", str(episodes), *shares,
        "--simulation.image_size=16", "--data.num_workers=1", "--simulation.max_episode_steps=20",
    ]


@pytest.mark.rendering
def test_an_interrupted_collection_goes_on_and_gives_what_one_in_one_go_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(collection, "EPISODES_PER_SHARD", 2)
    write, interrupted, whole = record.write_shard, tmp_path / "interrupted", tmp_path / "whole"

    def stop_at_the_second(path: Path, *rest: Any) -> None:
        if path.name != "shard_00000000":
            raise KeyboardInterrupt
        write(path, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(record, "write_shard", stop_at_the_second)
        assert main(arguments(interrupted)) == 130
    first = interrupted / "push" / "shard_00000000"
    written = {path.name: path.stat().st_mtime_ns for path in first.iterdir()}
    assert main(arguments(interrupted)) == 0
    assert {path.name: path.stat().st_mtime_ns for path in first.iterdir()} == written
    table = capsys.readouterr().out
    assert main(arguments(whole)) == 0
    index = (interrupted / "push" / "index.csv").read_text()
    assert index == (whole / "push" / "index.csv").read_text()
    rows = list(csv.DictReader(index.splitlines()))
    assert [row["seed"] for row in rows] == ["0", "1", "2"] and len({row["bag"] for row in rows}) == 2
    episodes = [episode for bag in sorted((whole / "push").glob("shard_*")) for episode in read_episodes(bag)]
    for row, episode in zip(rows, episodes, strict=True):
        scene = SCENES[row["scene"]]
        assert episode.instruction == row["instruction"] == f"push the {scene.object} away from the robot"
        assert row["behaviour"] == episode.behaviour == behaviour_of(episode.seed, SHARES)
        assert (row["success"] == "True") == episode.success.any() and int(row["steps"]) == episode.num_steps
        assert row["planner"] == "" and episode.extra["scene"] == row["scene"]
    assert sum(int(line.split()[2]) for line in table.splitlines() if line.startswith("push ")) == 3
    assert all(row["scene"] in (interrupted / "success.txt").read_text() for row in rows)
    assert main(arguments(whole, episodes=2)) == 2
    assert "was begun with num_episodes 3, not 2; take another folder" in capsys.readouterr().err

    plan = json.loads((whole / "push" / "plan.json").read_text())
    plan.pop("recovers")
    (whole / "push" / "plan.json").write_text(json.dumps(plan))
    assert main(arguments(whole)) == 0, "a folder that was begun before a setting was known"

    short = whole / "push" / "shard_00000002"
    assert main(arguments(whole, episodes=4)) == 2
    assert f"{short} holds the last 1 of 3 episodes; delete it to go on to 4" in capsys.readouterr().err
    shutil.rmtree(short)
    assert main(arguments(whole, episodes=4)) == 0
    assert [row["seed"] for row in csv.DictReader((whole / "push" / "index.csv").open())] == ["0", "1", "2", "3"]


def test_seeds_of_the_evaluation_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments(tmp_path), "--first-seed", "999999"]) == 2
    assert "--first-seed 999999 and 3 episodes are not below 1000000" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_task_without_a_name_is_refused_before_anything_is_collected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["collect", str(tmp_path), "--tasks", "push,", "--episodes", "1"]) == 2
    assert "unknown task ''; choose one of" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_table_counts_by_the_columns_it_is_given() -> None:
    rows = [
        {"task": "push", "scene": "a", "success": True, "steps": 10, "planner": ""},
        {"task": "push", "scene": "b", "success": False, "steps": 20, "planner": "no path to waypoint 1 of 3"},
        {"task": "pull", "scene": "a", "success": True, "steps": 6, "planner": ""},
    ]
    assert success_table(rows, "task").splitlines()[1:] == [
        "pull         1   100.0%    6.0             0", "push         2    50.0%   15.0             1",
    ]
    assert [line.split()[:3] for line in success_table(rows, "task", "scene").splitlines()[1:]] == [
        ["pull", "a", "1"], ["push", "a", "1"], ["push", "b", "1"],
    ]
