"""The procedural scenes and their tasks in the simulator: control, repetition, pictures, rules, scripts."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from transforms3d.quaternions import mat2quat, qinverse, qmult, quat2axangle

from wm_nodes.config.environments import TRUTH
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import READER
from wm_nodes.config.scenes import SCENES, scene_of
from wm_nodes.config.seed_ranges import HELDOUT, MODEL_EPISODES
from wm_nodes.config.tasks import get_task, simulator_part, success
from wm_nodes.core.rotations import multiply, to_quaternion
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.tool_control import hold_actions, next_state
from wm_nodes.core.types import TAKEN_OVER, FloatArray, Observation
from wm_nodes.environments.maniskill.behaviours import ROBOT_BASE
from wm_nodes.environments.maniskill.control import DOWN
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.episodes import SCATTERED, recovered_episode, scripted_episode
from wm_nodes.environments.maniskill.layouts import ANYWHERE
from wm_nodes.environments.maniskill.objects import (
    BOTTOM,
    CONTAINER,
    GRASPED,
    GROUND_TRUTH_NAMES,
    OBJECT,
    ON_TABLE_M,
    OPENING,
    STARTS,
    STATE,
)
from wm_nodes.environments.maniskill.table_top import TOOL
from wm_nodes.environments.object_reader import ObjectReader
from wm_nodes.environments.registry import configured_spec
from wm_nodes.training.weights import save_weights

TASKS = ("push", "pull", "pick_place", "move_to_aim", "reach_object")
CONFIG = load_config("cpu", {"task": "pick_place"})


@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment("pick_place", CONFIG.simulation, end_on_success=False)
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def blind() -> Iterator[ManiSkillEnvironment]:
    environment = ManiSkillEnvironment("push", CONFIG.simulation, pictures=False, end_on_success=False)
    yield environment
    environment.close()


def start(env: ManiSkillEnvironment, seed: int) -> None:
    env.reset(seeds=np.array([seed], np.uint64))


def hold(env: ManiSkillEnvironment, steps: int, **channels: float) -> None:
    """Actions that hold the tool, but for some channels by their names."""
    for _ in range(steps):
        action = hold_actions(env.current().state, env.spec)
        for name, value in channels.items():
            action[0, env.spec.action_names.index(name)] = value
        env.step(action)


def truth(**values: float) -> FloatArray:
    usual = {"container_radius": 0.06, "container_height": 0.028}
    return np.array([{**usual, **values}.get(name, 0.0) for name in GROUND_TRUTH_NAMES], np.float32)


@pytest.mark.parametrize("task", TASKS)
def test_policies_command_the_gripper_by_its_sign_where_it_opens_and_closes(task: str) -> None:
    waypoints = simulator_part(task).waypoints(truth(object_x=0.6, goal_x=0.7))
    grasps = len({waypoint[-1] for waypoint in waypoints}) > 1
    assert load_config("fair_start", {"task": task}).policy.two_valued_actions == (("gripper",) if grasps else ())


@pytest.mark.parametrize(
    ("task", "done", "spoiled"),
    [
        (
            "push", {"object_x": 0.101, "object_y": 0.049},
            ({"object_x": 0.099}, {"object_y": 0.051}, {"object_bottom_z": 0.02}),
        ),
        ("pull", {"object_x": -0.101, "object_y": -0.049}, ({"object_x": 0.101}, {"object_y": -0.051})),
        (
            "pick_place", {"object_x": 0.044, "object_bottom_z": 0.004, "object_speed": 0.01},
            (
                {"object_x": 0.046}, {"object_bottom_z": 0.049}, {"object_bottom_z": 0.0}, {"object_speed": 0.021},
                {"grasped": 1},
            ),
        ),
        (
            "move_to_aim", {"object_x": 0.035, "object_y": 0.035, "grasped": 1},
            ({"object_x": 0.04}, {"object_bottom_z": 0.021}),
        ),
        ("reach_object", {"object_z": 0.02, "tool_z": 0.1, "tool_x": 0.019}, ({"tool_x": 0.021}, {"tool_z": 0.07})),
    ],
)
def test_success_is_what_the_rule_says_and_each_limit_counts(
    task: str, done: dict[str, float], spoiled: tuple[dict[str, float], ...]
) -> None:
    assert success(task, truth(**done))
    for values in spoiled:
        assert not success(task, truth(**{**done, **values})), values
    assert not success(task, np.full(len(GROUND_TRUTH_NAMES), np.nan, np.float32))
    batch = np.stack([truth(**done), truth(**{**done, **spoiled[0]})])
    assert success(task, batch[None]).tolist() == [[True, False]]


@pytest.mark.rendering
def test_the_state_is_what_the_controller_aims_at_when_acting_at_random(blind: ManiSkillEnvironment) -> None:
    start(blind, 3)
    rng, controller = np.random.default_rng(3), blind.scene.agent.controller.controllers["arm"]
    for _ in range(blind.spec.max_episode_steps):
        before = blind.current().state
        action = np.clip(rng.normal(0, 0.7, (1, 7)), -1, 1).astype(np.float32)
        after = blind.step(action).observation.state
        np.testing.assert_array_equal(after, next_state(before, action, blind.spec))
        aim = controller._target_pose.raw_pose[0].numpy()
        np.testing.assert_allclose(aim[:3], after[0, :3], atol=1e-4)
        expected = multiply(np, to_quaternion(np, after[0, 3:6]), DOWN)
        assert np.arccos(min(1.0, abs(float(expected @ aim[3:])))) * 2 < 1e-3  # arccos near 1 knows no more digits
        np.testing.assert_allclose(aim[3:] * np.sign(expected @ aim[3:]), expected, atol=1e-4)


@pytest.mark.rendering
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_is_about_the_axis_of_the_base_and_not_against_it(blind: ManiSkillEnvironment, axis: int) -> None:
    start(blind, 4)
    hold(blind, 3)

    def tool() -> FloatArray:
        return np.asarray(blind.scene.agent.tcp.pose.q[0].numpy(), np.float64)

    before = tool()
    hold(blind, 2, **{f"tool_dr{'xyz'[axis]}": 1.0})
    hold(blind, 4)
    about, angle = quat2axangle(qmult(tool(), qinverse(before)))
    np.testing.assert_allclose(angle * about, 0.4 * np.eye(3)[axis], atol=0.02)


@pytest.mark.rendering
def test_the_tool_follows_a_translation_and_the_fingers_their_command(blind: ManiSkillEnvironment) -> None:
    start(blind, 5)
    hold(blind, 3)
    before = blind.ground_truth[0]
    hold(blind, 1, tool_dy=0.5, gripper=1)
    hold(blind, 4)
    after = blind.ground_truth[0]
    np.testing.assert_allclose(after[4:7] - before[4:7], [0, 0.05, 0], atol=0.004)
    assert before[OPENING] == pytest.approx(0, abs=1e-3) and after[OPENING] == pytest.approx(0.08, abs=2e-3)


@pytest.mark.rendering
def test_a_seed_gives_the_same_bits_after_other_episodes_and_in_another_slot(blind: ManiSkillEnvironment) -> None:
    def play(env: ManiSkillEnvironment, slot: int, seed: int) -> FloatArray:
        """The script of `push` in one slot, the others stay ended or where they are; ground truth of every step."""
        mask = np.arange(env.spec.num_envs) == slot
        observation = env.reset(mask, np.full(env.spec.num_envs, seed, np.uint64))
        act = simulator_part("push").script("expert", env.ground_truth[slot], numpy_stream(seed, "behaviour"), 0.1)
        seen = [env.ground_truth[slot]]
        for _ in range(12):
            actions = hold_actions(observation.state, env.spec)
            actions[slot] = act(seen[-1], observation.state[slot])
            result = env.step(actions)
            observation = result.observation
            seen.append(result.ground_truth[slot])
        return np.stack(seen)

    first = {seed: play(blind, 0, seed) for seed in (11, 12, 13)}
    assert all(np.abs(truths[-1, :3] - truths[0, :3]).max() > 0.02 for truths in first.values()), "nothing was touched"
    two = ManiSkillEnvironment("push", CONFIG.simulation, num_envs=2, pictures=False, end_on_success=False)
    for seed in (13, 11, 12):
        np.testing.assert_array_equal(play(blind, 0, seed), first[seed])
        np.testing.assert_array_equal(play(two, 1, seed), first[seed])
    two.close()


@pytest.mark.rendering
def test_an_episode_has_the_scene_of_its_seed_and_says_so(blind: ManiSkillEnvironment) -> None:
    for seed in (1, 2):
        start(blind, seed)
        scene = scene_of("train", seed)
        assert scene is not None and blind.shown_scenes == (scene,)
        assert blind.instructions == (f"push the {scene.object} away from the robot",)
        assert blind.scene.catalogue_scene == scene
    assert blind.spec.instruction == "push the object away from the robot"


@pytest.mark.rendering
@pytest.mark.parametrize("task", TASKS)
def test_the_script_of_a_task_succeeds_from_a_start_that_does_not(task: str) -> None:
    simulation = load_config("cpu", {"task": task}).simulation
    env = ManiSkillEnvironment(task, simulation, pictures=False)
    for seed in (1, 2, 3):
        episode = scripted_episode(env, "expert", seed, seed)
        assert episode.terminated and episode.success[-1] and not episode.success[0], (seed, env.shown_scenes)
        shown = scene_of("train", seed)
        instruct = simulator_part(task).instruct
        assert shown and instruct and episode.instruction == instruct(shown)
        assert episode.actions.shape[1] == episode.states.shape[1] == 7
    assert not scripted_episode(env, "random", 1, 4).success[0]
    with pytest.raises(ValueError, match=r"'dance'.*noisy"):
        scripted_episode(env, "dance", 1, 5)
    env.close()


@pytest.mark.rendering
def test_scattered_episodes_show_the_object_at_rest_elsewhere_at_every_step(env: ManiSkillEnvironment) -> None:
    episode, again = (scripted_episode(env, SCATTERED, 7, number) for number in (0, 1))
    assert_array_equal(episode.ground_truth, again.ground_truth)
    places, tools = episode.ground_truth[1:, OBJECT], episode.ground_truth[1:, TOOL]
    assert (np.abs(places[:, :2]) <= np.array(ANYWHERE[1]) + 0.01).all() and np.ptp(places[:, :2], 0).min() > 0.15
    moved = np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1)
    assert np.median(moved) > 0.03 and (episode.ground_truth[1:, BOTTOM] < ON_TABLE_M).mean() > 0.9
    assert 0.2 < (np.linalg.norm((places - tools)[:, :2], axis=1) < 0.1).mean() < 0.9, "often near the tool"
    container = episode.ground_truth[:, CONTAINER]
    assert (np.linalg.norm(places[:, :2] - container[1:], axis=1) > 0.1).all()


def states_of(object_state: str, steps: int, *, pictures: bool = True) -> tuple[ManiSkillEnvironment, FloatArray]:
    """A closed environment of push, and its states (T, S) at the reset and after steps."""
    simulation = CONFIG.simulation.with_values(object_state=object_state)
    with closing(ManiSkillEnvironment("push", simulation, pictures=pictures)) as env:
        states = [env.reset(seeds=np.array([3], np.uint64)).state[0]]
        down = np.array([[0.5, 0, -1, 0, 0, 0, 0]], np.float32)
        states += [env.step(down).observation.state[0] for _ in range(steps)]
    return env, np.stack(states)


def test_the_state_says_where_things_are_in_the_base_frame() -> None:
    env, states = states_of(TRUTH, 2, pictures=False)
    named = dict(zip(env.spec.state_names, states.T, strict=True))
    truths = env.ground_truth[0], env._first_truth[0]
    now, begun = (dict(zip(GROUND_TRUTH_NAMES, truth, strict=True)) for truth in truths)
    for name in STATE:
        base = ROBOT_BASE["xyz".index(name[-1])]
        hidden = name.startswith("goal_")  # no carpet shows it
        assert named[name][-1] == pytest.approx(0 if hidden else now[name] - base, abs=1e-6)
        assert named[name][0] == pytest.approx(0 if hidden else begun[name] - base, abs=1e-6)
    assert env.spec.commanded_dim == 7 and np.ptp(named["tool_target_z"]) > 0.1


@pytest.mark.parametrize(("task", "carpet"), [("pick_place", False), ("reach_object", False), ("move_to_aim", True)])
def test_the_state_says_a_goal_where_a_carpet_is_one_and_nowhere_else(task: str, carpet: bool) -> None:
    simulation = load_config("cpu", {"task": task, "simulation.object_state": TRUTH}).simulation
    with closing(ManiSkillEnvironment(task, simulation, pictures=False)) as env:
        state = dict(zip(env.spec.state_names, env.reset(seeds=np.array([3], np.uint64)).state[0], strict=True))
    assert (state["goal_x"] != 0) == carpet and state["container_x"] != 0


def test_a_reader_reads_the_state_and_the_start_is_what_it_read_at_the_reset(tmp_path: Path) -> None:
    spec = configured_spec(load_config("cpu", {"task": "push", "simulation.object_state": TRUTH}))
    torch.manual_seed(0)
    reader = ObjectReader(spec)
    save_weights(reader, tmp_path / READER)
    env, states = states_of(str(tmp_path / READER), 2)
    named, last = dict(zip(spec.state_names, states.T, strict=True)), env.current()
    read = reader.fill(last.image, last.state)[0]
    for name in ("object_x", "container_y", "goal_x"):
        assert named[name][-1] == pytest.approx(read[spec.state_names.index(name)], abs=1e-5)
    for name in STARTS:
        assert (named[name] == named[name.replace("start_", "")][0]).all()
    assert np.isnan(states_of(str(tmp_path / READER), 1, pictures=False)[1][:, 7:]).all()


def test_the_cube_task_has_nothing_to_scatter() -> None:
    simulation = load_config("cpu", {"task": "push_cube"}).simulation
    with closing(ManiSkillEnvironment("push_cube", simulation, pictures=False)) as cube:
        with pytest.raises(ValueError, match=r"push_cube has no procedural scene .* set data.num_scattered to 0"):
            scripted_episode(cube, SCATTERED, 7, 0)


@pytest.mark.rendering
@pytest.mark.parametrize("task", ["pick_place", "move_to_aim"])
def test_a_script_that_takes_over_does_not_drop_what_the_fingers_hold(task: str) -> None:
    environment = ManiSkillEnvironment(task, CONFIG.simulation, pictures=False)
    scale, held = environment.spec.action_scale[0], []
    for seed in range(8, 16):
        start(environment, seed)
        script = simulator_part(task).script("expert", environment.ground_truth[0], numpy_stream(seed, "script"), scale)

        def begin(seen: Observation, now: FloatArray, script: Callable[..., FloatArray] = script) -> FloatArray:
            return script(now, seen.state[0])

        episode = recovered_episode(environment, begin, seed, seed)
        taken_over = episode.extra[TAKEN_OVER]
        if taken_over < episode.num_steps and episode.ground_truth[taken_over, GRASPED]:
            held.append(bool(episode.success.any()))
            let_go = np.flatnonzero(episode.ground_truth[taken_over:, GRASPED] == 0)
            assert not let_go.size or episode.num_steps - taken_over - let_go[0] <= 3, "it let go on the way"
    environment.close()
    assert len(held) >= 3 and all(held)


@pytest.mark.rendering
def test_a_grasped_object_is_lifted_and_known_to_be_grasped(env: ManiSkillEnvironment) -> None:
    start(env, 1)
    act = simulator_part("pick_place").script("expert", env.ground_truth[0], numpy_stream(1, "behaviour"), 0.1)
    lifted = False
    for _ in range(20):
        truths = env.step(act(env.ground_truth[0], env.current().state[0])[None]).ground_truth[0]
        lifted |= bool(truths[BOTTOM] > 0.05 and truths[GRASPED] == 1 and 0.02 < truths[OPENING] < 0.06)
    assert lifted and truths[GRASPED] == 0 and truths[OPENING] > 0.06


@pytest.mark.rendering
@pytest.mark.parametrize(
    ("scene", "channel", "fewest"),
    [
        ("red_cube-plate-grey_table", 0, 30), ("blue_sphere-bowl-brown_table", 2, 20),
        ("green_bar-bowl-grey_table", 1, 25),
    ],
)
def test_object_and_gripper_are_seen_near_at_64_px(scene: str, channel: int, fewest: int) -> None:
    simulation = CONFIG.simulation.with_values(scenes=scene)
    env = ManiSkillEnvironment("pick_place", simulation)
    for seed in (1, 2):
        start(env, seed)
        near = env.current().image[0, :, :64].astype(int)
        others = [near[..., c] for c in range(3) if c != channel]
        assert (near[..., channel] > np.maximum(*others) + 50).sum() >= fewest
        assert (near[:20].max(2) < 60).sum() > 4  # black finger pads, before the black beyond the table ends
    assert env.shown_scenes == (SCENES[scene],)
    env.close()


@pytest.mark.rendering
def test_the_cameras_are_where_they_say_also_after_the_hand_has_turned(env: ManiSkillEnvironment) -> None:
    start(env, 7)
    hold(env, 2, tool_drx=0.5, tool_drz=1.0, tool_dz=-0.3)
    assert [camera.name for camera in env.cameras] == ["front", "wrist"]
    for camera in env.cameras:
        rendered = env.scene._sensors[camera.name].camera
        world_from_camera = camera.pose_in(0).copy()
        world_from_camera[:3, 3] += ROBOT_BASE
        seen_from_world = rendered.get_extrinsic_matrix()[0].numpy()
        np.testing.assert_allclose(seen_from_world @ world_from_camera, np.eye(4)[:3], atol=1e-5, err_msg=camera.name)


@pytest.mark.rendering
def test_a_commanded_pose_says_where_the_hand_is(env: ManiSkillEnvironment) -> None:
    from wm_nodes.environments.maniskill.cameras import hand_over

    start(env, 8)
    hold(env, 2, tool_drx=1.0, tool_drz=1.0)
    hold(env, 4)
    known, real = hand_over(env.current().state[0]), env._hand(0)
    np.testing.assert_allclose(known[:3, 3], real[:3, 3], atol=0.006)
    turn = qmult(mat2quat(known[:3, :3]), qinverse(mat2quat(real[:3, :3])))
    assert abs(quat2axangle(turn)[1]) < 0.03


def test_no_seed_of_training_is_one_of_a_test() -> None:
    for task in TASKS:
        config = load_config("cpu_full", {"task": task})
        assert MODEL_EPISODES.take(config.data.num_episodes) + config.data.num_episodes <= HELDOUT.first
        assert HELDOUT.take(config.data.num_heldout) + config.data.num_heldout <= config.evaluation.first_seed
    assert replace(get_task("push")) == get_task("push")
