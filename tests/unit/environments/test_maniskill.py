"""The simulator for real: rendering, the controller's rule, demonstrations, collection. One environment serves all."""

import dataclasses
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import READER, with_reader
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task, success, task_names
from wm_nodes.core.tool_control import check_actions, next_state
from wm_nodes.core.types import RECOVERY, TAKEN_OVER, Observation
from wm_nodes.environments.maniskill import backend
from wm_nodes.environments.maniskill.backend import NoRendererError, render_backend
from wm_nodes.environments.maniskill.behaviours import sample_style
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import EXTREME, HOLD_STEPS, planned_episode, scripted_episode
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.environments.record import (
    acceptance_plan,
    collect_plan,
    demonstration_plan,
    keep_plan,
    recovery_plan,
)
from wm_nodes.policy_rl.behaviour_cloning import demonstrations
from wm_nodes.policy_rl.initial_policy import prepare_start
from wm_nodes.recording import read_episodes

CONFIG = load_config("smoke")
SPEC = simulation_spec("push_cube", CONFIG.simulation, 2)


def truth(**values: float) -> np.ndarray:  # type: ignore[type-arg]
    return np.array([values.get(name, 0.0) for name in GROUND_TRUTH_NAMES], np.float32)


@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment("push_cube", CONFIG.simulation, num_envs=1)
    yield environment
    environment.close()


def test_the_cube_is_pushed_when_its_centre_lies_in_the_goal_disc_on_the_table() -> None:
    assert success("push_cube", truth(cube_x=0.21, cube_z=0.02, goal_x=0.3))
    assert not success("push_cube", truth(cube_x=0.19, cube_z=0.02, goal_x=0.3))
    assert not success("push_cube", truth(cube_x=0.21, cube_z=0.03, goal_x=0.3))


def test_reach_asks_for_the_tool_eight_centimetres_above_the_cube_within_two() -> None:
    assert success("reach", truth(cube_z=0.02, tool_z=0.1, tool_x=0.019))
    assert not success("reach", truth(cube_z=0.02, tool_z=0.1, tool_x=0.021))


def test_unknown_truth_is_no_success() -> None:
    assert not success("push_cube", np.full(len(GROUND_TRUTH_NAMES), np.nan, np.float32))


def test_an_unknown_task_or_behaviour_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'fly'.*push_cube"):
        get_task("fly")
    with pytest.raises(ValueError, match=r"'dance'.*near_miss"):
        sample_style("dance", np.random.default_rng(0))


def test_the_next_state_is_state_plus_scaled_action_inside_the_workspace() -> None:
    states = np.array([[0.6, 0.0, 0.1], [0.94, 0.0, 0.1]], np.float32)
    moved = next_state(states, np.array([[1, -0.5, 0], [1, 0, 0]], np.float32), SPEC)
    np.testing.assert_allclose(moved, [[0.66, -0.03, 0.1], [0.95, 0.0, 0.1]], atol=1e-6)


def test_a_state_outside_the_workspace_is_not_pulled_in_by_a_zero_action() -> None:
    outside = np.array([[0.3, 0.0, 0.1]], np.float32)
    np.testing.assert_allclose(next_state(outside, np.zeros((1, 3), np.float32), SPEC), outside)


@pytest.mark.parametrize(
    ("actions", "text"),
    [
        (np.zeros((2, 4), np.float32), r"shape \(2, 3\)"),
        (np.array([[0, np.nan, 0], [0, 0, 0]], np.float32), "finite.*nan"),
        (np.array([[0, 1.5, 0], [0, 0, 0]], np.float32), r"\[-1, 1\].*1\.5"),
    ],
)
def test_bad_actions_are_refused_by_value(actions: np.ndarray, text: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(ValueError, match=text):
        check_actions(actions, SPEC)


def test_a_device_that_cannot_render_names_the_remedy() -> None:
    with pytest.raises(NoRendererError, match=r"cuda:77.*lavapipe"):
        render_backend("cuda:77")


@pytest.mark.parametrize(("able", "chosen", "patches"), [("cuda", "cuda", 0), ("pci:0", "pci:0", 2)])
def test_only_the_software_device_needs_maniskill_patched(
    monkeypatch: pytest.MonkeyPatch, able: str, chosen: str, patches: int
) -> None:
    class Device:
        def __init__(self, name: str) -> None:
            self.name = name

        def can_render(self) -> bool:
            return self.name == able

    patched: list[str] = []
    monkeypatch.setattr(backend.sapien, "Device", Device)
    for patch in ("keep_pci_names_whole", "leave_out_reflection_table"):
        monkeypatch.setattr(backend, patch, lambda: patched.append(able))
    assert render_backend("auto") == chosen
    assert len(patched) == patches


STOCK_PICTURES = """
import sys
import numpy as np
from wm_nodes.config.load import load_config
from wm_nodes.environments.maniskill import backend
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
assert backend.shaders_without_table() is None, "the cache folder was to be one that cannot be written"
environment = ManiSkillEnvironment("push_cube", load_config("smoke").simulation)
pictures = [environment.reset(seeds=np.array([5], np.uint64)).image]
pictures += [environment.step(np.array([[0.5, -1, 0.25]], np.float32)).observation.image for _ in range(5)]
np.save(sys.argv[1], np.concatenate(pictures))
"""


@pytest.mark.slow
def test_pictures_without_the_reflection_table_are_those_of_the_installed_shaders(
    env: ManiSkillEnvironment, tmp_path: Path
) -> None:
    assert backend.shaders_without_table() is not None
    pictures = [env.reset(seeds=np.array([5], np.uint64)).image]
    pictures += [env.step(np.array([[0.5, -1, 0.25]], np.float32)).observation.image for _ in range(5)]
    stock = tmp_path / "stock.npy"
    subprocess.run(
        [sys.executable, "-c", STOCK_PICTURES, str(stock)], check=True,
        env={**os.environ, "XDG_CACHE_HOME": "/proc/nowhere"},
    )
    np.testing.assert_array_equal(np.concatenate(pictures), np.load(stock))


def test_shaders_that_are_not_the_known_ones_stay_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for pack in ("common", "minimal"):
        shutil.copytree(backend.SHADERS / pack, tmp_path / pack)
    monkeypatch.setattr(backend, "SHADERS", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = backend.shaders_without_table()
    assert made is not None and made == backend.shaders_without_table() and made.parent == tmp_path / "cache/wm_nodes"
    assert [path.name for path in made.parent.iterdir()] == [made.name]
    (made / "minimal" / "gbuffer.frag").write_text("half of it")
    assert backend.shaders_without_table() is None, "a spoiled copy was used"
    changed = tmp_path / "minimal" / "gbuffer.frag"
    changed.write_text(changed.read_text().replace("vec2(roughness, dotNV)", "vec2(dotNV, roughness)"))
    assert backend.shaders_without_table() is None
    shutil.rmtree(tmp_path / "common")
    assert backend.shaders_without_table() is None


def test_one_seed_shows_one_picture_and_steps_move_the_commanded_tool_exactly(env: ManiSkillEnvironment) -> None:
    seeds = np.array([5], np.uint64)
    first, second = env.reset(seeds=seeds), env.reset(seeds=seeds)
    assert first.image.shape == (1, 64, 128, 3) and first.image.dtype == np.uint8 and first.image.std() > 10
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.state, second.state)
    result = env.step(np.array([[0.5, -1, 0.25]], np.float32))
    np.testing.assert_allclose(result.observation.state - first.state, [[0.03, -0.06, 0.015]], atol=1e-5)
    assert (result.observation.image != first.image).any() and result.valid.all()


def test_a_refused_action_leaves_the_simulator_where_it_was(env: ManiSkillEnvironment) -> None:
    before = env.reset(seeds=np.array([6], np.uint64))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full((1, 3), np.inf, np.float32))
    np.testing.assert_array_equal(env.current().state, before.state)
    assert env.current().episode_step[0] == 0


def test_a_planned_demonstration_succeeds_and_an_ended_environment_stays_put(env: ManiSkillEnvironment) -> None:
    episode = planned_episode(env, DemonstrationPlanner(env), seed=600_000, episode_id=1)
    assert episode.terminated and episode.success[-1] and episode.rewards.sum() == 1
    result = env.step(np.ones((1, 3), np.float32))
    assert not result.valid.any() and not result.terminated.any()


def test_a_near_miss_fails_and_is_cut_by_the_step_limit(env: ManiSkillEnvironment) -> None:
    episode = scripted_episode(env, "over", seed=3, episode_id=2)
    assert not episode.success.any() and episode.truncated and not episode.terminated
    assert episode.num_steps == CONFIG.simulation.max_episode_steps


def test_extreme_actions_are_full_scale_each_held_for_some_steps_and_repeat(env: ManiSkillEnvironment) -> None:
    episode, again = (scripted_episode(env, EXTREME, seed=3, episode_id=number) for number in (2, 3))
    actions = episode.actions.reshape(-1, HOLD_STEPS, 3)
    assert (np.abs(actions) == 1).all() and (actions == actions[:, :1]).all()
    assert len({tuple(held[0]) for held in actions}) > 1
    np.testing.assert_array_equal(again.actions, episode.actions)


@pytest.mark.parametrize("hz", [0.5, 2.5, 7, 12.5])
def test_a_control_rate_that_the_simulator_cannot_keep_is_refused(hz: float) -> None:
    """Of 2.5 Hz it made 2, while the spec said 0.4 s."""
    config = CONFIG.simulation.model_copy(update={"control_hz": hz})
    with pytest.raises(ValueError, match=f"must be a whole number that divides 100, got {hz}"):
        ManiSkillEnvironment("push_cube", config)


def test_every_task_has_an_instruction_of_known_words() -> None:
    assert {get_task(name).instruction for name in task_names()} == {
        "move the gripper above the blue cube", "push the blue cube into the red target",
        "pull the blue cube into the red target", "push the object away from the robot",
        "pull the object towards the robot", "pick up the object and place it in the container",
        "move the object onto the carpet", "move the gripper above the object", "do the task with the object",
    }


def test_collection_writes_bags_and_does_not_collect_again(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"data": CONFIG.data.model_copy(update={"num_workers": 1})})
    plan = demonstration_plan(config, 2, 600_000)
    bags = collect_plan(plan, config, tmp_path)
    written = [path.stat().st_mtime_ns for path in sorted(bags[0].iterdir())]
    episodes = list(read_episodes(bags[0]))
    assert [episode.seed for episode in episodes] == [600_000, 600_001]
    assert all(episode.behaviour == "expert" and episode.success[-1] for episode in episodes)
    other = dataclasses.replace(plan, num_episodes=2)
    assert collect_plan(other, config, tmp_path) == bags
    assert [path.stat().st_mtime_ns for path in sorted(bags[0].iterdir())] == written
    with pytest.raises(ValueError, match=r"made for fewer episodes: it holds 2, and 3 are wanted; delete it"):
        collect_plan(dataclasses.replace(plan, num_episodes=3), config, tmp_path)


def standing_still(_observation: Observation, _seed: int) -> np.ndarray:  # type: ignore[type-arg]
    return np.zeros(3, np.float32)


def test_the_script_ends_what_a_policy_began_and_reaches_success(tmp_path: Path) -> None:
    config = load_config("cpu", {"task": "push_cube", "sft.recoveries": 3, "simulation.max_episode_steps": 24})
    plan = recovery_plan(config, lambda: standing_still, planned=5)
    assert plan.first_seed == demonstration_plan(config, 5).first_seed + 5 and plan.num_episodes == 6
    episodes = [episode for bag in collect_plan(plan, config, tmp_path) for episode in read_episodes(bag)]
    begun = [episode.extra[TAKEN_OVER] for episode in episodes]
    assert {episode.behaviour for episode in episodes} == {RECOVERY} and len(set(begun)) > 1
    for episode, first in zip(episodes, begun, strict=True):
        assert 1 <= first < 12 and not episode.actions[:first].any() and episode.actions[first].any()
        assert not episode.success[: first + 1].any()
    found = demonstrations(episodes, config.sft.recoveries, RECOVERY, "sft.recoveries")
    assert [episode.success[-1] for episode in found] == [True] * 3


@pytest.mark.slow
def test_a_start_with_recoveries_is_cloned_twice(tmp_path: Path) -> None:
    config = load_config("smoke", {"task": "push_cube", "sft.recoveries": 2, "data.num_workers": 1})
    model = shipped_model("push_cube")
    _, weak = prepare_start(config, tmp_path, model)
    assert weak.with_name("clone.safetensors").read_bytes() != weak.read_bytes()
    bags = sorted((tmp_path / "bags" / "recoveries").glob("shard_*"))
    assert [episode.behaviour for bag in bags for episode in read_episodes(bag)] == [RECOVERY] * 4
    with pytest.raises(ValueError, match=r"were made with sft\.recoveries 2, not 0"):
        prepare_start(config.with_values(sft=config.sft.with_values(recoveries=0)), tmp_path, model)


@pytest.mark.slow
def test_a_start_goes_on_where_its_model_was_moved_and_not_with_another_reader(tmp_path: Path) -> None:
    config = load_config("smoke", {"task": "push", "data.num_workers": 1})
    run, old, new = tmp_path / "run", tmp_path / "old", tmp_path / "new"
    shutil.copytree(shipped_model("push"), old)
    begun = prepare_start(with_reader(config, old), run, old)
    made = [path.read_bytes() for path in begun]
    keep_plan(acceptance_plan(with_reader(config, old)), tmp_path)
    old.rename(new)
    moved = with_reader(config, new)
    assert [path.read_bytes() for path in prepare_start(moved, run, new)] == made
    keep_plan(acceptance_plan(moved), tmp_path)
    demos, other = run / "bags" / "demos", tmp_path / "demos"
    of_bags = moved.with_values(sft=moved.sft.with_values(bags=[*map(str, sorted(demos.glob("shard_*")))]))
    begun = prepare_start(of_bags, tmp_path / "own", new)
    demos.rename(other)
    of_bags = moved.with_values(sft=moved.sft.with_values(bags=[*map(str, sorted(other.glob("shard_*")))]))
    assert prepare_start(of_bags, tmp_path / "own", new) == begun
    (new / READER).write_bytes(b"another one")
    with pytest.raises(ValueError, match=r"were made with simulation\.object_state sha256 .*; take another folder"):
        prepare_start(moved, run, new)
    with pytest.raises(ValueError, match="was begun with simulation"):
        keep_plan(acceptance_plan(moved), tmp_path)
