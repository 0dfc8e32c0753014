from pathlib import Path

import pytest

from wm_nodes.config.load import (
    ConfigError,
    dump_config,
    load_config,
    load_video_config,
    preset_names,
    split_settings,
)
from wm_nodes.config.shipped import PRETRAINED, shipped_model


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("task", ["reach", "push_cube", "pull_cube"])
def test_every_preset_resolves_for_every_task(preset: str, task: str) -> None:
    assert load_config(preset, {"task": task}).task == task


def test_the_command_line_wins_over_preset_and_task() -> None:
    assert load_config("cpu", {"task": "reach"}).sft.num_demonstrations == 9
    assert load_config("smoke", {"task": "reach"}).sft.num_demonstrations == 4
    assert load_config("smoke", {"task": "reach", "sft.num_demonstrations": 7}).sft.num_demonstrations == 7


def test_groups_of_environments_must_be_whole() -> None:
    groups = {"ppo.advantage": "group", "ppo.group_size": 7}
    with pytest.raises(ConfigError, match="num_envs 64 must be a multiple of group_size 7"):
        load_config("cpu", groups)
    assert load_config("cpu", {**groups, "ppo.num_envs": 63}).ppo.envs_per_start == 7
    assert load_config("cpu", {"ppo.group_size": 7}).ppo.envs_per_start == 1


def test_a_saved_configuration_comes_back_equal(tmp_path: Path) -> None:
    config = load_config("smoke", {"seed": 3})
    path = tmp_path / "config.yaml"
    path.write_text(dump_config(config))
    assert load_config(str(path)) == config


def test_both_loops_have_the_judge_of_one_file() -> None:
    assert load_config("base").judge == load_video_config("base").judge


def test_a_changed_copy_is_checked_like_a_preset() -> None:
    ppo = load_config("cpu").ppo
    assert ppo.with_values(epochs=7).epochs == 7 and ppo.with_values(epochs=ppo.epochs) == ppo
    with pytest.raises(ValueError, match="epochs"):
        ppo.with_values(epochs=0)
    with pytest.raises(ValueError, match="speed"):
        ppo.with_values(speed=1)


@pytest.mark.parametrize(
    ("preset", "overrides", "text"),
    [
        ("best", {}, r"unknown preset 'best'.*smoke"),
        ("cpu", {"ppo.clip": -1}, r"ppo\.clip.*greater than 0.*-1"),
        ("cpu", {"ppo.speed": 1}, r"unknown setting 'ppo\.speed'; known there: updates, num_envs"),
        ("cpu", {"ppo.updats": 1}, r"unknown setting 'ppo\.updats'; did you mean 'ppo\.updates'\?"),
        ("cpu", {"task": "fly"}, r"task.*push_cube.*'fly'"),
        ("cpu", {"data.behaviours": {"expert": 0}}, r"data\.behaviours: the shares must add up to more than 0"),
        ("cpu", {"data.behaviours": {}}, r"data\.behaviours: the shares must add up to more than 0"),
        ("cpu", {"world_model.rollout_steps": []}, r"world_model\.rollout_steps: List should have at least 1 item"),
        ("cpu", {"simulation.cameras": []}, r"simulation\.cameras: List should have at least 1 item"),
    ],
)
def test_a_wrong_preset_or_setting_is_one_clear_error(preset: str, overrides: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        load_config(preset, overrides)


def test_settings_are_taken_out_of_a_command_line_and_a_missing_value_is_named() -> None:
    words = ["bag.x", "--ppo.updates", "3", "--seed", "1", "--rewards.scenery=-10", "--reward.sparse_weight", "-1e-3"]
    rest, settings = split_settings(words)
    assert rest == ["bag.x", "--seed", "1"]
    assert settings == {"ppo.updates": 3, "rewards.scenery": -10, "reward.sparse_weight": "-1e-3"}
    assert split_settings(["--rewards", "{agent: 1}"], ["rewards"]) == ([], {"rewards": {"agent": 1}})
    with pytest.raises(ConfigError, match=r"expected a value behind --ppo\.updates"):
        split_settings(["--ppo.updates"])


def test_one_entry_of_a_free_mapping_can_be_set_and_the_mapping_replaced() -> None:
    shares = load_config("cpu").data.behaviours
    assert load_config("cpu", {"data.behaviours.expert": 0.5}).data.behaviours == {**shares, "expert": 0.5}
    assert load_config("cpu", {"data.behaviours": {"expert": 1.0}}).data.behaviours == {"expert": 1.0}


def test_a_setting_below_a_single_value_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown setting 'seed\.x'; seed is a single value"):
        load_config("cpu", {"seed.x": 1})


def test_the_shipped_model_is_found_by_task_and_its_files_are_small() -> None:
    folder = shipped_model("reach")
    assert folder == shipped_model("push_cube")
    sizes = {str(path): path.stat().st_size for path in PRETRAINED.rglob("*") if path.is_file()}
    assert len(sizes) > 7 and [path for path, size in sizes.items() if size > 5e6] == []
    with pytest.raises(FileNotFoundError, match=r"pull_cube.*--from-scratch"):
        shipped_model("pull_cube")
