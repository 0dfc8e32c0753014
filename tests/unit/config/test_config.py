from pathlib import Path

import pytest

from wm_nodes.config.load import (
    ConfigError,
    default_judge,
    dump_config,
    load_config,
    load_video_config,
    parse_override,
    preset_names,
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


def test_a_configuration_saved_before_sections_were_renamed_comes_back_equal(tmp_path: Path) -> None:
    config = load_config("smoke", {"acceptance.num_episodes": 5, "model_refresh.num_rounds": 2})
    text = dump_config(config).replace("\nacceptance:", "\ngate:").replace("\nmodel_refresh:", "\nrounds:")
    assert "gate:\n" in text and "rounds:\n" in text
    (tmp_path / "config.yaml").write_text(text)
    assert load_config(str(tmp_path / "config.yaml")) == config


def test_a_configuration_saved_with_a_setting_that_is_gone_comes_back_without_it(tmp_path: Path) -> None:
    text = dump_config(load_config("smoke")).replace("own_starts: 128", "tolerance: 0.05")
    assert "tolerance" in text
    (tmp_path / "config.yaml").write_text(text)
    assert load_config(str(tmp_path / "config.yaml")) == load_config("smoke")


def test_a_renamed_section_is_refused_on_the_command_line_with_its_name_of_today() -> None:
    with pytest.raises(ConfigError, match="unknown setting 'gate', now called 'acceptance'"):
        load_config("smoke", {"gate.num_episodes": 5})


def test_both_loops_have_the_judge_of_one_file() -> None:
    assert load_config("base").judge == load_video_config("base").judge == default_judge()


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
        ("cpu", {"ppo.speed": 1}, r"unknown setting 'ppo\.speed'"),
        ("cpu", {"task": "fly"}, r"task.*push_cube.*'fly'"),
    ],
)
def test_a_wrong_preset_or_setting_is_one_clear_error(preset: str, overrides: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        load_config(preset, overrides)


def test_an_override_without_a_value_says_what_it_expects() -> None:
    assert parse_override("ppo.updates=3") == ("ppo.updates", 3)
    with pytest.raises(ConfigError, match=r"section\.key=value"):
        parse_override("ppo.updates")


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
