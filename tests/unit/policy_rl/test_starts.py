"""What imagined episodes begin at: frames, states and instructions of recorded episodes, first or mid-episode ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import make_episode, make_spec
from safetensors.torch import load_file, save_file

from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES, TOOL, above_cube
from wm_nodes.environments.record import collect_plan
from wm_nodes.policy_rl.factories import make_device_environment, make_imagined_environment
from wm_nodes.policy_rl.initial_policy import STARTS, frames_before_success, starts_plan, write_starts
from wm_nodes.recording import EpisodeBagWriter, read_episodes
from wm_nodes.world_model import DeviceEnvironment, load_start_instructions, load_starts

OWN = "push the red cube forward"
MODEL = shipped_model("push_cube")


def recorded(index: int, first_success: int | None, spec: EnvironmentSpec) -> Episode:
    """Nine steps of noise, the frames from `first_success` on a success."""
    made = make_episode(spec, index, steps=9, instruction=f"{OWN} {index}")
    done = np.arange(10) >= (10 if first_success is None else first_success)
    return replace(made, success=done)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    spec = make_spec()
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test") as writer:
        for index in range(12):
            writer.write(recorded(index, (5, None, 1)[index % 3], spec))
    return tmp_path / "bag"


def frames_of(bag: Path, starts: Path) -> list[int]:
    """The number of the frame at which each start's episode is entered."""
    images, states = load_starts(starts)
    numbers = []
    for episode, image, state in zip(read_episodes(bag), images, states, strict=True):
        (number,) = np.flatnonzero((episode.images == image).all((1, 2, 3)))
        np.testing.assert_array_equal(episode.states[number], state)
        numbers.append(int(number))
    return numbers


def test_first_frames_are_written_with_their_own_instructions(bag: Path, tmp_path: Path) -> None:
    assert write_starts([bag], tmp_path / STARTS, limit=4) == 4
    images, states = load_starts(tmp_path / STARTS)
    episodes = list(read_episodes(bag))[:4]
    np.testing.assert_array_equal(images, [episode.images[0] for episode in episodes])
    np.testing.assert_array_equal(states, [episode.states[0] for episode in episodes])
    spec = make_spec(instruction="push it")
    assert load_start_instructions(tmp_path / STARTS, spec) == [f"{OWN} {i}" for i in range(4)]
    assert load_start_instructions(tmp_path / STARTS, replace(spec, task="reach")) == ["push it"] * 4


def test_any_frame_is_one_before_success_which_the_seed_decides(bag: Path, tmp_path: Path) -> None:
    found = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_starts([bag], tmp_path / name, frames="any", seed=seed)
        found.append(frames_of(bag, tmp_path / name))
    assert found[0] == found[1] != found[2]
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    numbers = np.array(found)
    assert numbers[:, ::3].max() <= 4 and not numbers[:, 2::3].any()  # success at frame 5, and at frame 1
    assert len(set(numbers[:, ::3].flat)) > 2 and numbers[:, 1::3].max() > 4


def test_an_episode_that_begins_done_is_no_start(tmp_path: Path) -> None:
    spec = make_spec()
    for name, begins in (("some", (5, 0, None)), ("none", (0, 0))):
        with EpisodeBagWriter(tmp_path / name, spec, run_id="test") as writer:
            for index, first in enumerate(begins):
                writer.write(recorded(index, first, spec))
    assert write_starts([tmp_path / "some"], tmp_path / STARTS) == 2
    with pytest.raises(ValueError, match="no episode to start from whose first frame is not a success already"):
        write_starts([tmp_path / "none"], tmp_path / STARTS)


def test_a_start_for_several_tasks_is_before_success_in_all_of_them() -> None:
    spec = make_spec()
    truth = np.zeros((10, len(GROUND_TRUTH_NAMES)), np.float32)
    truth[:, TOOL] = 0.5
    truth[3, TOOL] = above_cube(truth)[3]
    episode = replace(recorded(0, 6, spec), ground_truth=truth)
    assert frames_before_success(episode) == 6
    assert frames_before_success(episode, ("reach", "push_cube")) == 3
    assert frames_before_success(recorded(0, 0, spec)) == 1
    assert frames_before_success(recorded(0, None, spec)) == 10


def test_a_starts_file_of_an_older_version_has_the_instruction_of_the_spec(tmp_path: Path) -> None:
    assert set(load_file(MODEL / STARTS)) == {"images", "states"}
    spec = make_spec(instruction="push it")
    assert load_start_instructions(MODEL / STARTS, spec) == ["push it"] * len(load_starts(MODEL / STARTS)[0])


def test_starts_with_fewer_instructions_are_refused(bag: Path, tmp_path: Path) -> None:
    write_starts([bag], tmp_path / STARTS, limit=4)
    tensors = load_file(tmp_path / STARTS)
    save_file(tensors | {name: tensors[name][:3] for name in ("images", "states")}, tmp_path / STARTS)
    with pytest.raises(ValueError, match="has 4 instructions for 3 starts; delete it to have it written again"):
        load_start_instructions(tmp_path / STARTS, make_spec())


def test_goals_are_those_of_each_starts_instruction_in_both_forms_of_the_environment(tmp_path: Path) -> None:
    """The shipped model's words, for the task push_cube: of the second start the instruction says to reach."""
    config = load_config("cpu", {
        "task": "push_cube", "reward.dense_weight": 1.0, "simulation.max_episode_steps": 5,
    })
    spec = simulation_spec("push_cube", config.simulation, 1)
    images, states = (array[[0, 0]] for array in load_starts(MODEL / STARTS))
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test") as writer:
        for index, text in enumerate((spec.instruction, "move the gripper above the blue cube")):
            made = make_episode(spec, index, steps=1, instruction=text, success=np.zeros(2, bool))
            made.images[0], made.states[0] = images[index], states[index]
            writer.write(made)
    write_starts([tmp_path / "bag"], tmp_path / STARTS)
    env = make_imagined_environment(config, MODEL, tmp_path / STARTS, num_envs=8, seed=0)
    env.reset(seeds=np.arange(8, dtype=np.uint64))
    goals = env.goals()
    of_starts = make_device_environment(config, MODEL, tmp_path / STARTS, num_envs=2).goals()
    beside, starts = DeviceEnvironment.beside(env).goals(), env.episodes.starts_N.numpy()
    assert goals is not None and of_starts is not None and beside is not None
    assert of_starts[0].tobytes() == beside[0].tobytes() and len(np.unique(starts)) == 2
    np.testing.assert_array_equal(goals[0], of_starts[0][starts])
    assert np.abs(of_starts[0][0].astype(int) - of_starts[0][1]).max() > 50


def test_an_instruction_that_the_model_never_saw_is_one_clear_error(bag: Path, tmp_path: Path) -> None:
    write_starts([bag], tmp_path / STARTS, limit=2)
    tensors = load_file(tmp_path / STARTS)
    size = {name: tensor[:2] for name, tensor in load_file(MODEL / STARTS).items()}
    save_file(tensors | size, tmp_path / STARTS)
    config = load_config("cpu", {"task": "push_cube", "reward.dense_weight": 1.0})
    with pytest.raises(ValueError, match=f"^instruction '{OWN} 0': unknown words forward, 0; this model knows"):
        make_imagined_environment(config, MODEL, tmp_path / STARTS, num_envs=2, seed=0)


def test_pictures_are_noisy_in_training_alone_and_a_second_model_is_always_asked() -> None:
    section = "imagined_environment."
    config = load_config("cpu", {f"{section}picture_noise": 0.1, f"{section}second_model": str(MODEL)})
    trained, measured = (
        make_imagined_environment(config, MODEL, MODEL / STARTS, num_envs=2, seed=0, training=training)
        for training in (True, False)
    )
    assert (trained.picture_noise, measured.picture_noise) == (0.1, 0)
    assert len(trained.episodes.imagined) == len(measured.episodes.imagined) == 2
    wrong = load_config("cpu", {f"{section}second_model": "nowhere"})
    with pytest.raises(ModelFolderError, match="nowhere"):
        make_imagined_environment(wrong, MODEL, MODEL / STARTS, num_envs=2, seed=0)


def test_an_episode_that_starts_in_the_middle_has_the_whole_step_limit(tmp_path: Path) -> None:
    config = load_config("cpu", {"task": "push_cube", "simulation.max_episode_steps": 4})
    spec = simulation_spec("push_cube", config.simulation, 1)
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test") as writer:
        writer.write(replace(make_episode(spec, 0, steps=4), success=np.zeros(5, bool)))
    write_starts([tmp_path / "bag"], tmp_path / STARTS, frames="any", seed=1)
    assert frames_of(tmp_path / "bag", tmp_path / STARTS)[0] > 0
    config = config.with_values(reward=config.reward.with_values(success_threshold=1.0))
    env = make_imagined_environment(config, MODEL, tmp_path / STARTS, num_envs=1, seed=0)
    assert env.reset().episode_step.tolist() == [0]
    ends = [bool(env.step(np.zeros((1, 3), np.float32)).truncated[0]) for _ in range(4)]
    assert ends == [False, False, False, True]


def test_whole_episodes_of_the_task_are_collected_where_any_frame_may_be_a_start() -> None:
    first, any_frame = (
        starts_plan(load_config("cpu", {"task": "reach", "data.start_frames": frames})) for frames in ("first", "any")
    )
    assert (first.simulation.max_episode_steps, any_frame.simulation.max_episode_steps) == (1, 16)
    assert first.task == any_frame.task == "reach" and first.first_seed == any_frame.first_seed == 700_000
    assert first.num_episodes == any_frame.num_episodes
    with pytest.raises(ConfigError, match="start_frames"):
        load_config("cpu", {"data.start_frames": "last"})


@pytest.mark.slow
@pytest.mark.rendering
def test_starts_in_the_middle_of_the_simulators_episodes_are_imagined_from(tmp_path: Path) -> None:
    config = load_config("smoke", {"data.start_frames": "any", "evaluation.episodes": 1, "task": "push_cube"})
    bags = collect_plan(starts_plan(config), config, tmp_path / "bags")
    assert write_starts(bags, tmp_path / STARTS, frames="any") == 8
    episodes = [episode for bag in bags for episode in read_episodes(bag)]
    states = load_starts(tmp_path / STARTS)[1]
    assert sum(not np.array_equal(e.states[0], state) for e, state in zip(episodes, states, strict=True)) > 3
    spec = simulation_spec("push_cube", config.simulation, 1)
    assert load_start_instructions(tmp_path / STARTS, spec) == [spec.instruction] * 8
    assert {episode.num_steps for episode in episodes} != {1}
