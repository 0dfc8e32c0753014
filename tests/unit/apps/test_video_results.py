"""What the results of a video model's training say of scores that nobody can know."""

import math

from wm_nodes.apps.video_results import known_scores


def test_a_score_that_is_no_number_in_a_context_is_not_known() -> None:
    before = {"tracking": [0.5, 0.25], "success": [math.nan, math.nan], "outcome": [0.5, 0.5], "foreign": [1.0, 1.0]}
    after = {"tracking": [0.5, 0.5], "success": [math.nan, math.nan], "outcome": [0.5, math.nan], "foreign": [1.0, 1.0]}
    assert known_scores(before, after) == ["tracking"]
