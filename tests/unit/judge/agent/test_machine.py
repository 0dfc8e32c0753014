"""The state machine, precheck, votes, budgets, reflection and failures (RA-1, RA-2, RA-6, RA-13)."""

import asyncio
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scripted_judge import (
    BORDERLINE,
    CLEAN,
    FAIR,
    FLAWED,
    GOOD,
    INVALID,
    POOR,
    UNUSABLE,
    WRONG,
    FaultyJudge,
    ScriptedJudge,
    clean_table,
    make_clip,
    make_task,
)

from wm_nodes.judge.agent.contract import check_one_judge, pause_reason
from wm_nodes.judge.agent.judge import Capabilities, Read, ReadRequest
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import ClipRef, Profile, Stage, Status
from wm_nodes.judge.agent.verdict import Verdict

QUIET = {"voting": {"audit_share": 0.0}, "reflection": {"audit_share": 0.0}}
RUBRIC = load_rubric(overrides=QUIET)
PLAIN_OVERRIDES: dict[str, Any] = QUIET | {"reflection": {"enabled": False}, "hack": {"enabled": False}}
PLAIN = load_rubric(overrides=PLAIN_OVERRIDES)
NUM_COMPONENTS, NUM_PATTERNS = 12, 4


def judge_clip(
    judge: ScriptedJudge,
    rubric: Rubric = PLAIN,
    *,
    clip: ClipRef | None = None,
    task: dict[str, Any] | None = None,
    evidence: dict[str, float] | None = None,
    **options: Any,
) -> Verdict:
    clip = clip or make_clip()
    asked = replace(make_task(clip), **(task or {}))
    return asyncio.run(RewardAgent(judge, rubric, **options).evaluate(clip, asked, evidence))


def test_a_clean_clip_earns_one_with_one_read_of_everything_and_one_of_each_pattern() -> None:
    judge = ScriptedJudge(clean_table(RUBRIC))
    verdict = judge_clip(judge, RUBRIC)
    assert verdict.status is Status.OK and verdict.reward == pytest.approx(1) and verdict.level == 3
    assert verdict.num_reads == 1 + NUM_COMPONENTS + NUM_PATTERNS == verdict.cost.calls
    assert [r.stage for r in judge.requests] == [Stage.PLAN, Stage.VQ, Stage.IF, Stage.TC, Stage.PC, Stage.HACK]
    assert [r.profile for r in judge.requests] == [Profile(letter) for letter in "SSIEDD"]
    assert not any(r.prior for r in judge.requests) and not verdict.reflections


def test_a_failed_gate_ends_the_reading_in_reward_mode_only() -> None:
    table = clean_table(PLAIN, planning=POOR, clarity=UNUSABLE)
    short, full = ScriptedJudge(table), ScriptedJudge(table)
    early, late = judge_clip(short, mode="reward"), judge_clip(full, mode="benchmark")
    assert [stage.status for stage in early.stages] == [Status.OK] + [Status.SKIPPED] * 3
    assert all(stage.status is Status.OK for stage in late.stages) and not late.stages[0].passed
    assert early.reward == late.reward == pytest.approx(0.5 * 0.5 * 0.75)
    assert early.num_reads < late.num_reads


def reads_of(rubric: Rubric) -> st.SearchStrategy[dict[str, Any]]:
    levels = st.sampled_from([CLEAN, FLAWED, BORDERLINE, WRONG, UNUSABLE, (0.0, 0.3, 0.1, 0.1, 0.5)])
    votes = st.lists(levels, min_size=1, max_size=5)
    names = (*rubric.component_names, *rubric.hack.patterns)
    return st.fixed_dictionaries(
        dict.fromkeys(names, votes) | {"planning": st.sampled_from([GOOD, FAIR, POOR, INVALID])}
    )


@settings(max_examples=40, deadline=None)
@given(reads_of(RUBRIC), st.sampled_from(["reward", "benchmark"]), st.integers(21, 80), st.integers(0, 5))
def test_whatever_the_answers_reads_stay_in_budget_and_equal_seeds_give_equal_verdicts(
    table: dict[str, Any], mode: str, max_reads: int, seed: int
) -> None:
    first, again = (
        judge_clip(ScriptedJudge(table), load_rubric(), mode=mode, max_reads=max_reads, seed=seed) for _ in range(2)
    )
    assert first.num_reads <= max_reads and first.num_reads == first.cost.calls
    assert first.audit_id == again.audit_id and len(first.audit_id) == 64
    assert math.isnan(first.reward) if first.status is Status.ABSTAIN else 0 <= first.reward <= 1
    assert first.status in (Status.OK, Status.ABSTAIN)


@settings(max_examples=30, deadline=None)
@given(reads_of(PLAIN))
def test_both_modes_give_one_reward_and_reward_mode_never_reads_more(table: dict[str, Any]) -> None:
    early, late = (judge_clip(ScriptedJudge(table), mode=mode) for mode in ("reward", "benchmark"))
    assert early.num_reads <= late.num_reads
    if late.valid:
        assert early.valid and early.reward == late.reward


def test_another_seed_or_answer_gives_another_audit_id() -> None:
    table = clean_table(PLAIN)
    one, other = judge_clip(ScriptedJudge(table)), judge_clip(ScriptedJudge(table), seed=1)
    changed = judge_clip(ScriptedJudge(table | {"clarity": FLAWED}))
    assert len({one.audit_id, other.audit_id, changed.audit_id}) == 3


def test_only_unclear_components_are_voted_on_and_two_equal_votes_end_it() -> None:
    unsure = (0.0, 0.0, 0.3, 0.7, 0.0)
    judge = ScriptedJudge(clean_table(PLAIN, robot=[BORDERLINE, CLEAN, CLEAN], color=[unsure, WRONG, CLEAN]))
    verdict = judge_clip(judge)
    assert judge.asked(Stage.VQ)[1:] == [(("color",), 1), (("color",), 2)]
    assert judge.asked(Stage.IF)[1:] == [(("robot",), 1), (("robot",), 2)]
    robot = verdict.stages[1].components[2]
    assert robot.decided_by == "2 of 3 votes" and robot.s == pytest.approx(2.5 / 3)


@pytest.mark.parametrize("plan", [POOR, FAIR])
def test_at_a_middling_planning_level_everything_is_voted_on_the_focus_first(plan: tuple[float, ...]) -> None:
    focus = ("temporal", "color", "nonsense", "robot", "clarity")
    judge = ScriptedJudge(clean_table(PLAIN, planning=plan), focus=focus)
    verdict = judge_clip(judge)
    assert verdict.plan is not None and verdict.plan.focus == ("temporal", "color", "robot")
    assert [names for names, _ in judge.asked(Stage.VQ)] == [("temporal", "color", "clarity", "brightness")] * 2
    assert verdict.num_reads == 1 + 2 * NUM_COMPONENTS
    assert [score.component for score in verdict.stages[0].components] == list(PLAIN.stages[Stage.VQ].components)


def test_evidence_causes_votes_but_never_adds_reward() -> None:
    rubric = load_rubric(overrides=PLAIN_OVERRIDES)
    for value in (1.2, math.nan):
        judge = ScriptedJudge(clean_table(rubric))
        verdict = judge_clip(judge, rubric, evidence={"clarity": value, "unread": value, "color": 0.9})
        assert judge.asked(Stage.VQ)[1:] == [(("clarity",), 1)] and verdict.reward == pytest.approx(1)
    judge = ScriptedJudge(clean_table(rubric))
    judge_clip(judge, rubric, evidence={"clarity": -3.0})
    assert len(judge.asked(Stage.VQ)) == 1


def test_the_audit_share_of_clips_is_voted_on_the_same_ones_each_time() -> None:
    rubric = load_rubric(overrides={**PLAIN_OVERRIDES, "voting": {"audit_share": 0.3}})
    judge, clips = ScriptedJudge(clean_table(rubric)), [make_clip(seed) for seed in range(30)]
    first, again = ([judge_clip(judge, rubric, clip=clip).num_reads for clip in clips] for _ in range(2))
    assert first == again and set(first) == {13, 25} and 3 <= first.count(25) <= 16


def test_votes_and_second_looks_are_audited_in_shares_of_their_own() -> None:
    shares = {"voting": {"audit_share": 0.3}, "reflection": {"audit_share": 0.3}, "hack": {"enabled": False}}
    rubric, clips = load_rubric(overrides=shares), [make_clip(seed) for seed in range(40)]
    judged = [judge_clip(ScriptedJudge(clean_table(rubric)), rubric, clip=clip) for clip in clips]
    voted = [len(verdict.stages[0].components[0].votes) == 2 for verdict in judged]
    looked = [bool(verdict.reflections) for verdict in judged]
    assert 4 <= sum(voted) <= 20 and 4 <= sum(looked) <= 20 and voted != looked
    none = load_rubric(overrides=shares | {"reflection": {"audit_share": 0.0}})
    again = [judge_clip(ScriptedJudge(clean_table(none)), none, clip=clip) for clip in clips]
    assert [len(verdict.stages[0].components[0].votes) == 2 for verdict in again] == voted
    assert not any(verdict.reflections for verdict in again)


def test_patterns_are_read_behind_a_closed_gate_in_audited_clips_only() -> None:
    changed: dict[str, Any] = {"robot": UNUSABLE, "occlusion": UNUSABLE, "physics": UNUSABLE}
    plain = judge_clip(ScriptedJudge(clean_table(RUBRIC, **changed)), RUBRIC)
    assert plain.stages[1].passed is False and not plain.hack_flags
    every = load_rubric(overrides={"voting": {"audit_share": 1.0}, "reflection": {"audit_share": 0.0}})
    audited = judge_clip(ScriptedJudge(clean_table(every, **changed)), every)
    assert [flag.pattern for flag in audited.hack_flags if flag.confirmed] == ["occlusion", "physics"]
    assert audited.stages[2].status is audited.stages[3].status is Status.SKIPPED, "a cap reads no stage"
    assert audited.stages[0].components[0].decided_by == "cap by occlusion" and audited.reward < plain.reward


@settings(max_examples=60, deadline=None)
@given(reads_of(RUBRIC), st.sampled_from(["hard", "open"]))
def test_reading_patterns_behind_a_closed_gate_never_raises_the_reward(table: dict[str, Any], kind: str) -> None:
    shares = {"voting": {"audit_share": 1.0}, "reflection": {"audit_share": 0.0}, "reward": {"gate": kind}}
    read, unread = (load_rubric(overrides=shares | {"hack": {"enabled": enabled}}) for enabled in (True, False))
    watched, other = (judge_clip(ScriptedJudge(table), rubric, max_reads=200) for rubric in (read, unread))
    assert watched.status is other.status
    if other.valid:
        assert len(watched.hack_flags) == NUM_PATTERNS and watched.reward <= other.reward


def test_votes_that_the_budget_forbids_are_left_out_and_what_is_left_over_decides() -> None:
    table = clean_table(PLAIN, planning=FAIR)
    tight = judge_clip(ScriptedJudge(table), max_reads=13)
    assert tight.num_reads == 13 and tight.valid and tight.stages[0].components[0].decided_by == "first read"
    split = judge_clip(ScriptedJudge(table | {"clarity": [CLEAN, UNUSABLE, CLEAN]}), max_reads=17)
    assert split.status is Status.ABSTAIN and "1 votes pass, 1 fail" in split.reason and split.num_reads <= 17


@pytest.mark.parametrize("mode", ["reward", "benchmark"])
@pytest.mark.parametrize("component", ["planning", "clarity", "task_completion", "geometry", "physics"])
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("unavailable", "circuit open"),
        ("crash", "ZeroDivisionError"),
        ("error", "finish_reason length"),
        ("nan", "no distribution"),
        ("sum", "no distribution"),
        ("short", "levels instead of"),
        ("missing", "asked for"),
        ("twice", "asked for"),
    ],
)
def test_a_judge_that_fails_anywhere_leaves_no_number(mode: str, component: str, fault: str, words: str) -> None:
    verdict = judge_clip(FaultyJudge(clean_table(RUBRIC), component, fault), RUBRIC, mode=mode)
    assert verdict.status is Status.ERROR and not verdict.valid and math.isnan(verdict.reward)
    assert words in verdict.reason


@pytest.mark.parametrize("fault", ["abstain", "mass"])
@pytest.mark.parametrize("mode", ["reward", "benchmark"])
def test_a_judge_that_cannot_say_leaves_no_number_and_benchmark_mode_reads_on(fault: str, mode: str) -> None:
    verdict = judge_clip(FaultyJudge(clean_table(RUBRIC), "robot", fault), RUBRIC, mode=mode)
    assert verdict.status is Status.ABSTAIN and math.isnan(verdict.reward) and "robot" in verdict.reason
    assert verdict.stages[1].status is Status.ABSTAIN
    assert verdict.stages[3].status is (Status.OK if mode == "benchmark" else Status.SKIPPED)


def test_the_calls_of_a_failed_request_are_counted() -> None:
    verdict = judge_clip(FaultyJudge(clean_table(PLAIN), "background", "unavailable"))
    assert verdict.cost.calls == 1 + 4 + 4 and verdict.cost.retries == 3


def test_a_judge_that_never_answers_is_an_error_within_the_budget() -> None:
    class Silent(ScriptedJudge):
        async def read(self, request: ReadRequest) -> list[Read]:
            await asyncio.sleep(60)
            return []

    verdict = judge_clip(Silent(clean_table(PLAIN)), budget_s=0.05)
    assert verdict.status is Status.ERROR and "within 0.05 s" in verdict.reason and math.isnan(verdict.reward)


FRAMES = make_clip().frames


@pytest.mark.parametrize(
    ("frames", "task", "words"),
    [
        (FRAMES[:1], {}, "at least 2 frames, got 1"),
        (np.full((4, 8, 8, 3), np.nan, np.float32), {}, "not finite"),
        (FRAMES.astype(np.float32) / 255, {}, "must be uint8 RGB, got float32"),
        (FRAMES[..., :1], {}, "shape (T, H, W, 3), got (16, 8, 8, 1)"),
        (FRAMES, {"instruction": "  "}, "instruction is empty"),
        (FRAMES, {"actions": np.zeros((16, 7), np.float32)}, "actions must have shape (15, A)"),
        (FRAMES, {"actions": np.full((15, 7), np.nan, np.float32)}, "actions are not finite"),
        (FRAMES, {"goal_image": FRAMES[0].astype(np.float32)}, "goal_image must be uint8"),
    ],
)
def test_a_malformed_clip_is_one_clear_error_and_no_judge_is_asked(
    frames: np.ndarray, task: dict[str, Any], words: str
) -> None:
    judge = ScriptedJudge(clean_table(PLAIN))
    verdict = judge_clip(judge, clip=replace(make_clip(), frames=frames), task={"reference_frame": FRAMES[0], **task})
    assert verdict.status is Status.ERROR and math.isnan(verdict.reward) and words in verdict.reason
    assert not judge.requests


@pytest.mark.parametrize(
    ("frames", "words"), [(np.full_like(FRAMES, 3), "all black"), (FRAMES[:1].repeat(16, 0), "frames are equal")]
)
def test_a_clip_that_shows_nothing_is_level_zero_and_no_judge_is_asked(frames: np.ndarray, words: str) -> None:
    judge, actions = ScriptedJudge(clean_table(PLAIN)), np.ones((15, 7), np.float32)
    verdict = judge_clip(judge, clip=replace(make_clip(), frames=frames), task={"actions": actions})
    assert verdict.valid and verdict.reward == 0 and verdict.level == 0 and words in verdict.reason
    assert not judge.requests


def test_a_still_clip_without_action_goes_to_the_judge() -> None:
    still = replace(make_clip(), frames=FRAMES[:1].repeat(16, 0))
    assert judge_clip(ScriptedJudge(clean_table(PLAIN)), clip=still).num_reads == 13


REFLECTING = load_rubric(overrides=QUIET | {"hack": {"enabled": False}})


def test_task_done_without_interaction_is_looked_at_again_with_new_pixels_and_prior_verdicts() -> None:
    judge = ScriptedJudge(clean_table(REFLECTING, interaction=[WRONG, WRONG, CLEAN]), second={"interaction": CLEAN})
    judge.table["interaction"] = [WRONG, CLEAN]  # a fresh label read agrees with the second look
    verdict = judge_clip(judge, REFLECTING)
    (request,) = [r for r in judge.requests if r.stage is Stage.REFLECT]
    assert request.components[:2] == ("task_completion", "interaction") and len(request.components) == 4
    assert request.profile is Profile.D and len(request.prior) == NUM_COMPONENTS
    fresh = judge.requests[-1]
    assert fresh.components == ("interaction",) and [item.index for item in fresh.media] == [1, 2]
    (reflection,) = verdict.reflections
    assert reflection.accepted and "task_completion passed while interaction failed" in reflection.triggers
    assert verdict.stages[3].components[0].decided_by == "reflection" and verdict.reward == pytest.approx(1)


def test_a_change_that_a_fresh_read_contradicts_or_that_cites_nothing_does_not_count() -> None:
    table = clean_table(REFLECTING, interaction=WRONG)
    plain = judge_clip(ScriptedJudge(table), PLAIN)
    contradicted = judge_clip(ScriptedJudge(table, second={"interaction": CLEAN}), REFLECTING)
    assert [change.accepted for change in contradicted.reflections[0].changed] == [False]
    uncited = judge_clip(ScriptedJudge(table, second={"interaction": CLEAN}, cited=()), REFLECTING)
    outside = judge_clip(ScriptedJudge(table, second={"interaction": CLEAN}, cited=(16,)), REFLECTING)
    assert not uncited.reflections[0].changed and not outside.reflections[0].changed
    assert contradicted.reward == uncited.reward == outside.reward == plain.reward < 1


def test_a_gate_that_the_second_look_opens_is_followed_by_the_stages_behind_it() -> None:
    table = clean_table(REFLECTING, clarity=[UNUSABLE, CLEAN], brightness=[UNUSABLE, CLEAN])
    opened = judge_clip(ScriptedJudge(table, second={"clarity": CLEAN, "brightness": CLEAN}), REFLECTING)
    assert len(opened.reflections) == 1 and opened.reflections[0].accepted
    assert all(stage.passed for stage in opened.stages) and opened.reward == pytest.approx(1)
    kept = judge_clip(ScriptedJudge(table), REFLECTING)
    assert not kept.stages[0].passed and kept.stages[1].status is Status.SKIPPED


@pytest.mark.parametrize(
    ("changed", "mode", "words"),
    [
        ({"planning": INVALID}, "reward", "planning level 0 against a mean stage score of 1.00"),
        ({"color": [BORDERLINE, (0.0, 0.0, 0.8, 0.2, 0.0)]}, "reward", "color decided VQ with margin"),
        ({"color": UNUSABLE, "clarity": UNUSABLE}, "benchmark", "VQ failed but PC is confident"),
    ],
)
def test_each_reason_for_a_second_look(changed: dict[str, Any], mode: str, words: str) -> None:
    rubric = load_rubric(overrides=QUIET | {"hack": {"enabled": False}, "voting": {"audit_share": 0.0, "k": 1}})
    verdict = judge_clip(ScriptedJudge(clean_table(rubric, **changed)), rubric, mode=mode)
    assert any(words in trigger for trigger in verdict.reflections[0].triggers)


def test_evidence_and_chance_are_reasons_for_a_second_look() -> None:
    rubric = load_rubric(overrides={"hack": {"enabled": False}, **QUIET})
    verdict = judge_clip(ScriptedJudge(clean_table(rubric)), rubric, evidence={"temporal": 2.0})
    assert verdict.reflections[0].triggers == ("temporal passed against evidence 2",)
    always = load_rubric(overrides={"hack": {"enabled": False}, "reflection": {"audit_share": 1.0}})
    assert judge_clip(ScriptedJudge(clean_table(always)), always).reflections[0].triggers == ("drawn at random",)


def test_a_second_look_that_fails_is_an_error() -> None:
    class Fails(ScriptedJudge):
        async def read(self, request: ReadRequest) -> list[Read]:
            if request.stage is Stage.REFLECT:
                raise ConnectionResetError("peer")
            return await super().read(request)

    verdict = judge_clip(Fails(clean_table(REFLECTING, interaction=WRONG)), REFLECTING)
    assert verdict.status is Status.ERROR and "REFLECT" in verdict.reason and math.isnan(verdict.reward)


def test_a_hacking_pattern_caps_only_when_two_reads_confirm_it() -> None:
    seen = judge_clip(ScriptedJudge(clean_table(RUBRIC, motion=UNUSABLE)), RUBRIC)
    assert [flag.pattern for flag in seen.hack_flags if flag.confirmed] == ["motion"] and len(seen.hack_flags) == 4
    assert seen.stages[2].s == 0.25 and seen.reward == pytest.approx(0.3 + 0.3 * 0.25)
    doubted = judge_clip(ScriptedJudge(clean_table(RUBRIC, motion=[UNUSABLE, CLEAN])), RUBRIC)
    assert not any(flag.confirmed for flag in doubted.hack_flags) and doubted.reward == pytest.approx(1)


def test_an_agent_that_could_not_work_is_refused_at_once() -> None:
    judge = ScriptedJudge(clean_table(PLAIN))
    with pytest.raises(ValueError, match="max_reads must be >= 13, one read of everything, got 12"):
        RewardAgent(judge, PLAIN, max_reads=12)
    with pytest.raises(ValueError, match="budget_s must be > 0, got 0"):
        RewardAgent(judge, PLAIN, budget_s=0)
    del judge.table["robot"]
    with pytest.raises(ValueError, match="scripted does not read robot"):
        RewardAgent(judge, PLAIN)


class LimitedJudge(ScriptedJudge):
    """A scripted judge with other capabilities."""

    def __init__(self, **limits: Any) -> None:
        super().__init__(clean_table(PLAIN))
        self.limits = limits

    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, **self.limits)


def test_a_judge_without_a_list_of_components_reads_any() -> None:
    assert judge_clip(LimitedJudge(components=None)).reward == pytest.approx(1)


def test_a_judge_that_takes_too_few_images_says_so() -> None:
    verdict = judge_clip(LimitedJudge(max_frames=8))
    assert verdict.status is Status.ERROR and "images, the judge takes 8 in a call" in verdict.reason
    with pytest.raises(ValueError, match="2 frames or more, it takes 1"):
        judge_clip(LimitedJudge(max_frames=1))


def test_clips_judged_at_the_same_time_get_the_verdicts_they_get_alone() -> None:
    class Yielding(ScriptedJudge):
        async def read(self, request: ReadRequest) -> list[Read]:
            await asyncio.sleep(0)
            return await super().read(request)

    clips = [make_clip(seed) for seed in range(6)]
    agent = RewardAgent(Yielding(clean_table(RUBRIC, color=[BORDERLINE, WRONG, CLEAN])), load_rubric())

    async def together() -> list[Verdict]:
        return await asyncio.gather(*(agent.evaluate(clip, make_task(clip)) for clip in clips))

    alone = [asyncio.run(agent.evaluate(clip, make_task(clip))).audit_id for clip in clips]
    assert [verdict.audit_id for verdict in asyncio.run(together())] == alone and len(set(alone)) == 6


def test_a_round_with_more_than_a_tenth_invalid_pauses_and_says_why() -> None:
    good = judge_clip(ScriptedJudge(clean_table(PLAIN)))
    bad = judge_clip(FaultyJudge(clean_table(PLAIN), "robot", "error"))
    assert pause_reason([good] * 9 + [bad]) == ""
    assert pause_reason([good] * 8 + [bad] * 2).startswith("2 of 10 verdicts are invalid")
    assert "finish_reason length" in pause_reason([bad])


def test_two_judges_in_one_group_are_refused() -> None:
    one = judge_clip(ScriptedJudge(clean_table(PLAIN)))
    other = replace(one, provenance=replace(one.provenance, model="another"))
    check_one_judge([one, one, other], [0, 0, 1])
    with pytest.raises(ValueError, match="group 1 mixes judges"):
        check_one_judge([one, one, other], [0, 1, 1])
