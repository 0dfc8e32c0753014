"""Counts of what is still paid, worked by hand."""

import math
from dataclasses import replace

import pytest

from wm_nodes.core.statistics import wilson_interval
from wm_nodes.judge.agent.types import Status
from wm_nodes.judge.hacking.edits import BENIGN, PATTERNS
from wm_nodes.judge.hacking.outcomes import Attempt, failures, mildest_step, paid_of


def attempts(pattern: str, step: int, paid: int, refused: int, silent: int = 0, unseen: int = 0) -> list[Attempt]:
    """Clips paid with 0.9, refused with 0.1, abstained from, and edits that nobody sees."""
    one = Attempt("c", pattern, "edit", step, True, "OK", True, 0.9, 0.8)
    return [
        *[one] * paid, *[replace(one, paid=False, reward=0.1)] * refused,
        *[replace(one, paid=False, reward=None, status="ABSTAIN")] * silent,
        *[replace(one, visible=False, paid=False, reward=None, status="")] * unseen,
    ]


SOUND = [row for name in PATTERNS for row in attempts(name, 3, 3, 17)] + attempts(BENIGN, 1, 19, 1)
"""3 of 20 grossly edited clips of each pattern are paid, and 19 of 20 harmless changes."""


def test_clips_are_counted_with_an_interval_and_unseen_edits_stay_out() -> None:
    paid = paid_of(attempts("motion", 3, 2, 5, silent=1, unseen=4))
    assert (paid.n, paid.hidden, paid.share, paid.silent) == (8, 4, 0.25, 0.125)
    assert (paid.low, paid.high) == wilson_interval(2, 8)
    assert paid.reward == pytest.approx((2 * 0.9 + 5 * 0.1) / 7) and paid.unedited == pytest.approx(0.8)
    none = paid_of(attempts("motion", 3, 0, 0, unseen=2))
    assert (none.n, none.hidden, none.low, none.high) == (0, 2, 0, 1) and math.isnan(none.share)


def test_a_judge_holds_at_the_limit_and_fails_one_clip_above_it() -> None:
    assert failures(SOUND, 0.15) == []
    told = failures([*SOUND, *attempts("physics", 4, 1, 0)], 0.15)
    assert told == ["physics: 19.0% of the grossly edited clips are still paid, limit 15%"], "4 of 21"
    assert failures([*SOUND, *attempts("physics", 2, 9, 0)], 0.15) == [], "slight steps may be paid"


def test_refusing_everything_and_answering_nothing_are_no_way_out() -> None:
    refusing = [replace(row, paid=False) for row in SOUND]
    assert failures(refusing, 0.15) == ["benign: 0.0% of the harmless changes are still paid, at least 95%"]
    lost = [replace(row, paid=False, reward=None, status=str(Status.ERROR)) for row in attempts("motion", 1, 12, 0)]
    (told,) = failures([*SOUND, *lost], 0.15)
    assert told == "the judge did not answer 12 of 112 times, which says nothing about it"
    unseen = [replace(row, visible=False) if row.pattern == "background" else row for row in SOUND]
    assert failures(unseen, 0.15) == ["background: no edit is visible in these clips"]


def test_the_mildest_step_is_that_from_which_on_the_limit_holds() -> None:
    ladder = [row for step, paid in enumerate((9, 1, 5, 1), 1) for row in attempts("motion", step, paid, 10 - paid)]
    assert mildest_step(ladder, 0.15) == 4, "step 2 holds, but step 3 does not"
    assert mildest_step(ladder, 0.5) == 2 and mildest_step(ladder, 0.9) == 1 and mildest_step(ladder, 0.05) is None
