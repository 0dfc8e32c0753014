"""Stage scores, gates, weights, reward, caps, rubric packs, trainer contract (RA-4, RA-9 to RA-12, RA-15)."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scripted_judge import BORDERLINE, CLEAN, COOKING, FAIR, GOOD, INVALID, UNUSABLE, WRONG

from wm_nodes.config.load import ConfigError
from wm_nodes.judge.agent.judge import ComponentScore, Read
from wm_nodes.judge.agent.levels import first_vote, score
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.scoring import apply_caps, plan_weights, reward, skipped_stage, stage_score
from wm_nodes.judge.agent.types import GATED, Stage, Status
from wm_nodes.judge.agent.verdict import StageScore

RUBRICS = {kind: load_rubric(overrides={"reward": {"gate": kind}}) for kind in ("hard", "open")}
ROBOT = RUBRICS["hard"]
VQ, IF, TC, PC = GATED
Levels = tuple[float, ...]

distributions = st.lists(st.integers(0, 10), min_size=5, max_size=5).filter(any).map(
    lambda counts: tuple(count / sum(counts) for count in counts)
)
tables = st.fixed_dictionaries(dict.fromkeys(ROBOT.component_names, distributions))
plans = st.lists(st.integers(0, 10), min_size=4, max_size=4).filter(any).map(
    lambda counts: tuple(count / sum(counts) for count in counts)
)
gates = st.sampled_from(sorted(RUBRICS))


def component(name: str, levels: Levels) -> ComponentScore:
    return score([Read(name, levels, "json", first_vote(0))], "first read")


def stages_of(table: dict[str, Levels], rubric: Rubric = ROBOT) -> list[StageScore]:
    names = {stage: rubric.stages[stage].components for stage in GATED}
    return [stage_score(stage, [component(n, table[n]) for n in names[stage]], rubric) for stage in GATED]


def reward_of(table: dict[str, Levels], p_level: Levels = GOOD, rubric: Rubric = ROBOT) -> float:
    return reward(plan_weights(p_level, rubric.planning), stages_of(table, rubric), rubric)


def everywhere(levels: Levels, rubric: Rubric = ROBOT, **changed: Levels) -> dict[str, Levels]:
    return dict.fromkeys(rubric.component_names, levels) | changed


def raised(levels: Levels, low: int, high: int, share: float) -> Levels:
    """Move a share of one level's probability to a higher level."""
    moved = levels[low] * share
    return tuple(p - moved * (i == low) + moved * (i == high) for i, p in enumerate(levels))


def test_the_pack_holds_the_eleven_components_task_completion_and_five_levels_each() -> None:
    assert [len(ROBOT.stages[stage].components) for stage in GATED] == [4, 4, 1, 3]
    for stage in GATED:
        for described in ROBOT.stages[stage].components.values():
            assert len(set(described.levels)) == 5 and described.question != described.defect
    assert [ROBOT.stages[stage].threshold for stage in GATED] == [0.60, 0.55, 0.30, 0.50]


def test_stage_score_worked_by_hand() -> None:
    stage = stages_of(everywhere(CLEAN, clarity=BORDERLINE))[0]
    assert stage.s == pytest.approx(0.5 * 3.5 / 4 + 0.5 * 0.5) and stage.passed
    heavy = load_rubric(overrides={"stages": {"VQ": {"components": {"clarity": {"weight": 3.0}}}}})
    assert stages_of(everywhere(CLEAN, clarity=BORDERLINE), heavy)[0].s == pytest.approx(0.5 * 4.5 / 6 + 0.5 * 0.5)


def test_a_veto_fails_a_stage_that_is_above_its_threshold() -> None:
    split = (0.0, 0.8, 0.0, 0.0, 0.2)  # s 0.4, p_fail 0.8
    stage = stages_of(everywhere(CLEAN, color=split))[0]
    assert stage.s > 0.60 and not stage.passed and stage.vetoed_by == "color"


def test_reward_worked_by_hand_for_every_kind_of_gate() -> None:
    table = everywhere(CLEAN, interaction=BORDERLINE)
    s_pc = 0.5 * 2.5 / 3 + 0.5 * 0.5
    assert reward_of(table) == pytest.approx(0.6 + 0.4 * s_pc)
    assert reward_of(table, FAIR) == pytest.approx(0.8 + 0.2 * s_pc)
    assert reward_of(table, rubric=RUBRICS["open"]) == pytest.approx(0.6 + 0.4 * s_pc)
    failed = everywhere(CLEAN, robot=UNUSABLE)
    s_if = 0.5 * 0.75
    assert reward_of(failed) == pytest.approx(0.1 + 0.2 * s_if)
    assert reward_of(failed, rubric=RUBRICS["open"]) == pytest.approx(0.1 + 0.2 * s_if + 0.7)


def test_planning_weights_are_soft() -> None:
    halfway = plan_weights((0.0, 0.0, 0.5, 0.5), ROBOT.planning)
    assert halfway == pytest.approx({VQ: 0.175, IF: 0.25, TC: 0.275, PC: 0.30})
    assert sum(plan_weights(INVALID, ROBOT.planning).values()) == pytest.approx(0.1)


@settings(max_examples=60)
@given(tables, plans, gates)
def test_reward_is_bounded(table: dict[str, Levels], p_level: Levels, kind: str) -> None:
    assert 0 <= reward_of(table, p_level, RUBRICS[kind]) <= 1


@settings(max_examples=150)
@given(tables, plans, gates, st.sampled_from(ROBOT.component_names), st.integers(0, 3), st.floats(0, 1), st.data())
def test_reward_is_monotone_in_every_component(
    table: dict[str, Levels], p_level: Levels, kind: str, name: str, low: int, share: float, data: st.DataObject
) -> None:
    better = table | {name: raised(table[name], low, data.draw(st.integers(low + 1, 4)), share)}
    rubric = RUBRICS[kind]
    assert reward_of(better, p_level, rubric) >= reward_of(table, p_level, rubric) - 1e-12


@settings(max_examples=60)
@given(tables, tables, plans, st.sampled_from([VQ, IF, TC]))
def test_behind_a_failed_gate_no_score_counts(
    table: dict[str, Levels], other: dict[str, Levels], p_level: Levels, failed: Stage
) -> None:
    table = table | dict.fromkeys(ROBOT.stages[failed].components, WRONG)
    behind = [name for stage in GATED[GATED.index(failed) + 1 :] for name in ROBOT.stages[stage].components]
    changed = table | {name: other[name] for name in behind}
    assert reward_of(changed, p_level) == reward_of(table, p_level)
    read = GATED[: GATED.index(failed) + 1]
    unread = [s if s.stage in read else skipped_stage(s.stage) for s in stages_of(table, ROBOT)]
    assert reward(plan_weights(p_level, ROBOT.planning), unread, ROBOT) == reward_of(table, p_level)


@pytest.mark.parametrize("kind", sorted(RUBRICS))
def test_the_best_clip_earns_one_and_an_invalid_one_a_tenth_at_most(kind: str) -> None:
    rubric = RUBRICS[kind]
    assert reward_of(everywhere(CLEAN), GOOD, rubric) == pytest.approx(1)
    assert reward_of(everywhere(CLEAN), FAIR, rubric) == pytest.approx(1)
    assert reward_of(everywhere(CLEAN), INVALID, rubric) <= 0.1 + 1e-12
    assert reward_of(everywhere(UNUSABLE), GOOD, rubric) == 0


@settings(max_examples=60)
@given(tables, plans, gates, st.sets(st.sampled_from(sorted(ROBOT.hack.patterns)), min_size=1))
def test_a_confirmed_pattern_never_raises_a_reward(
    table: dict[str, Levels], p_level: Levels, kind: str, patterns: set[str]
) -> None:
    rubric, before = RUBRICS[kind], stages_of(table, RUBRICS[kind])
    weights = plan_weights(p_level, rubric.planning)
    after = apply_caps(before, sorted(patterns), rubric)
    assert reward(weights, after, rubric) <= reward(weights, before, rubric) + 1e-12
    assert after == apply_caps(before, sorted(patterns, reverse=True), rubric)


@pytest.mark.parametrize(
    ("pattern", "failed", "s"),
    [("occlusion", VQ, 0.53125), ("motion", TC, 0.25), ("background", IF, 0.53125), ("physics", PC, 0.0)],
)
def test_a_confirmed_pattern_fails_the_stage_it_hides_in(pattern: str, failed: Stage, s: float) -> None:
    after = {stage.stage: stage for stage in apply_caps(stages_of(everywhere(CLEAN)), [pattern], ROBOT)}
    assert after[failed].s == pytest.approx(s) and not after[failed].passed
    assert all(stage.passed for name, stage in after.items() if name is not failed)


@pytest.mark.parametrize("status", [Status.ERROR, Status.ABSTAIN])
@pytest.mark.parametrize("where", range(4))
def test_a_stage_without_a_number_makes_the_reward_nan(status: Status, where: int) -> None:
    stages = stages_of(everywhere(CLEAN))
    stages[where] = replace(stages[where], status=status, s=math.nan, passed=False)
    assert math.isnan(reward(plan_weights(GOOD, ROBOT.planning), stages, ROBOT))


def test_stages_out_of_order_and_skipped_ones_behind_an_open_gate_are_refused() -> None:
    weights, stages = plan_weights(GOOD, ROBOT.planning), stages_of(everywhere(CLEAN))
    with pytest.raises(ValueError, match="got PC, TC, IF, VQ"):
        reward(weights, stages[::-1], ROBOT)
    with pytest.raises(ValueError, match="TC was skipped"):
        reward(weights, [*stages[:2], skipped_stage(TC), skipped_stage(PC)], ROBOT)


def test_another_domain_adds_components_and_patterns_with_a_file_alone(tmp_path: Path) -> None:
    file = tmp_path / "cooking.yaml"
    file.write_text(COOKING)
    cooking = load_rubric(str(file))
    assert cooking.component_names == (*ROBOT.component_names, "liquid")
    assert cooking.version.startswith("cooking-3-") and cooking.version != ROBOT.version
    stage = stages_of(everywhere(CLEAN, cooking, liquid=BORDERLINE), cooking)[3]
    assert stage.s == pytest.approx(0.5 * 4 / 5 + 0.5 * 0.5)
    clean = stages_of(everywhere(CLEAN, cooking), cooking)
    assert not apply_caps(clean, ["spill"], cooking)[3].passed
    both = apply_caps(clean, ["physics", "spill"], cooking)[3]
    other_order = apply_caps(clean, ["spill", "physics"], cooking)[3]
    assert both.s == 0 and both == replace(other_order, vetoed_by="hack physics")


def test_the_version_differs_with_every_word() -> None:
    changed = load_rubric(overrides={"planning": {"question": "How good?"}})
    assert changed.version.rsplit("-", 1)[0] == "robot-1" and changed.version != ROBOT.version
    assert load_rubric().version == ROBOT.version


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"stages": {"VQ": {"threshold": 1.5}}}, "stages.VQ.threshold"),
        ({"stages": {"VQ": {"components": {"clarity": {"levels": ["bad", "good"]}}}}}, "clarity.levels"),
        ({"planning": {"weights": [[0.5, 0, 0, 0]] * 4}}, "sum to 0.5"),
        ({"voting": {"k": 4}}, "k must be odd"),
        ({"hack": {"patterns": {"motion": {"cap": {"component": "sharpness"}}}}}, "unknown components sharpness"),
        ({"stages": {"IF": {"components": {"clarity": {}}}}}, "clarity"),
        ({"hack": {"patterns": {"motion": {"cap": {"stage": "PC"}}}}}, "either a component or"),
        ({"reward": {"gate": "soft"}}, "reward.gate"),
        ({"thresholds": {}}, "thresholds"),
    ],
)
def test_a_pack_that_makes_no_sense_is_refused_by_name(overrides: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rubric(overrides=overrides)


def test_unknown_and_circular_packs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="choose one of robot"):
        load_rubric("cooking")
    loop = tmp_path / "loop.yaml"
    loop.write_text(f"extends: {loop}\n")
    with pytest.raises(ConfigError, match="in a circle"):
        load_rubric(str(loop))


def test_a_component_in_two_stages_is_refused() -> None:
    described = ROBOT.stages[VQ].components["clarity"].model_dump()
    with pytest.raises(ConfigError, match="in two stages"):
        load_rubric(overrides={"stages": {"IF": {"components": {"clarity": described}}}})


def test_scores_of_components_in_any_order_give_one_stage_score() -> None:
    scores = [component(name, levels) for name, levels in zip(ROBOT.stages[PC].components, (CLEAN, WRONG, BORDERLINE))]
    found = {stage_score(PC, [scores[i] for i in order], ROBOT).s for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0))}
    assert len(found) == 1 and np.isfinite(found.pop())
