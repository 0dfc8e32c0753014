"""Levels, votes and which frames are shown (RA-3, RA-5 to RA-8)."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_judge import BORDERLINE, CLEAN, FLAWED, UNUSABLE, WRONG, make_clip, make_task

from wm_nodes.judge.agent.judge import ComponentScore, Read
from wm_nodes.judge.agent.levels import (
    first_vote,
    map_back,
    next_vote,
    one_hot,
    option_order,
    p_fail_of,
    pool,
    score_of,
    settle,
    tally,
)
from wm_nodes.judge.agent.profiles import cited_media, contact_window, dense_indices, profile_media, static_indices
from wm_nodes.judge.agent.types import Profile, Status, TaskSpec, clip_ref

distributions = st.lists(st.integers(0, 20), min_size=5, max_size=5).filter(any).map(
    lambda counts: tuple(count / sum(counts) for count in counts)
)


def votes(*answers: tuple[float, ...], mass: float = 1.0) -> list[Read]:
    return [
        Read("clarity", levels, "label" if index else "json", next_vote(index, 0), mass)
        for index, levels in enumerate(answers)
    ]


def decide(*answers: tuple[float, ...]) -> ComponentScore | None:
    return tally(votes(*answers), k=3, k_max=5, min_label_mass=0.5)


def test_score_and_failure_of_a_distribution_worked_by_hand() -> None:
    levels = (0.1, 0.2, 0.4, 0.2, 0.1)
    assert score_of(levels) == pytest.approx((0.2 + 0.8 + 0.6 + 0.4) / 4)
    assert p_fail_of(levels) == pytest.approx(0.1 + 0.2 + 0.2)
    assert score_of(one_hot(3, 4)) == 1 and score_of(CLEAN) == 1 and p_fail_of(BORDERLINE) == 0.5


def test_votes_are_weighted_by_their_label_mass() -> None:
    reads = [*votes(CLEAN, mass=1.0), *votes(WRONG, mass=0.5)]
    assert pool(reads) == pytest.approx((0, 1 / 3, 0, 0, 2 / 3))


@given(st.lists(distributions, min_size=1, max_size=5), st.randoms(use_true_random=False))
def test_the_order_of_votes_changes_nothing(answers: list[tuple[float, ...]], random: object) -> None:
    reads = votes(*answers)
    shuffled = list(reads)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    before, after = settle(reads, 0.5), settle(shuffled, 0.5)
    assert (before.status, before.passed) == (after.status, after.passed)
    assert (before.s, before.p_fail) == (after.s, after.p_fail) or (math.isnan(before.s) and math.isnan(after.s))


@given(distributions, st.integers(0, 9), st.integers(0, 2**40), st.text(max_size=8))
def test_the_order_of_options_is_undone(levels: tuple[float, ...], index: int, seed: int, sha: str) -> None:
    order = option_order(next_vote(index, seed), sha, "clarity")
    assert map_back([levels[level] for level in order], order) == levels


def test_the_negative_question_lists_worst_first_and_the_positive_one_differs_by_clip() -> None:
    assert option_order(next_vote(1, 0), "a", "clarity") == (0, 1, 2, 3, 4)
    orders = {option_order(next_vote(2, 0), sha, "clarity") for sha in "abcdefgh"}
    assert len(orders) > 4 and all(sorted(order) == [0, 1, 2, 3, 4] for order in orders)
    assert [next_vote(i, 0).polarity for i in (1, 2, 3)] == ["negative", "positive", "negative"]
    assert first_vote(0).kind == "json"


def test_two_equal_votes_of_three_decide_and_a_split_asks_once_more() -> None:
    assert decide(CLEAN) is None
    done = decide(CLEAN, FLAWED)
    assert done is not None and done.passed and done.decided_by == "2 of 2 votes"
    assert decide(CLEAN, WRONG) is None
    third = decide(CLEAN, WRONG, CLEAN)
    assert third is not None and third.passed and third.s == pytest.approx(0.75)


def test_a_majority_that_the_pooled_levels_contradict_gets_more_votes_and_then_abstains() -> None:
    narrow = (0.0, 0.0, 0.98, 0.02, 0.0)  # passes with p_fail 0.49
    assert decide(narrow, UNUSABLE, narrow) is None
    assert decide(narrow, UNUSABLE, narrow, UNUSABLE) is None
    last = decide(narrow, UNUSABLE, narrow, UNUSABLE, narrow)
    assert last is not None and last.status is Status.ABSTAIN and "3 votes pass, 2 fail" in last.reason
    assert math.isnan(last.s) and not last.passed


@pytest.mark.parametrize(
    ("levels", "mass", "status", "words"),
    [
        ((1.0,), 1.0, Status.ERROR, "1 levels instead of 5"),
        ((0.5,) * 5, 1.0, Status.ERROR, "no distribution"),
        ((math.nan,) * 5, 1.0, Status.ERROR, "no distribution"),
        ((-0.5, 0.5, 0.5, 0.5, 0.0), 1.0, Status.ERROR, "no distribution"),
        (CLEAN, 1.5, Status.ERROR, "outside [0, 1]"),
        (CLEAN, 0.49, Status.ABSTAIN, "below 0.5"),
        ((), 0.0, Status.ABSTAIN, "below 0.5"),
    ],
)
def test_a_read_without_a_valid_answer_is_no_number(
    levels: tuple[float, ...], mass: float, status: Status, words: str
) -> None:
    found = tally(votes(levels, mass=mass), k=3, k_max=5, min_label_mass=0.5)
    assert found is not None and found.status is status and words in found.reason and math.isnan(found.s)


def test_a_level_that_does_not_exist_and_an_order_that_is_none_are_refused() -> None:
    with pytest.raises(ValueError, match="0 to 4, got 5"):
        one_hot(5)
    with pytest.raises(ValueError, match="no permutation"):
        map_back((0.5, 0.5), (0, 0))


def moving_clip(num_frames: int = 40, moves: range = range(20, 24)) -> np.ndarray:
    """Frames that stand still but for a brightening at `moves`."""
    levels = np.cumsum([40 if t in moves else 0 for t in range(num_frames)]) + 20
    return np.broadcast_to(levels.astype(np.uint8)[:, None, None, None], (num_frames, 8, 8, 3)).copy()


def test_static_frames_hold_the_ends_and_bursts_where_the_picture_changes() -> None:
    energy = np.zeros(39)
    energy[[9, 29]] = 5.0, 4.0
    shown = static_indices(energy)
    assert {0, 13, 26, 39} <= set(shown) and len(shown) == 10
    assert {9, 10} <= set(shown) and {29, 30} <= set(shown)


def test_the_first_trunk_only_grows_at_its_end_and_shows_nothing_twice() -> None:
    clip = make_clip(num_frames=40)
    plain = make_task(clip)
    task = TaskSpec(**{**vars(plain), "goal_image": clip.frames[-1]})
    s, i, e = (profile_media(clip, task, profile) for profile in (Profile.S, Profile.I, Profile.E))
    assert i[: len(s)] == s and e[: len(i)] == i and len(s) < len(i) < len(e)
    assert s[0].kind == "reference" and e[-1].kind == "goal" and len(set(e)) == len(e)
    assert {37, 38, 39} <= {item.index for item in e} and len(e) <= 23
    assert s[-1].label == "frame 39 at 4.88 s"


def test_the_dense_profile_shows_contact_at_full_rate_and_keeps_its_limit() -> None:
    clip = clip_ref("moving", moving_clip(120, range(60, 64)), 30.0)
    shown = [item.index for item in profile_media(clip, make_task(clip), Profile.D)]
    assert {59, 60, 61, 62, 63} <= set(shown) and shown == sorted(set(shown))
    assert len(shown) <= 32 and {0, 119} <= set(shown)


@given(st.integers(1, 90), st.integers(2, 40), st.floats(1, 60), st.integers(0, 2**32 - 1))
def test_profiles_of_any_clip_stay_inside_it(pairs: int, limit: int, fps: float, seed: int) -> None:
    energy = np.random.default_rng(seed).random(pairs)
    for shown in (static_indices(energy), dense_indices(energy, fps, limit), contact_window(energy)):
        assert shown == sorted(set(shown)) and shown[0] >= 0 and shown[-1] <= pairs
    assert len(dense_indices(energy, fps, limit)) <= limit and len(static_indices(energy)) <= 10


def test_cited_frames_come_once_and_in_order() -> None:
    assert [item.index for item in cited_media((5, 2, 5), make_clip())] == [2, 5]


def test_motion_of_another_length_is_refused() -> None:
    clip = make_clip()
    with pytest.raises(ValueError, match=r"motion must have shape \(15,\), got \(3,\)"):
        profile_media(clip, make_task(clip), Profile.D, motion=np.zeros(3))
    with pytest.raises(ValueError, match="max_frames must be >= 2, got 1"):
        dense_indices(np.zeros(3), 8.0, 1)
