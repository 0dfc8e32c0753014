"""Poses as states: rotations in numpy and torch, and the controller's rule for actions of seven numbers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from transforms3d.axangles import axangle2mat
from transforms3d.quaternions import quat2mat

from wm_nodes.config.load import load_config
from wm_nodes.core.action_spaces import MAX_TILT_RAD, MAX_YAW_RAD
from wm_nodes.core.rotations import multiply, to_quaternion, to_vector
from wm_nodes.core.tool_control import CommandedMove, hold_actions, moves_pose, next_state
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.maniskill.spec import simulation_spec

SPEC = simulation_spec("push", load_config("cpu", {"task": "push"}).simulation, 1)
REST = np.array([[0.6, 0.0, 0.1, 0.0, 0.0, 0.0, -1.0]], np.float32)


def vectors(count: int, largest: float) -> np.ndarray:  # type: ignore[type-arg]
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(count, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True) * rng.uniform(0, largest, (count, 1))


def walk(steps: int, count: int = 64) -> list[tuple[FloatArray, FloatArray]]:
    """States and the actions taken there, also at the edges of the box."""
    rng, states, taken = np.random.default_rng(1), REST.repeat(count, 0), []
    for _ in range(steps):
        actions = np.clip(rng.normal(0.2, 1, (count, 7)), -1, 1).astype(np.float32)
        taken.append((states, actions))
        states = next_state(states, actions, SPEC)
    return taken


def test_a_rotation_vector_is_the_rotation_about_its_axis_by_its_length() -> None:
    for vector in [*vectors(50, 3.1), np.array([1e-9, 0, 0]), np.array([0, 0, 3.0])]:
        expected = axangle2mat(vector, np.linalg.norm(vector))
        np.testing.assert_allclose(quat2mat(to_quaternion(np, vector)), expected, atol=1e-12)
    np.testing.assert_array_equal(to_quaternion(np, np.zeros(3)), [1, 0, 0, 0])


def test_the_vector_of_a_quaternion_and_of_its_negative_is_the_shorter_rotation() -> None:
    given = vectors(200, 3.1)
    quaternions = to_quaternion(np, given)
    np.testing.assert_allclose(to_vector(np, quaternions), given, atol=1e-12)
    np.testing.assert_allclose(to_vector(np, -quaternions), given, atol=1e-12)
    np.testing.assert_allclose(to_vector(np, to_quaternion(np, [0, 0, 4.0])), [0, 0, 4.0 - 2 * np.pi], atol=1e-9)


def test_the_right_rotation_is_made_first() -> None:
    first, then = np.array([np.pi / 2, 0, 0]), np.array([0, 0, np.pi / 2])
    both = multiply(np, to_quaternion(np, then), to_quaternion(np, first))
    np.testing.assert_allclose(quat2mat(both) @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # y to z, which stays
    np.testing.assert_allclose(quat2mat(both) @ [1, 0, 0], [0, 1, 0], atol=1e-12)  # x stays, then to y


def test_torch_and_numpy_give_the_same_bits() -> None:
    move = CommandedMove(SPEC, torch.device("cpu"))
    for states, actions in walk(30):
        moved = next_state(states, actions, SPEC)
        tensor = move(torch.from_numpy(states), torch.from_numpy(actions))
        assert tensor.dtype == torch.float32
        np.testing.assert_array_equal(tensor.numpy(), moved)
    assert moves_pose(SPEC) and np.abs(states[:, 5]).max() > 1


def test_a_batch_moves_as_each_of_its_rows_does() -> None:
    for states, actions in walk(3):
        rows = [next_state(states[i], actions[i], SPEC) for i in range(len(states))]
        np.testing.assert_array_equal(next_state(states, actions, SPEC), rows)


def test_an_action_translates_turns_and_sets_the_gripper() -> None:
    moved = next_state(REST, np.array([[1, -0.5, 0, 0, 0, 1, 0.5]], np.float32), SPEC)
    np.testing.assert_allclose(moved, [[0.7, -0.05, 0.1, 0, 0, 0.2, 0.5]], atol=1e-6)
    tilted = next_state(moved, np.array([[0, 0, 0, 1, 0, 0, 0.5]], np.float32), SPEC)  # about the x of the base
    expected = axangle2mat([1, 0, 0], 0.2) @ axangle2mat([0, 0, 1], 0.2)
    np.testing.assert_allclose(quat2mat(to_quaternion(np, tilted[0, 3:6])), expected, atol=1e-6)


def test_the_box_limits_place_tilt_and_yaw_and_a_held_state_stays_to_the_bit() -> None:
    states = REST
    for _ in range(20):
        states = next_state(states, np.array([[1, 1, 1, 0, 0, 1, 1]], np.float32), SPEC)
    np.testing.assert_allclose(states, [[*SPEC.state_high[:3], 0, 0, MAX_YAW_RAD, 1]], atol=1e-6)
    for _ in range(20):
        states = next_state(states, np.array([[0, 0, 0, -1, 0.5, -1, 0.3]], np.float32), SPEC)
    assert (np.abs(states[0, 3:6]) <= np.float32([MAX_TILT_RAD, MAX_TILT_RAD, MAX_YAW_RAD])).all()
    held = next_state(states, hold_actions(states, SPEC), SPEC)
    np.testing.assert_allclose(held, states, atol=1e-6)
    np.testing.assert_array_equal(held[:, 6], states[:, 6])


def test_zeros_hold_a_tool_that_only_moves() -> None:
    spec = simulation_spec("push_cube", load_config("cpu").simulation, 2)
    assert not moves_pose(spec) and not hold_actions(np.ones((2, 3), np.float32), spec).any()


def test_the_specification_names_what_the_seven_numbers_are() -> None:
    assert SPEC.action_units == SPEC.state_units == ("m", "m", "m", "rad", "rad", "rad", "1")
    assert SPEC.action_scale == (0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 1.0)
    assert SPEC.state_low[:3] == (0.4, -0.2, 0.015) and SPEC.state_high[6] == 1
    assert len({*SPEC.action_names, *SPEC.state_names}) == 14
    assert replace(SPEC, action_names=("x",) * 7) != SPEC and not moves_pose(replace(SPEC, action_names=("x",) * 7))


def test_a_rotation_by_the_smallest_float_is_not_lost() -> None:
    assert pytest.approx(1e-30) == to_vector(np, to_quaternion(np, [0, 0, 1e-30]))[2]
