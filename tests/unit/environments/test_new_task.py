"""A further task is one file: written to a package of its own, it is simulated, recorded and judged."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from model_folders import spec_of
from own_packages import own_package

from wm_nodes.config.load import load_config
from wm_nodes.config.seed_ranges import MODEL_EPISODES
from wm_nodes.config.tasks import VARIABLE, get_task, model_tasks
from wm_nodes.core.types import UInt8Array
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import planned_episode, scripted_episode
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.record import collect_plan, demonstration_plan, scripted_plan
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.one_class import ranges
from wm_nodes.judge.one_class.calibration import calibrate
from wm_nodes.judge.one_class.ranges import save_ranges
from wm_nodes.recording import read_episodes
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.recording.reader import read_spec
from wm_nodes.world_model import load_model_folder, save_model_folder
from wm_nodes.world_model.positions import columns_of, probe_targets
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.training.position_probe import train_position_probe
from wm_nodes.world_model.training.tokenizer import train_tokenizer

RECORDINGS = 16
pytestmark = pytest.mark.rendering
NUDGE = '''
"""Move the cube a centimetre, in a scene whose goal disc is small."""
from dataclasses import replace

import numpy as np

from wm_nodes.config.tasks import ModelPart, SimulatorPart
from wm_nodes.environments.maniskill import table_top
from wm_nodes.environments.maniskill.tasks import push_cube


def scene():
    from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

    class NudgeEnv(PushCubeEnv):
        goal_radius = 0.05

    return NudgeEnv


def measure(scene, start):
    truth = table_top.measure(scene, None if start is None else start[1:])
    return np.append(np.float32(np.linalg.norm(truth[:2] - truth[table_top.CUBE_START])), truth)


def script(behaviour, truth, rng, max_action_m):
    act = push_cube.script(behaviour, truth[1:], rng, max_action_m)
    return lambda truth, state: act(truth[1:], state)


TASK = replace(
    push_cube.TASK,
    instruction="nudge the blue cube",
    ground_truth_names=("travel", *table_top.GROUND_TRUTH_NAMES),
    success=lambda truth: truth[..., 0] > 0.01,
    settings={"sft.num_demonstrations": 2, "judge.rubric": "robot_no_physics", "data.behaviours": {"expert": 1.0}},
    simulator=SimulatorPart(scene, measure, lambda truth: push_cube.push_waypoints(truth[1:]), script),
    model=ModelPart(positions=table_top.POSITIONS),
)
'''


@pytest.fixture(scope="module", autouse=True)
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with own_package(tmp_path_factory.mktemp("packages"), "nudging", VARIABLE, nudge=NUDGE):
        yield
    get_task.cache_clear()


def test_its_settings_lie_over_the_presets_and_its_model_serves_it_alone() -> None:
    config = load_config("cpu", {"task": "nudge", "data.behaviours.noisy": 0.5})
    assert (config.task, config.sft.num_demonstrations, config.judge.rubric) == ("nudge", 2, "robot_no_physics")
    assert config.data.behaviours == {"expert": 1.0, "noisy": 0.5}
    assert load_config("cpu", {"task": "nudge"}).data.behaviours == {"expert": 1.0}, "the file's own value changed"
    assert model_tasks("nudge") == ("nudge",)


def test_it_is_simulated_demonstrated_and_scripted_in_a_scene_of_its_own() -> None:
    env = ManiSkillEnvironment("nudge", load_config("smoke", {"task": "nudge"}).simulation)
    assert env.spec.instruction == "nudge the blue cube" and env.spec.env_id == "maniskill/nudge"
    assert env.spec.ground_truth_names[:2] == ("travel", "cube_x") and env.scene.goal_radius == 0.05
    planned = planned_episode(env, DemonstrationPlanner(env), seed=600_000, episode_id=1)
    scripted = scripted_episode(env, "expert", seed=3, episode_id=2)
    env.close()
    for episode in (planned, scripted):
        assert episode.success[-1] and not episode.success[0] and episode.terminated
        assert episode.ground_truth.shape[1] == 12 and episode.ground_truth[0, 0] == 0
        assert episode.ground_truth[-1, 0] > 0.01


def test_its_demonstrations_are_recorded_and_what_a_world_model_probes_is_found_by_name(tmp_path: Path) -> None:
    config = load_config("smoke", {"task": "nudge", "data.num_workers": 1})
    bags = collect_plan(demonstration_plan(config, 1, 600_000), config, tmp_path)
    (episode,) = read_episodes(bags[0])
    assert (episode.task, episode.instruction, episode.behaviour) == ("nudge", "nudge the blue cube", "expert")
    assert episode.success[-1] and episode.ground_truth.shape[1] == 12
    probed = probe_targets(episode.ground_truth, "nudge")
    np.testing.assert_array_equal(probed[:, columns_of("nudge", "object")[0]], episode.ground_truth[:, 1])


@pytest.mark.slow
def test_a_judge_of_its_recordings_decides_whether_it_is_done_and_refuses_what_they_never_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranges, "LEAST", RECORDINGS)
    small = {
        "task": "nudge", "data.behaviours": {"expert": 0.5, "random": 0.5}, "tokenizer.num_iterations": 40,
        "tokenizer.probe_iterations": 60, "world_model.num_iterations": 15, "world_model.rollout_steps": [3],
    }
    config = load_config("smoke", small)
    bags = collect_plan(scripted_plan(config, RECORDINGS, MODEL_EPISODES), config, tmp_path / "bags")
    recorded = [episode for bag in bags for episode in read_episodes(bag)]
    episodes = stack_episodes(recorded, ("nudge",))
    tokenizer, _ = train_tokenizer(episodes, config, 0, None)
    action, _ = train_action_model(tokenizer, episodes, config, 0, None)
    probe, _ = train_position_probe(episodes, config, 0, None)
    folder = tmp_path / "model"
    save_model_folder(
        folder, tokenizer, action, None, config, spec=spec_of(config, tokenizer), tasks=("nudge",), story={"made": {}},
        probe=probe,
    )
    save_ranges(folder, calibrate(load_model_folder(folder), recorded, stride=1, seed=0))

    def judged(frames: UInt8Array) -> Verdict:
        episode = max(recorded, key=lambda episode: episode.success[-1])
        task = TaskSpec(episode.instruction, "nudge", "panda", episode.images[0], actions=episode.actions)
        agent = RewardAgent(OneClassJudge(folder), load_rubric("robot_no_physics"), mode="benchmark")
        return asyncio.run(agent.evaluate(clip_ref("clip", frames, 1 / recorded_s), task))

    recorded_s = read_spec(bags[0]).control_period_s
    shown = max(recorded, key=lambda episode: episode.success[-1]).images
    clean, grey = judged(shown), judged(np.concatenate([shown[:4], shown[4:] // 3]))
    assert clean.valid and grey.valid, (clean.reason, grey.reason)
    names = {score.component: score for stage in clean.stages for score in stage.components}
    assert names["task_completion"].status is Status.OK
    assert accepts(grey) is False and grey.reward <= clean.reward
