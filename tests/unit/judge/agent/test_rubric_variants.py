"""The robot pack with a part taken away: what is still read and paid, and what a pack may leave out."""

import asyncio
from typing import Any

import numpy as np
import pytest
from scripted_judge import (
    BORDERLINE,
    CLEAN,
    FAIR,
    GOOD,
    POOR,
    UNUSABLE,
    WRONG,
    ScriptedJudge,
    clean_table,
    make_clip,
    make_task,
)

from wm_nodes.config.load import ConfigError
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import Stage, Status, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.decisions import OVERALL, Decision, accepts, decisions_of

VARIANTS = [
    f"robot_{name}" for name in (
        "all_votes", "no_physics", "no_planning", "no_reflection", "no_votes", "open_gates", "single_read",
    )
]
ROBOT = load_rubric()
DOUBT = (0.0, 0.2, 0.1, 0.0, 0.7)
UNPAID = {"planning": {"weights": [[0.2, 0.3, 0.5, 0]] * 4}}
"""Of PC."""


def judged(pack: str, mode: Any = "reward", **table: Any) -> tuple[Verdict, list[Stage]]:
    """The verdict on one clip, and the stages that were asked for."""
    judge, clip = ScriptedJudge(clean_table(ROBOT, **table)), make_clip()
    quiet = {"voting": {"audit_share": 0}, "reflection": {"audit_share": 0}}
    agent = RewardAgent(judge, load_rubric(pack, quiet), mode=mode)
    return asyncio.run(agent.evaluate(clip, make_task(clip))), [request.stage for request in judge.requests]


@pytest.mark.parametrize("pack", VARIANTS)
@pytest.mark.parametrize("plan", [GOOD, FAIR, POOR])
def test_a_clean_clip_still_earns_one_and_is_a_success(pack: str, plan: tuple[float, ...]) -> None:
    verdict, _ = judged(pack, planning=plan)
    assert verdict.status is Status.OK and verdict.reward == pytest.approx(1)
    assert accepts(verdict) is True and decisions_of(verdict)[OVERALL] == Decision(True, 1.0)


@pytest.mark.parametrize("pack", VARIANTS)
def test_a_clip_that_fails_a_gate_or_the_task_or_shows_nothing_is_no_success(pack: str) -> None:
    for failed in ({"robot": UNUSABLE}, {"task_completion": WRONG}, {"objective": UNUSABLE, "temporal": UNUSABLE}):
        assert accepts(judged(pack, **failed)[0]) is False
    black = clip_ref("black", np.zeros_like(make_clip().frames), 8.0)
    agent = RewardAgent(ScriptedJudge(clean_table(ROBOT)), load_rubric(pack))
    assert accepts(asyncio.run(agent.evaluate(black, make_task(black)))) is False


@pytest.mark.parametrize("mode", ["reward", "benchmark"])
def test_without_physics_its_stage_and_pattern_are_neither_read_nor_paid(mode: str) -> None:
    broken = {"interaction": UNUSABLE, "deformation": UNUSABLE, "geometry": UNUSABLE, "physics": UNUSABLE}
    verdict, asked = judged("robot_no_physics", mode, **broken)
    assert verdict.reward == pytest.approx(1) and judged("robot", mode, **broken)[0].reward == pytest.approx(0.6)
    assert asked == [Stage.PLAN, Stage.VQ, Stage.IF, Stage.TC, Stage.HACK]
    assert [stage.status for stage in verdict.stages] == [Status.OK] * 3 + [Status.SKIPPED]
    assert [flag.pattern for flag in verdict.hack_flags] == ["occlusion", "motion", "background"]
    half = judged("robot_no_physics", mode, task_completion=BORDERLINE)[0]
    assert half.reward == pytest.approx((0.1 + 0.2 + 0.3 * 0.5) / 0.6), "what is left of level 3, renormalised"


def test_without_physics_a_judge_need_not_read_it() -> None:
    rubric = load_rubric("robot_no_physics")
    judge = ScriptedJudge(clean_table(rubric))
    assert not {"interaction", "deformation", "geometry", "physics"} & set(judge.table)
    assert RewardAgent(judge, rubric).judge is judge
    with pytest.raises(ValueError, match="does not read deformation, geometry, interaction, physics"):
        RewardAgent(judge, ROBOT)


def test_without_planning_every_level_is_paid_and_voted_on_alike() -> None:
    rewards = {judged("robot_no_planning", planning=plan, clarity=DOUBT)[0].reward for plan in (GOOD, FAIR, POOR)}
    reads = {judged("robot_no_planning", planning=plan)[0].num_reads for plan in (GOOD, FAIR, POOR)}
    assert len(rewards) == len(reads) == 1
    assert rewards == {judged("robot", planning=GOOD, clarity=DOUBT)[0].reward}
    assert judged("robot", planning=POOR, clarity=DOUBT)[0].reward not in rewards


@pytest.mark.parametrize(("plan", "paid"), [(POOR, 0.80), (FAIR, 0.55), (GOOD, 0.30)])
def test_an_undone_task_is_paid_more_at_a_worse_level_and_alike_without_planning(
    plan: tuple[float, ...], paid: float
) -> None:
    undone = {"planning": plan, "task_completion": UNUSABLE}
    rewards = [judged(pack, **undone)[0].reward for pack in ("robot", "robot_no_planning")]
    assert rewards == pytest.approx([paid, 0.30])


def test_with_single_reads_the_first_answer_decides() -> None:
    table = {"clarity": [DOUBT, CLEAN, CLEAN], "task_completion": [BORDERLINE, CLEAN, CLEAN], "planning": FAIR}
    single, _ = judged("robot_single_read", **table)
    voted, _ = judged("robot", **table)
    assert single.num_reads == 1 + 12 + 4 < voted.num_reads and not single.reflections
    assert [len(score.votes) for stage in single.stages for score in stage.components] == [1] * 12
    assert single.reward < voted.reward


def test_packs_take_away_votes_or_second_looks_alone_or_vote_on_everything() -> None:
    table = {"clarity": [DOUBT, CLEAN, CLEAN], "interaction": UNUSABLE}
    found = {name: judged(f"robot_{name}", **table)[0] for name in ("no_votes", "no_reflection", "all_votes")}
    votes = {
        name: [len(score.votes) for score in verdict.stages[0].components] for name, verdict in found.items()
    }
    assert votes["no_reflection"][0] == 2 and set(votes["all_votes"]) == {2}
    assert found["no_votes"].stages[1].components[0].decided_by == "first read"
    assert found["no_votes"].reflections and not found["no_reflection"].reflections


@pytest.mark.parametrize("mode", ["reward", "benchmark"])
def test_open_gates_pay_what_comes_after_a_failure(mode: str) -> None:
    failed = {"robot": UNUSABLE, "clarity": BORDERLINE}
    (hard, _), (opened, asked) = (judged(pack, mode, **failed) for pack in ("robot", "robot_open_gates"))
    s_vq, s_if = 0.5 * 3.5 / 4 + 0.25, 0.5 * 0.75
    assert hard.reward == pytest.approx(0.1 * s_vq + 0.2 * s_if)
    assert opened.reward == pytest.approx(0.1 * s_vq + 0.2 * s_if + 0.7)
    assert asked.count(Stage.PC) == 1, "read in every mode"


def test_a_confirmed_pattern_takes_its_stage_away_behind_open_gates_too() -> None:
    verdict, _ = judged("robot_open_gates", physics=UNUSABLE, robot=UNUSABLE)
    assert verdict.stages[-1].s == 0 and verdict.reward == pytest.approx(0.1 + 0.2 * 0.5 * 0.75 + 0.3)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"stages": {"PC": None}}, "weights pay PC, which is none of the stages"),
        ({"stages": {"PC": None}, **UNPAID}, "hack.patterns physics cap a stage that is not there"),
        ({"stages": {"PC": None}, **UNPAID, "hack": {"patterns": {"physics": None}}}, "unknown components interaction"),
        ({"stages": dict.fromkeys(("VQ", "IF", "TC", "PC"))}, "stages must be among VQ, IF, TC, PC"),
        ({"stages": {"HACK": {"threshold": 0.5, "profile": "D", "components": {}}}}, "stages"),
    ],
)
def test_a_stage_is_left_out_with_all_that_hangs_on_it(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rubric(overrides=overrides)
