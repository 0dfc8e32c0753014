"""One policy for all tasks of the procedural scenes: each episode is of one, and the state says of which."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import make_model_folder

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task, part_of, success
from wm_nodes.core.tool_control import hold_actions, next_state
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import planned_or_scripted_episode
from wm_nodes.environments.maniskill.objects import MODEL_TASKS
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.policy_rl.factories import make_imagined_environment, make_policy, models_of
from wm_nodes.policy_rl.initial_policy import STARTS, write_starts
from wm_nodes.policy_rl.pretraining import load_arrays
from wm_nodes.policy_rl.rollouts import collect_rollout
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.reward import EndogenousReward
from wm_nodes.world_model import DeviceEnvironment, load_start_instructions, load_starts
from wm_nodes.world_model.dynamics import done_signal
from wm_nodes.world_model.validation.acceptance import accept_world_model

TASK = "all_tasks"
CONFIG = load_config("cpu", {"task": TASK, "policy.inputs": "both"})
SPEC = simulation_spec(TASK, CONFIG.simulation, 1)
SEEDS = {task: next(seed for seed in range(100) if part_of(TASK, seed) == task) for task in MODEL_TASKS}


@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment(TASK, CONFIG.simulation)
    yield environment
    environment.close()


def code_of(task: str) -> list[float]:
    return [float(task == one) for one in MODEL_TASKS]


def test_seeds_share_out_the_tasks_evenly_and_for_good() -> None:
    counts = Counter(part_of(TASK, seed) for seed in range(1_000_000, 1_001_000))
    assert set(counts) == set(MODEL_TASKS)
    assert min(counts.values()) > 150
    assert [part_of(TASK, seed) for seed in range(3)] == ["push", "move_to_aim", "reach_object"]
    assert part_of("push", 3) == "push"


@pytest.mark.parametrize("task", MODEL_TASKS)
def test_an_episode_goes_as_one_of_its_task_and_says_which_it_is(env: ManiSkillEnvironment, task: str) -> None:
    seed = SEEDS[task]
    episode = planned_or_scripted_episode(env, DemonstrationPlanner(env), "expert", seed, 0)
    alone = ManiSkillEnvironment(task, CONFIG.simulation)
    same = planned_or_scripted_episode(alone, DemonstrationPlanner(alone), "expert", seed, 0)
    alone.close()
    np.testing.assert_array_equal(episode.images, same.images)
    np.testing.assert_array_equal(episode.states[:, : SPEC.tool_dim], same.states)
    np.testing.assert_array_equal(episode.states[:, SPEC.tool_dim :], [code_of(task)] * (episode.num_steps + 1))
    np.testing.assert_array_equal(episode.ground_truth[:, :-1], same.ground_truth)
    np.testing.assert_array_equal(episode.success, same.success)
    assert episode.success[-1]
    assert episode.instruction == same.instruction
    arrays = stack_episodes([episode], MODEL_TASKS)
    assert arrays.recorded_tasks == (task,)
    assert arrays.states.shape[-1] == SPEC.tool_dim
    assert arrays.labelled.tolist() == [[task == one for one in MODEL_TASKS]]
    np.testing.assert_array_equal(arrays.success[0, : episode.num_steps + 1, MODEL_TASKS.index(task)], same.success)


def test_success_is_that_of_the_episodes_task_alone() -> None:
    pushed = np.zeros((len(MODEL_TASKS), len(get_task(TASK).ground_truth_names)), np.float32)
    pushed[:, 0] = 0.12
    pushed[:, -1] = np.arange(len(MODEL_TASKS))
    assert success(TASK, pushed).tolist() == [task == "push" for task in MODEL_TASKS]


def test_an_action_moves_the_tool_and_keeps_the_task() -> None:
    states = np.array([[0.6, 0, 0.1, 0, 0, 0, 1, *code_of(task)] for task in MODEL_TASKS], np.float32)
    actions = np.random.default_rng(0).uniform(-1, 1, (len(states), 7)).astype(np.float32)
    moved = next_state(states, actions, SPEC)
    alone = next_state(states[:, : SPEC.tool_dim], actions, simulation_spec("push", CONFIG.simulation, 1))
    np.testing.assert_array_equal(moved[:, : SPEC.tool_dim], alone)
    np.testing.assert_array_equal(moved[:, SPEC.tool_dim :], states[:, SPEC.tool_dim :])
    np.testing.assert_array_equal(next_state(states, hold_actions(states, SPEC), SPEC), states)


def test_the_shipped_starts_of_each_task_begin_an_imagined_episode_of_it() -> None:
    path = shipped_model(TASK) / STARTS
    _, states = load_starts(path, TASK)
    told = load_start_instructions(path, SPEC)
    for task, word in (("push", "push"), ("pull", "pull"), ("reach_object", "above"), ("pick_place", "place")):
        rows = (states[:, -len(MODEL_TASKS) :] == code_of(task)).all(1)
        assert rows.sum() >= 8
        assert all(word in text for text, chosen in zip(told, rows, strict=True) if chosen)


@pytest.fixture(scope="module")
def imagined(env: ManiSkillEnvironment, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An untrained model of the tasks and starts of each, recorded by the simulator."""
    folder = tmp_path_factory.mktemp("imagined")
    small = {"tokenizer.width": 16, "tokenizer.depth": 1, "world_model.width": 24, "world_model.depth": 1,
             "world_model.num_heads": 2, "world_model.condition_map": 8}
    model = make_model_folder(folder / "model", load_config("cpu", {"task": "push", **small}))
    with EpisodeBagWriter(folder / "bag", env.spec, run_id="test") as writer:
        for number, task in enumerate(MODEL_TASKS):
            planner = DemonstrationPlanner(env)
            episode = planned_or_scripted_episode(env, planner, "expert", SEEDS[task], number)
            writer.write(replace(episode, ground_truth=episode.ground_truth.astype(np.float32)))
    write_starts([folder / "bag"], folder / STARTS)
    return model, folder / STARTS


def test_each_imagined_episode_ends_by_the_done_signal_of_its_task(imagined: tuple[Path, Path]) -> None:
    folder, starts = imagined
    config = CONFIG.with_values(reward=CONFIG.reward.with_values(success_threshold=1.0))
    env = make_imagined_environment(config, folder, starts, num_envs=8, seed=0)
    signals = list[torch.Tensor]()
    model = env.episodes.imagined[0].model
    advance = model.advance

    def spy(*arguments: object) -> tuple[torch.Tensor, torch.Tensor]:
        latents, logits = advance(*arguments)  # type: ignore[arg-type]
        signals.append(done_signal(logits)[0])
        return latents, logits

    model.advance = spy  # type: ignore[method-assign, assignment]
    observation = env.reset(None, np.arange(8, dtype=np.uint64))
    tasks = observation.state[:, SPEC.tool_dim :].argmax(1)
    assert len(set(tasks.tolist())) > 2
    step = env.step(np.zeros((8, 7), np.float32))
    (signal,) = signals
    np.testing.assert_array_equal(step.success_probability, signal.numpy()[np.arange(8), tasks])
    np.testing.assert_array_equal(step.observation.state[:, SPEC.tool_dim :], observation.state[:, SPEC.tool_dim :])


def test_the_device_program_imagines_the_same(imagined: tuple[Path, Path]) -> None:
    model, starts = imagined
    env = make_imagined_environment(CONFIG, model, starts, num_envs=4, seed=0)
    device = DeviceEnvironment.beside(env)
    seen = env.reset(None, np.arange(4, dtype=np.uint64))
    device.reset(torch.ones(4, dtype=torch.bool), env.episodes.starts_N)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 7)).astype(np.float32)
    seen, on_device = env.step(actions), device.step(torch.from_numpy(actions))
    np.testing.assert_array_equal(device.frames_NHWC.numpy(), seen.observation.image)
    np.testing.assert_array_equal(device.states_NP.numpy(), seen.observation.state)
    np.testing.assert_array_equal(on_device.signal_N.numpy(), seen.success_probability)


def test_the_model_is_accepted_by_its_done_signals_of_all_tasks(imagined: tuple[Path, Path]) -> None:
    model, starts = imagined
    heldout = load_arrays([starts.parent / "bag"], CONFIG)
    report = accept_world_model(models_of(model), heldout, CONFIG)
    names = [criterion.name for criterion in report.criteria]
    assert [name for name in names if "done" in name] == [
        f"done {kind} on rollouts, mean of the tasks" for kind in ("precision", "recall")
    ]
    assert not report.passed


def test_a_policy_sees_which_task_it_is(imagined: tuple[Path, Path]) -> None:
    model, starts = imagined
    policy = make_policy(CONFIG, model)
    assert policy.state_dim == SPEC.tool_dim + len(MODEL_TASKS)
    torch.nn.init.constant_(policy.actor.output.weight, 0.01)
    image = load_starts(starts)[0][:1].repeat(2, 0)
    states = np.array([[0.6, 0, 0.1, 0, 0, 0, 1, *code_of(task)] for task in ("push", "pull")], np.float32)
    first, second = policy.act(image, states).actions
    assert np.abs(first - second).max() > 1e-3
    env = make_imagined_environment(CONFIG, model, starts, num_envs=4, seed=0)
    reward = EndogenousReward(CONFIG.reward, lambda a, b: np.zeros(len(a), np.float32))  # type: ignore[arg-type]
    rollout = collect_rollout(env, policy, reward, 3, 0, 1)
    assert rollout.states_TN.shape == (3, 4, policy.state_dim)
    assert models_of(model).tasks == MODEL_TASKS
