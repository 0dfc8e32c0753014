"""Numbers of a tool and an object by their places: a made-up path in which one thing is wrong."""

import numpy as np
import pytest

from wm_nodes.core.types import FloatArray
from wm_nodes.judge.one_class.imagination import contact_numbers

HEIGHT_M, T = 0.02, 9
BEHIND_M = 0.04
"""The tool's middle is so far behind that of an object which it pushes."""


def pushing() -> tuple[FloatArray, FloatArray]:
    """The tool comes down behind the object and pushes it 2 cm a step: tool (T, 3), object (T, 2)."""
    tool = np.column_stack([np.full(T, 0.02) * np.maximum(np.arange(T) - 4, 0), np.zeros(T), np.full(T, HEIGHT_M)])
    tool[:4, 2] = HEIGHT_M + 0.03 * np.arange(4, 0, -1)
    thing = tool[:, :2] + [BEHIND_M, 0]
    return tool.astype(np.float32), thing.astype(np.float32)


def test_a_tool_that_pushes_an_object_stays_outside_and_the_object_does_not_move_alone() -> None:
    found = contact_numbers(*pushing(), HEIGHT_M)
    assert found["tool_inside"] == found["tool_through"] == pytest.approx(-np.log(BEHIND_M + 0.003), abs=0.01)
    assert found["object_untouched_m"] == 0


def test_a_tool_inside_the_object_that_it_pushes_is_nearer_than_its_rim() -> None:
    tool, thing = pushing()
    inside = contact_numbers(tool, thing - [0.03, 0], HEIGHT_M)["tool_inside"]
    assert inside == pytest.approx(-np.log(0.01 + 0.003), abs=0.01)


def test_a_tool_that_goes_through_a_resting_object_is_told_even_if_no_frame_shows_it_inside() -> None:
    tool, thing = pushing()
    tool[5:, 0] = 0.2
    found = contact_numbers(tool, np.repeat(thing[:1], T, 0), HEIGHT_M)
    assert found["tool_through"] > -np.log(0.005) > found["tool_inside"]
    over = tool + np.array([0, 0, 0.06], np.float32)
    assert contact_numbers(over, np.repeat(thing[:1], T, 0), HEIGHT_M)["tool_through"] < -np.log(0.03), "above it"


def test_an_object_that_moves_while_the_tool_is_elsewhere_moves_untouched_and_one_misread_frame_does_not() -> None:
    tool, thing = pushing()
    home = np.repeat(tool[:1], T, 0)
    assert contact_numbers(home, thing, HEIGHT_M)["object_untouched_m"] == pytest.approx(0.08, abs=0.01)
    misread = np.repeat(thing[:1], T, 0)
    misread[4] += 0.1
    assert contact_numbers(home, misread, HEIGHT_M)["object_untouched_m"] == 0


def test_a_clip_of_two_frames_has_every_number() -> None:
    tool, thing = pushing()
    assert all(np.isfinite(value) for value in contact_numbers(tool[:2], thing[:2], HEIGHT_M).values())
