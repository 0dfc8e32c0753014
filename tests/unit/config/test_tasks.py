"""Task files: what is shipped, how a file is found, and that no other module knows a task by its name."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_packages import write_package
from pushing_scene import episode

import wm_nodes
from wm_nodes.apps import cli
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.tasks import (
    VARIABLE,
    get_task,
    has_simulator,
    model_tasks,
    recorded_task,
    shares_scene,
    success,
    task_names,
)
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.recording.episode_arrays import stack_episodes

FOLD = """\
from wm_nodes.config.tasks import Task

TASK = Task(instruction="fold the towel")
"""
TASKS = ("pull_cube", "push_cube", "reach")
IN_SCENES = ("move_to_aim", "pick_place", "pull", "push", "reach_object")
ALL = "all_tasks"
"""Those of the procedural scenes, and the one whose episodes are of all of them."""
NAMED_IN = {"environments/maniskill/objects.py", "judge/clip_files.py", "apps/judge_clips.py", "policy_rl/train.py"}
"""Those that share a model, two lines of clips.jsonl, an example."""


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("reach", "ea4d3fba83e312e0b7af747775e87e31129b77f07077e968a7dd4ec437a34ad4"),
        ("push_cube", "48941cf0cad1ce6ed2d75e31390bb7cc7ba7c678aaef70df89a42643a3e59e3b"),
        ("pull_cube", "75070b706a6d254ece54844ff11575b1933685732c2c6632e824718ded0e4569"),
    ],
)
def test_a_recorded_specification_of_a_shipped_task_stays_what_it_is(task: str, expected: str) -> None:
    assert simulation_spec(task, load_config("cpu", {"task": task}).simulation, 1).spec_hash == expected


def test_the_shipped_tasks_are_found_and_share_models_as_the_shipped_one_says() -> None:
    assert task_names() == tuple(sorted((*TASKS, *IN_SCENES, ALL)))
    assert model_tasks("reach") == model_tasks("push_cube") == ("reach", "push_cube")
    assert model_tasks("pull_cube") == ("pull_cube",)
    assert {model_tasks(task) for task in (*IN_SCENES, ALL)} == {IN_SCENES}


def test_tasks_in_one_scene_share_their_episodes_and_the_others_have_their_own() -> None:
    assert [recorded_task(task) for task in TASKS] == ["pull_cube", "push_cube", "push_cube"]
    assert [recorded_task(task) for task in IN_SCENES] == [*IN_SCENES]
    assert recorded_task(ALL) == ALL and shares_scene("push", ALL) and not shares_scene(ALL, "push")
    assert shares_scene("reach", "push_cube") and not shares_scene("push", "pull") and shares_scene("unheard", "push")


@pytest.mark.parametrize("task", TASKS + IN_SCENES)
def test_a_task_belongs_to_its_model_and_its_seeds_are_its_own(task: str) -> None:
    assert task in model_tasks(task) and {model_tasks(other) for other in model_tasks(task)} == {model_tasks(task)}
    numbers = [policy.number for other in model_tasks(task) for policy in get_task(other).model.weak_policies]
    assert len(numbers) == len(set(numbers)) > 0


def test_a_robots_task_is_its_instruction_and_success_is_what_was_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_package(tmp_path, "robot_tasks", fold=FOLD)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(VARIABLE, "robot_tasks")
    config = load_config("cpu", {"task": "fold"})
    assert get_task("fold").instruction == "fold the towel" and config.task == "fold"
    assert not has_simulator("fold") and shares_scene("fold", "fold") and not shares_scene("reach", "fold")
    with pytest.raises(ValueError, match="'fold' has no `simulator` in its file"):
        simulation_spec("fold", config.simulation, 1)
    with pytest.raises(ValueError, match="'fold' has no success rule"):
        success("fold", np.zeros((1, 0), np.float32))
    recorded = replace(episode(0), task="fold", success=np.arange(13) == 12)
    assert stack_episodes([recorded], ("fold",)).success[0, :, 0].tolist() == [False] * 12 + [True]


def test_a_task_is_named_by_the_path_of_its_file_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "unfold.py"
    file.write_text(FOLD.replace("fold the", "unfold the"), encoding="utf-8")
    monkeypatch.setenv(VARIABLE, f"{file}, ")
    assert "unfold" in task_names() and get_task("unfold").instruction == "unfold the towel"


def test_no_module_but_its_file_knows_a_task_by_its_name() -> None:
    root = Path(wm_nodes.__file__).parent
    named = {
        str(path.relative_to(root)) for path in root.rglob("*.py")
        if re.search(rf"[\"']({'|'.join(TASKS + IN_SCENES)})[\"']", path.read_text())
    }
    assert {name for name in named if not name.startswith("environments/maniskill/tasks/")} == NAMED_IN


def test_a_task_is_read_without_the_simulator() -> None:
    code = (
        "import sys; from wm_nodes.config.tasks import get_task, task_names; tasks = [*map(get_task, task_names())]; "
        "print({'mani_skill', 'sapien', 'mplib', 'torch'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_launch_files_list_the_tasks_of_a_further_package(tmp_path: Path) -> None:
    write_package(tmp_path, "launched_tasks", pour="")
    code = "from wm_nodes.launching.scenarios import ARGUMENTS; print({a.name: a for a in ARGUMENTS}['task'].choices)"
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, VARIABLE: "launched_tasks", "PYTHONPATH": path},
    )
    assert done.stdout == f"{('', *sorted(('pour', *TASKS, *IN_SCENES, ALL)))}\n"


def test_the_command_line_and_the_settings_name_the_known_tasks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_package(tmp_path, "listed_tasks", stir="", _parts="")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(VARIABLE, " listed_tasks, ")
    known = ", ".join(sorted((*TASKS, *IN_SCENES, ALL, "stir")))
    with pytest.raises(ConfigError, match=f"unknown task 'fly'; choose one of {known}"):
        load_config("cpu", {"task": "fly"})
    with pytest.raises(SystemExit):
        cli.main(["train-policy", "--task", "fly"])
    assert "stir" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("package", "files", "error"),
    [
        ("absent_tasks", None, r"WM_TASKS names 'absent_tasks', no package"),
        ("/absent/pour.py", None, r"WM_TASKS names '/absent/pour.py', which is no file"),
        ("empty_tasks", {"blank": "TASK = 1"}, r"blank\.py has no TASK = Task\(\.\.\.\)"),
        ("double_tasks", {"reach": ""}, r"'reach' is in wm_nodes\.environments\.maniskill\.tasks and in double_tasks"),
    ],
)
def test_a_wrong_task_file_is_one_clear_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str, files: dict[str, str] | None, error: str
) -> None:
    if files is not None:
        write_package(tmp_path, package, **files)
        monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(VARIABLE, package)
    with pytest.raises(ValueError, match=error):
        get_task(next(iter(files or ["blank"])) if package != "double_tasks" else "unheard")
