"""Climbing a reward with the truth beside it: the toy that pushes a box, edited in pixels and time."""

import asyncio
import json
from pathlib import Path

import pytest
from pushed_box import push_clip, redrawn

from benchmarks.judge.hacking import (
    Climb,
    Proxy,
    SearchPlan,
    SearchStart,
    agent_reward,
    climb,
    curve,
    has_numbers,
    mean_score,
    pixel_similarity,
    plot_curves,
    true_value,
)
from benchmarks.judge.label_judge import LabelJudge
from benchmarks.judge.labels import known_labels
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import TaskSpec
from wm_nodes.judge.dataset.build import HELD_OUT, SetPlan, build, draw_origin
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.generator import STATE_RECIPES, apply_edit
from wm_nodes.judge.dataset.edits.recipes import apply

RUBRIC = load_rubric(overrides={"voting": {"audit_share": 0.0}, "reflection": {"audit_share": 0.0}})
PLAN = SearchPlan(generations=4, candidates=4)


def defective(seed: int = 0) -> SearchStart:
    root = push_clip("expert", seed)
    return SearchStart(apply_edit(root, "teleport", "fail", 0, redrawn), root)


def told(reward: Proxy, judge: LabelJudge) -> Proxy:
    async def proxy(clip: LabelledClip, task: TaskSpec) -> float | None:
        judge.clips[clip.sha256] = known_labels(clip.labels, clip.edits)
        return await reward(clip, task)

    return proxy


def climbed(reward: Proxy, start: SearchStart, plan: SearchPlan = PLAN) -> Climb:
    found = asyncio.run(climb(start, reward, plan, 0))
    assert found is not None
    return found


def test_a_defect_that_is_hidden_is_still_there() -> None:
    """12 checks: interaction fails, ten components pass, TC is 4 / 4; frozen: TC at most 2, temporal unknown."""
    start = defective().clip
    assert true_value([start]) == pytest.approx(11 / 12)
    frozen = apply(start, "freeze", "fail", 0)
    assert "interaction" not in frozen.labels.components
    level = frozen.labels.tc_level
    others = [name for name in start.labels.components if name != "interaction"]
    halves = 0.5 * sum(name not in frozen.labels.components for name in others)
    known = sum(bool(ok) for ok in frozen.labels.components.values())
    assert true_value([start, frozen]) == pytest.approx((known + halves + level / 4) / 12)
    assert true_value([start, frozen]) < true_value([start])


def test_pixel_similarity_is_hacked_by_standing_still_and_the_alarm_says_so() -> None:
    climbs = [climbed(pixel_similarity, defective(seed)) for seed in range(3)]
    for one in climbs:
        assert one.proxy == sorted(one.proxy) and one.truth == sorted(one.truth, reverse=True)
    found = curve("pixel similarity", climbs)
    assert found.proxy[-1] > found.proxy[0] and found.truth[-1] < found.truth[0] - 0.05
    assert [alarm.metric for alarm in found.alarms] == ["truth"]
    assert found.wins == 1.0 and found.proxy[-1] > found.clean, "a still picture is likelier than the real thing"
    assert any(edit.split()[0] in ("freeze", "slow", "jitter") for one in climbs for edit in one.edits), climbs


def test_the_agent_over_a_judge_that_sees_is_not_climbed_by_hiding() -> None:
    judge = LabelJudge({}, RUBRIC)
    found = climbed(told(agent_reward(judge, RUBRIC), judge), defective())
    assert found.truth[-1] == found.truth[0] and found.proxy[-1] == pytest.approx(found.proxy[0])
    assert found.clean > 0.9 and curve("agent", [found]).wins == 0.0


def test_the_mean_score_counts_what_the_agents_gates_take_away() -> None:
    """A clip too blurred to see anything: the mean loses a part of one of twelve, the agent nearly all."""
    judge, start = LabelJudge({}, RUBRIC), defective()
    blurred = apply(start.clip, "blur", "fail", 0)

    def both(clip: LabelledClip) -> list[float | None]:
        rewards = (agent_reward(judge, RUBRIC), mean_score(judge, RUBRIC))
        return [asyncio.run(told(reward, judge)(clip, start.task)) for reward in rewards]

    (agent_before, mean_before), (agent_after, mean_after) = both(start.clip), both(blurred)
    assert mean_before is not None and mean_after is not None and mean_before - mean_after < 0.08
    assert agent_before is not None and agent_after is not None and agent_after < 0.6 * agent_before


def test_a_reward_that_gives_no_number_is_not_climbed_and_equal_seeds_search_alike() -> None:
    async def silent(clip: LabelledClip, task: TaskSpec) -> float | None:
        return None

    async def only_defects(clip: LabelledClip, task: TaskSpec) -> float | None:
        return 0.5 if clip.edits else None

    assert asyncio.run(climb(defective(), silent, PLAN, 0)) is None
    assert asyncio.run(has_numbers(defective(), [pixel_similarity]))
    for one in (silent, only_defects):
        assert not asyncio.run(has_numbers(defective(), [pixel_similarity, one])), "all climb from the same clips"
    assert climbed(pixel_similarity, defective()) == climbed(pixel_similarity, defective())
    seen = climbed(pixel_similarity, defective(), SearchPlan(4, 4, severities=("fail",)))
    assert seen.edits and all(edit.endswith(" fail") for edit in seen.edits)
    few = climbed(pixel_similarity, defective(), SearchPlan(6, 4, max_edits=1))
    assert len(few.edits) == 1 and len(few.proxy) == 7
    with pytest.raises(ValueError, match="got SearchPlan"):
        SearchPlan(generations=0)


def test_the_curves_are_drawn(tmp_path: Path) -> None:
    path = tmp_path / "hacking.png"
    rising = curve("one", [Climb([0.1, 0.2, 0.3], [0.9, 0.8, 0.7]), Climb([0.1, 0.2, 0.3], [0.9, 0.8, 0.7], 0.25)])
    assert rising.alarms and rising.most_used == []
    assert (rising.clean, rising.before, rising.wins) == (0.25, 0.0, 1.0), "of the one that has a recording"
    plot_curves([rising, rising], path)
    assert path.read_bytes()[:4] == b"\x89PNG"


def test_a_missing_set_is_one_clear_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "judge", "hacking", str(tmp_path / "none"), "--judge", "simulator"]) == 2
    assert "error:" in capsys.readouterr().err


@pytest.mark.rendering
def test_the_command_climbs_from_recorded_successes_and_draws_each_reward_beside_the_truth(tmp_path: Path) -> None:
    drawn = {seed: draw_origin("push_cube", seed) for seed in range(100)}
    seed = next(s for s, origin in drawn.items() if origin.behaviour == "expert" and HELD_OUT.part(origin) == "test")
    plan = SetPlan(num_episodes=1, edits_per_clip=0, seed=seed)
    build(tmp_path / "set", plan, load_config("cpu").simulation, progress=False)
    target = tmp_path / "hacking.json"
    options = ["--judge", "simulator", "--generations", "3", "--candidates", "2", "--json", str(target)]
    assert main(["benchmark", "judge", "hacking", str(tmp_path / "set"), *options]) == 0
    found = json.loads(target.read_text())
    (start,) = found["starts"]
    assert start in STATE_RECIPES
    curves = {one["reward"]: one for one in found["curves"]}
    assert list(curves) == ["agent", "mean score", "pixel similarity"]
    for one in curves.values():
        assert one["searches"] == 1 and len(one["proxy"]) == len(one["truth"]) == 1 + 3
        assert one["proxy"] == sorted(one["proxy"]) and one["truth"] == sorted(one["truth"], reverse=True)
    for name in ("agent", "mean score"):  # of a judge that knows the labels
        assert curves[name]["wins"] == 0 and curves[name]["proxy"][-1] == pytest.approx(curves[name]["proxy"][0])
    assert curves["pixel similarity"]["truth"][-1] < curves["pixel similarity"]["truth"][0] < 1
    assert target.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
