"""Stages read by different judges: who is asked what, over scripted judges and over two real servers."""

import asyncio
import json
from collections.abc import Sequence
from contextlib import closing, contextmanager
from typing import Any

import pytest
from judge_server import PickyServer, serving
from scripted_judge import CLEAN, COOKING, WRONG, FaultyJudge, ScriptedJudge, clean_table, make_clip, make_task

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.judge.agent.judge import Capabilities, Cost, Judge, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.levels import first_vote, next_vote, settle
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import GATED, Profile, Stage, Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import check_judge, judge_name, make_judge
from wm_nodes.judge.backends.routed import RoutedJudge
from wm_nodes.judge.service import ClipJob, JudgeService

RUBRIC = load_rubric()
CONTACT: Sequence[Stage] = (Stage.PC, Stage.TC)


def verdict_of(judge: Judge, rubric: Rubric = RUBRIC) -> Verdict:
    clip = make_clip()
    return asyncio.run(RewardAgent(judge, rubric, mode="benchmark").evaluate(clip, make_task(clip)))


def stages_asked(judge: ScriptedJudge) -> set[Stage]:
    return {request.stage for request in judge.requests}


def test_each_stage_is_read_by_its_judge_and_the_verdict_is_as_of_one_who_says_all_of_it() -> None:
    first, other = ScriptedJudge(clean_table(RUBRIC)), ScriptedJudge(clean_table(RUBRIC, geometry=WRONG))
    found = verdict_of(RoutedJudge(first, [(CONTACT, other)], RUBRIC))
    assert stages_asked(other) == {*CONTACT} and not stages_asked(first) & {*CONTACT}
    assert {Stage.PLAN, Stage.VQ, Stage.IF, Stage.HACK} <= stages_asked(first)
    alone = verdict_of(ScriptedJudge(clean_table(RUBRIC, geometry=WRONG)))
    assert found.reward == alone.reward < verdict_of(first).reward
    assert found.stages == alone.stages


def test_second_looks_go_to_whoever_reads_the_components_own_stage() -> None:
    table = clean_table(RUBRIC, interaction=WRONG)  # done without an interaction: a reason to look again
    first, other = ScriptedJudge(table), ScriptedJudge(table, second={"interaction": CLEAN})
    found = verdict_of(RoutedJudge(first, [([Stage.PC], other)], RUBRIC))
    assert stages_asked(other) == {Stage.PC, Stage.REFLECT} and Stage.REFLECT in stages_asked(first)
    for judge, stages in ((first, {*GATED} - {Stage.PC}), (other, {Stage.PC})):
        looks = [name for r in judge.requests if r.stage is Stage.REFLECT for name in r.components]
        assert looks and {RUBRIC.stage_of(name) for name in looks} <= stages
    assert found.reflections == verdict_of(ScriptedJudge(table, second={"interaction": CLEAN})).reflections


def test_a_second_look_that_one_judge_does_not_answer_costs_what_the_others_answers_did() -> None:
    table = clean_table(RUBRIC, interaction=WRONG)
    first, other = ScriptedJudge(table), FaultyJudge(table, "interaction", "unavailable")
    clip = make_clip()
    names = ("task_completion", "interaction")
    prior = tuple(settle([Read(name, CLEAN, "json", first_vote(0))], 0.5) for name in names)
    request = ReadRequest(clip, make_task(clip), Stage.REFLECT, names, Profile.D, (first_vote(0),), (), prior=prior)
    with pytest.raises(JudgeError, match="circuit open") as caught:
        asyncio.run(RoutedJudge(first, [([Stage.PC], other)], RUBRIC).read(request))
    assert caught.value.cost == Cost(calls=1 + 4, prompt_tokens=10, retries=3)


def test_other_routes_are_another_judge_and_the_order_of_stages_is_not() -> None:
    first, other = (Named(clean_table(RUBRIC), name) for name in ("first", "other"))
    ids = [
        RoutedJudge(first, [(stages, other)], RUBRIC).capabilities.judge_id
        for stages in ([Stage.TC, Stage.PC], [Stage.PC, Stage.TC], [Stage.PC])
    ]
    assert ids[0] == ids[1] != ids[2] and ids[0].startswith("routed:")
    assert RoutedJudge(other, [([Stage.PC], first)], RUBRIC).capabilities.judge_id not in ids
    able = RoutedJudge(first, [(CONTACT, other)], RUBRIC).capabilities
    assert able.model == "else: first; TC+PC: other" and able.max_frames == 8


class Named(ScriptedJudge):
    def __init__(self, table: Any, name: str) -> None:
        super().__init__(table)
        self.name = name

    @property
    def capabilities(self) -> Capabilities:
        frames = {"first": 8, "other": 16}[self.name]
        components = frozenset(self.table)
        return Capabilities(self.name, "table", self.name, "1", components, max_frames=frames)


def test_a_judge_may_know_its_own_stages_only_and_one_that_lacks_a_component_is_refused_by_name(tmp_path: Any) -> None:
    (tmp_path / "cooking.yaml").write_text(COOKING)
    cooking = load_rubric(str(tmp_path / "cooking.yaml"))
    robot, liquids = ScriptedJudge(clean_table(RUBRIC)), ScriptedJudge(clean_table(cooking))
    with pytest.raises(ValueError, match="scripted does not read liquid; route PC to another judge"):
        RoutedJudge(robot, [([Stage.TC, Stage.HACK], liquids)], cooking)
    assert verdict_of(RoutedJudge(robot, [([Stage.PC, Stage.HACK], liquids)], cooking), cooking).valid
    for stages in ([Stage.REFLECT], [Stage.PC, Stage.PC]):
        with pytest.raises(ValueError, match="each stage has one route and REFLECT follows its components"):
            RoutedJudge(robot, [(stages, robot)], RUBRIC)


def test_a_server_that_can_do_it_is_asked_for_letters_only_and_for_their_probabilities_by_id() -> None:
    with serving(PickyServer()) as server:
        ids = [5, 6, 7, 8, 9]
        values = {"endpoints": [server.url], "model": "judge", "choice_grammar": True, "label_token_ids": ids}
        opened = make_judge(JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values}), RUBRIC)
        clip = make_clip()
        request = ReadRequest(clip, make_task(clip), Stage.VQ, ("clarity",), Profile.S, (next_vote(1, 0),), ())

        async def asked() -> list[Read]:
            reads = await opened.judge.read(request)
            await opened.close()
            return reads

        assert [read.status for read in asyncio.run(asked())] == [Status.OK]
    body = server.requests[-1]
    assert body["structured_outputs"] == {"choice": list("ABCDE")} and body["logprob_token_ids"] == ids
    wrong = JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values, "label_token_ids": [1, 2]})
    with pytest.raises(ValueError, match=r"judge.label_token_ids must hold 5 ids, of A to E, or none, got \[1, 2\]"):
        make_judge(wrong, RUBRIC)


@contextmanager
def clip_judge(first: PickyServer, second: PickyServer, **changes: object) -> Any:
    with serving(first), serving(second):
        route = {"stages": ["TC", "PC"], "endpoints": [second.url], "model": "second"}
        values = {"endpoints": [first.url], "model": "first", "tries": 1, "routes": [route], "mode": "benchmark"}
        settings = JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values, **changes})
        with closing(JudgeService(settings, seed=0)) as judge:
            yield judge


def questions(server: PickyServer, stage: Stage) -> bool:
    """Whether a server was asked the questions of a stage."""
    said = json.dumps([body["messages"] for body in server.requests])
    return any(json.dumps(one.question)[1:-1] in said for one in RUBRIC.stages[stage].components.values())


def test_two_servers_share_the_stages_of_a_clip_and_where_one_is_down_there_is_no_reward() -> None:
    first, second = PickyServer(), PickyServer()
    clips = [ClipJob(clip, make_task(clip)) for clip in map(make_clip, range(2))]
    with clip_judge(first, second) as judge:
        verdicts = judge.judge(clips)
        assert {verdict.status for verdict in verdicts} == {Status.OK}
        assert {v.provenance.model for v in verdicts} == {"else: openai-chat:first; TC+PC: openai-chat:second"}
        assert questions(first, Stage.VQ) and not any(questions(first, stage) for stage in CONTACT)
        assert not questions(second, Stage.VQ) and all(questions(second, stage) for stage in CONTACT)
        second.down = True
        lost = judge.judge(clips)
        assert {verdict.status for verdict in lost} == {Status.ERROR}
        assert all(verdict.reward != verdict.reward for verdict in lost)


@pytest.mark.parametrize(
    ("routes", "words"),
    [
        ([{"stages": ["PC"]}], r"judge\.routes\[0\]: .*set judge\.endpoints"),
        ([{"stages": [s], "endpoints": ["http://b/v1"], "model": "b"} for s in ("PC", "PC")], "PC more than once"),
    ],
    ids=["nobody", "twice"],
)
def test_routes_to_nobody_and_stages_with_two_judges_are_refused_by_name(routes: object, words: str) -> None:
    judge = load_config("base").judge.model_dump()
    values = {**judge, "endpoints": ["http://a/v1"], "model": "first", "routes": routes}
    with pytest.raises(ValueError, match=words):
        check_judge(JudgeConfig.model_validate(values))


def test_the_settings_name_everyone_and_refuse_stages_that_are_none() -> None:
    route = {"stages": ["PC", "TC"], "endpoints": ["http://b/v1"], "model": "b"}
    judge = load_config("smoke", {"judge.kind": "embedded", "judge.routes": [route]}).judge
    check_judge(judge)
    assert judge_name(judge).endswith("; PC+TC by b at http://b/v1")
    for stages in (["REFLECT"], []):
        with pytest.raises(ConfigError, match="stages"):
            load_config("smoke", {"judge.routes": [{**route, "stages": stages}]})
