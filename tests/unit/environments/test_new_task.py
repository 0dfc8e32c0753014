"""A fourth task is one file: written to a package of its own, it is simulated, recorded and labelled."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from own_packages import own_package

from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import VARIABLE, clip_rules, get_task, model_tasks
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import planned_episode, scripted_episode
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner
from wm_nodes.environments.record import collect_plan, demonstration_plan
from wm_nodes.judge.dataset.build import LabelledClipSource
from wm_nodes.judge.dataset.edits.truth import tc_level
from wm_nodes.recording import read_episodes
from wm_nodes.world_model.tokenizer import PROBE_NAMES
from wm_nodes.world_model.training.tokenizer import probe_targets

pytestmark = pytest.mark.rendering
NUDGE = '''
"""Move the cube a centimetre, in a scene whose goal disc is small."""
from dataclasses import replace

import numpy as np

from wm_nodes.config.tasks import ClipRules, TaskRule
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
    scene=scene,
    ground_truth_names=("travel", *table_top.GROUND_TRUTH_NAMES),
    measure=measure,
    success=lambda truth: truth[..., 0] > 0.01,
    waypoints=lambda truth: push_cube.push_waypoints(truth[1:]),
    script=script,
    settings={"sft.num_demonstrations": 2, "judge.rubric": "robot_push_cube", "data.behaviours": {"expert": 1.0}},
    model_tasks=(),
    clips=ClipRules(TaskRule("object", 1e-3), behaviours={"short": 1.0}, policy_behaviours={"random": 1.0}),
)
'''


@pytest.fixture(scope="module", autouse=True)
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with own_package(tmp_path_factory.mktemp("packages"), "nudging", VARIABLE, nudge=NUDGE):
        yield
    get_task.cache_clear()


def test_its_settings_lie_over_the_presets_and_its_model_serves_it_alone() -> None:
    config = load_config("cpu", {"task": "nudge", "data.behaviours.noisy": 0.5})
    assert (config.task, config.sft.num_demonstrations, config.judge.rubric) == ("nudge", 2, "robot_push_cube")
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
    np.testing.assert_array_equal(probed[:, PROBE_NAMES.index("object_x")], episode.ground_truth[:, 1])


def test_the_judge_draws_and_labels_its_clips_by_its_own_rule() -> None:
    source = LabelledClipSource("nudge", load_config("cpu").simulation)
    clip = source.clip(1)
    source.close()
    assert clip.clip.origin.behaviour == "short" and clip.clip.instruction.startswith("nudge the ")
    assert clip.labels.tc_level == 2 and tc_level(clip.clip.states, clip_rules("push_cube").label) == 4
