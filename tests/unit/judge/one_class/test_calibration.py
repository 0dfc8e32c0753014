"""Calibration on a bag, by the command, and its parts: which task is done when, and changes that nobody minds."""

import functools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_samples import make_episode
from safetensors.numpy import load_file

from wm_nodes.apps import cli
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import Episode
from wm_nodes.judge.backends.one_class import ranges_of, unfit_reason
from wm_nodes.judge.one_class import ranges as ranges_module
from wm_nodes.judge.one_class.calibration import calibrate, done_at, harmless, words_of
from wm_nodes.judge.one_class.ranges import NAMES, file_of, load_ranges
from wm_nodes.recording.writer import EpisodeBagWriter
from wm_nodes.world_model import WorldModels, load_model_folder
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.validation.open_loop import imagine

FOLDER = shipped_model("push_cube")
STEPS, EPISODES = 6, 6


@functools.cache
def models() -> WorldModels:
    return load_model_folder(FOLDER)


@functools.cache
def episodes() -> list[Episode]:
    """As if recorded: what the world model imagines from the shipped first pictures after random actions."""
    starts, spec = load_file(FOLDER / "starts.safetensors"), models().spec
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.uniform(-1, 1, (EPISODES, 1, spec.action_dim)), STEPS, 1).astype(np.float32)
    moved = np.cumsum(actions[..., :3] * models().spec.action_scale[0], 1)
    first = starts["states"][:EPISODES]
    states = np.repeat(first[:, None], STEPS + 1, 1).astype(np.float32)
    states[:, 1:, :3] += moved
    told = imagine(models().tokenizer, models().action, starts["images"][:EPISODES], actions, states)
    frames = np.concatenate([starts["images"][:EPISODES, None], told.frames], 1)
    success = np.arange(STEPS + 1) == STEPS
    return [
        make_episode(
            spec, i, STEPS, images=frames[i], actions=actions[i], states=states[i],
            success=success & (i % 2 == 0), terminated=i % 2 == 0, truncated=i % 2 == 1,
        )
        for i in range(EPISODES)
    ]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranges_module, "LEAST", 4)


def test_the_command_makes_a_judge_of_a_world_model(
    few: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "model"
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("normal_ranges_*", "video_model*"))
    spec = models().spec
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="recordings", start_ns=1) as bag:
        for episode in episodes():
            bag.write(episode)
    assert cli.main(["judge", "calibrate", str(folder), str(tmp_path / "bag"), "--stride", "2"]) in (0, None)
    printed = capsys.readouterr().out
    assert f"{file_of(folder, 2)}: {EPISODES} recordings, {len(NAMES)} numbers; 3 to 8 frames" in printed
    made = load_ranges(folder, 2)
    assert made.world_model == models().sha256 and "push_cube" in made.done
    assert made.story["recordings"] == EPISODES and made.story["clips"] == 4 * EPISODES
    assert "judge calibrate" in made.story["command"]
    manifest = read_world_manifest(folder)
    assert unfit_reason(ranges_of(folder, manifest), manifest, (4, 64, 128, 3)) == ""


@pytest.mark.slow
def test_equal_seeds_give_equal_ranges(few: None) -> None:
    first, again = (calibrate(models(), episodes(), stride=1, seed=0) for _ in range(2))
    assert first == again and first.words == (
        "above blue", "blue cube", "cube into", "gripper above", "into red", "move gripper", "push blue", "red target",
    ), "of the recordings, and of the model's tasks"
    assert first.spread["start"] > 0.05, "harmless changes start with another picture than the reference"


@pytest.mark.slow
def test_state_values_that_say_which_task_an_episode_is_of_change_nothing(few: None) -> None:
    coded = [
        replace(episode, states=np.pad(episode.states, ((0, 0), (0, 2)), constant_values=1)) for episode in episodes()
    ]
    assert calibrate(models(), coded, stride=1, seed=0) == calibrate(models(), episodes(), stride=1, seed=0)


@pytest.mark.slow
def test_cameras_that_move_are_named_and_the_others_stand_still(few: None) -> None:
    assert models().spec.cameras == ("side", "wrist")
    assert calibrate(models(), episodes(), stride=1, seed=0).still == (True, False)
    assert calibrate(models(), episodes(), stride=1, seed=0, moving=()).still == (True, True)


def test_too_few_too_short_or_too_small_recordings_are_refused() -> None:
    with pytest.raises(ValueError, match=r"at least 100 recordings, got 2; name more bags"):
        calibrate(models(), episodes()[:2], stride=1, seed=0)
    with pytest.raises(ValueError, match="no episode that is long enough"):
        calibrate(models(), episodes(), stride=STEPS, seed=0)
    small = replace(episodes()[0], images=episodes()[0].images[:, :32])
    with pytest.raises(ValueError, match="pictures of 32 x 128 px, the world model sees 64 x 128 px"):
        calibrate(models(), [small], stride=1, seed=0)
    narrow = replace(episodes()[0], states=episodes()[0].states[:, :2])
    with pytest.raises(ValueError, match=r"states of 2 values, the world model knows 3 \(tool_target_x, .*wm collect"):
        calibrate(models(), [narrow], stride=1, seed=0)


@pytest.mark.parametrize("lacks", [{"probe": None}, {"tasks": ("pour tea",)}], ids=["probe", "positions"])
def test_a_model_that_reads_no_places_is_refused_with_what_helps(lacks: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"where tool and object are, and that of .* does not: .*--judge URL"):
        calibrate(replace(models(), **lacks), episodes()[:2], stride=1, seed=0)


def test_a_task_counts_as_done_by_its_own_rule_in_recordings_of_its_scene() -> None:
    episode = episodes()[0]
    assert set(done_at(("reach", "push_cube"), episode, STEPS)) == {"reach", "push_cube"}
    assert done_at(("push_cube",), episode, STEPS) == {"push_cube": True}
    assert done_at(("push_cube",), episode, 0) == {"push_cube": False}
    foreign = replace(episode, task="fold_towel")
    assert done_at(("push_cube",), foreign, STEPS) == {}
    assert done_at(("fold_towel",), foreign, STEPS) == {"fold_towel": True}, "a task file that is not here: as recorded"


def test_harmless_changes_are_small_and_keep_the_size() -> None:
    frames = episodes()[0].images
    lengths = set()
    for seed in range(40):
        changed = harmless(frames, numpy_stream(seed, "test"))
        lengths.add(len(changed))
        assert changed.dtype == np.uint8 and changed.shape[1:] == frames.shape[1:]
        assert np.abs(changed[0].astype(int) - frames[0]).mean() < 40
    assert lengths == {STEPS, STEPS + 1, STEPS + 2}


def test_words_are_compared_without_case_articles_and_punctuation() -> None:
    assert words_of("Push the blue cube, into a RED target.") == ["push", "blue", "cube", "into", "red", "target"]
