"""Every example runs by the command that it begins with."""

import importlib
import os
import re
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import examples
from examples.imagined_common import real_success
from wm_nodes.config.tasks import VARIABLE, get_task, task_names
from wm_nodes.policy_rl.gym import ID

NAMES = ("own_environment", "own_learner", "own_policy", "own_reward", "own_task")
FOLDER = Path(str(examples.__file__)).parent


def run_command(
    name: str, monkeypatch: pytest.MonkeyPatch, folder: Path, shorter: list[str] | None = None
) -> int | None:
    """Run the command of a file's docstring in this process, what it writes below `folder`. shorter: words for its
    last ones."""
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8").split('"""')[1]
    command = re.search(r"^(\w+=\S+ )?python -m .*(\n .*)*", text, re.MULTILINE)
    assert command, f"{name}.py does not begin with its command"
    words = [word.replace("/tmp", str(folder)) for word in shlex.split(command[0])]
    while "=" in words[0]:
        monkeypatch.setenv(*words.pop(0).split("=", 1))
    assert words[:2] == ["python", "-m"]
    if shorter:
        words[-len(shorter):] = shorter
    code: int | None = importlib.import_module(words[2]).main(words[3:])
    return code


@pytest.mark.parametrize("name", [name for name in NAMES if name != "own_task"])
def test_an_example_is_trained_with_by_its_command(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_command(name, monkeypatch, tmp_path)
    kind = "real" if name == "own_environment" else "imagined"
    assert len(re.findall(rf"version \d+: {kind} success \d", capsys.readouterr().out)) == 3


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ppo_from_nothing_succeeds_more_often_in_the_world_model_after_twelve_updates(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = imagined_rates("imagined_ppo", 12, monkeypatch, tmp_path, capsys)
    assert np.mean(rates[-4:]) > np.mean(rates[:4]) + 5  # points; measured 1 and 14, of 256 episodes


def test_stable_baselines_trains_in_the_world_model_by_its_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(imagined_rates("imagined_sb3", 3, monkeypatch, tmp_path, capsys)) == 3


def imagined_rates(
    name: str, updates: int, monkeypatch: pytest.MonkeyPatch, folder: Path, capsys: pytest.CaptureFixture[str]
) -> list[float]:
    """What an example prints after each of its updates, %."""
    run_command(name, monkeypatch, folder, [str(updates), "0"])
    out = capsys.readouterr().out
    assert "real success not measured" in out
    return [float(rate) for rate in re.findall(r"update \d+: imagined success ([\d.]+)%", out)]


@pytest.mark.rendering
def test_the_real_success_of_one_who_stands_still_is_zero() -> None:
    still = np.zeros(3, np.float32)
    assert real_success(lambda shown: still, 2, "reach", ("latents",)) == "real success 0 of 2 (95 %: 0% to 66%)"


def test_stable_baselines_hears_how_an_episode_ended_and_has_its_last_observation() -> None:
    from examples.imagined_sb3 import ImaginedVecEnv

    short = {"simulation.max_episode_steps": 2}
    envs = ImaginedVecEnv(gymnasium.make_vec(ID, 2, task="push_cube", settings=short))
    begun, still = envs.reset(), np.zeros((2, 3), np.float32)
    _, _, dones, infos = envs.step(still)
    assert not dones.any() and infos == [{}, {}]
    shown, _, dones, infos = envs.step(still)
    assert dones.all() and [info["TimeLimit.truncated"] for info in infos] == [True, True]
    for i, info in enumerate(infos):
        assert not info["is_success"] and (info["terminal_observation"]["image"] != shown["image"][i]).any()
        np.testing.assert_allclose(info["terminal_observation"]["state"], begun["state"][i], atol=1e-6)


def test_stable_baselines_finds_nothing_wrong_with_a_single_one() -> None:
    from stable_baselines3.common import env_checker

    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        env_checker.check_env(gymnasium.make(ID, task="push_cube"))


@pytest.mark.rendering
def test_the_own_task_is_collected_by_its_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command("own_task", monkeypatch, tmp_path) == 0
    assert "own_task" in task_names()
    assert re.search(r"own_task +expert +2 +100", capsys.readouterr().out)
    monkeypatch.delenv(VARIABLE)
    get_task.cache_clear()


def test_an_example_has_20_to_40_lines() -> None:
    sizes = {path.stem: len(path.read_text(encoding="utf-8").splitlines()) for path in FOLDER.glob("own_*.py")}
    assert sorted(sizes) == sorted(NAMES) and all(20 <= size <= 40 for size in sizes.values()), sizes


def test_the_recording_example_refuses_what_is_not_there_in_one_line(tmp_path: Path) -> None:
    words = ["-m", "examples.record", str(tmp_path / "bag"), "--task", "push_cube", "--model-dir", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, encoding="utf-8", timeout=100, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode and done.stderr.count("\n") == 1
    assert f"error: model_dir '{tmp_path}' holds no manifest.json" in done.stderr
