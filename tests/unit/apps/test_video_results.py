"""What the results of a video model's training say of scores that nobody can know."""

import math

import pytest

from wm_nodes.apps.video_results import compared_scores, known_scores, score_changes
from wm_nodes.config.load import load_video_config


def test_a_score_that_is_no_number_in_a_context_is_not_known() -> None:
    before = {"tracking": [0.5, 0.25], "success": [math.nan, math.nan], "outcome": [0.5, 0.5], "foreign": [1.0, 1.0]}
    after = {"tracking": [0.5, 0.5], "success": [math.nan, math.nan], "outcome": [0.5, math.nan], "foreign": [1.0, 1.0]}
    assert known_scores(before, after) == ["tracking"]


@pytest.mark.parametrize(("preset", "verdict"), [("recommended", ""), ("closed_loop", ""), ("outcome", "better")])
def test_where_actions_are_given_no_end_of_a_clip_is_better_or_worse(preset: str, verdict: str) -> None:
    """A clip should end there as its recording did, and most recordings fail."""
    ends = ("success", "outcome", "execution", "execution_success", "executed_success", "reader_success")
    before, after = ({name: [value] * 8 for name in (*ends, "tracking")} for value in (0.25, 0.75))
    changes = score_changes(before, before, after, load_video_config(preset))
    assert {name: changes[name].verdict for name in changes} == {**dict.fromkeys(ends, verdict), "tracking": "better"}
    assert all(change.difference == 0.5 for change in changes.values())


def test_a_score_that_was_written_as_no_number_was_not_compared() -> None:
    line = {"hacked": 0.0, "tracking": 0.5, "scenery": None, "success": 0.25, "outcome": None}
    assert compared_scores([line], load_video_config("recommended")) == ["tracking"]
    assert compared_scores([line], load_video_config("outcome")) == ["tracking", "success"]
    assert compared_scores([], load_video_config("recommended")) == []
