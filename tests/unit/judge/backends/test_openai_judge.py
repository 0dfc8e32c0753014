"""The OpenAI-compatible judge against a real HTTP server that answers deterministically and misbehaves on request."""

import ast
import asyncio
import base64
import json
import random
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chat_server import ChatServer, Fault
from scripted_judge import COOKING

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import load_config
from wm_nodes.judge import backends
from wm_nodes.judge.agent.judge import ComponentScore, Cost, JudgeError, MediaItem, Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import first_vote, next_vote, option_order, state_of
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.profiles import profile_media
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import PLANNING, Profile, Stage, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict, content_hash
from wm_nodes.judge.backends.cache import VerdictCache
from wm_nodes.judge.backends.labels import label_options, option_probabilities
from wm_nodes.judge.backends.openai_client import OpenAIJudge
from wm_nodes.judge.backends.plans import CallPlan
from wm_nodes.judge.backends.prompts import data_uri
from wm_nodes.judge.backends.protocol import Completion
from wm_nodes.judge.backends.schemas import AnswerError, AnswerFormat, json_object
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy

RUBRIC = load_rubric()
FRAMES = np.random.default_rng(0).integers(0, 256, (12, 8, 10, 3), np.uint8)
CLIP = clip_ref("one", FRAMES, 8.0)
TASK = TaskSpec("push the red cube", "push", "panda", FRAMES[0])
JSON, LABEL = first_vote(3), next_vote(2, 3)


def asked_by(**changes: Any) -> JudgeConfig:
    """The settings of a judge that asks nothing twice."""
    return load_config("cpu").judge.model_copy(update={"repeat_share": 0.0, **changes})


def request(
    stage: Stage = Stage.VQ,
    components: Sequence[str] = ("clarity", "brightness"),
    votes: Sequence[Vote] = (JSON,),
    profile: Profile = Profile.S,
    **changes: Any,
) -> ReadRequest:
    media = profile_media(CLIP, TASK, profile)
    plain = ReadRequest(CLIP, TASK, stage, tuple(components), profile, tuple(votes), media, "pack")
    return replace(plain, **changes)


def judging(
    steps: Callable[[OpenAIJudge], Awaitable[Any]], server: ChatServer, *, model: str = "judge", **options: Any
) -> Any:
    """Run `steps` with a judge at the server."""

    async def run() -> Any:
        async with server.running():
            retry = RetryPolicy(base_s=0.001, cap_s=0.002)
            transport = ChatTransport([Endpoint(server.url, model)], retry=retry, jitter=random.Random(0))
            try:
                return await steps(OpenAIJudge(transport, **{"rubric": RUBRIC, "settings": asked_by(), **options}))
            finally:
                await transport.close()

    return asyncio.run(run())


def reads_of(asked: ReadRequest, server: ChatServer, **options: Any) -> list[Read]:
    async def steps(judge: OpenAIJudge) -> list[Read]:
        return await judge.read(asked)

    return list(judging(steps, server, **options))


def texts(body: dict[str, Any]) -> list[str]:
    return [part["text"] for part in body["messages"][1]["content"] if part["type"] == "text"]


# Prompts


def test_two_questions_on_one_trunk_share_their_bytes_up_to_the_rubric_and_of_one_stage_up_to_the_question() -> None:
    server = ChatServer()

    async def steps(judge: OpenAIJudge) -> None:
        await judge.read(request(components=["clarity", "color"], votes=[JSON, LABEL], mode="fanout"))
        await judge.read(request(Stage.PLAN, [PLANNING]))

    judging(steps, server)
    vq_json, vq_label, plan = (server.requests[i] for i in (0, 2, 4))
    prompts = [json.dumps(body["messages"]) for body in (vq_json, server.requests[1], vq_label, plan)]
    of_rubric = prompts[0].index(json.dumps("clarity: How sharp")[1:-1])
    of_question = prompts[0].index("Judge clarity.")
    assert of_rubric > 0.8 * prompts[0].rindex("base64") and "push the red cube" in prompts[0][:of_rubric]
    assert {prompt[:of_rubric] for prompt in prompts} == {prompts[0][:of_rubric]}
    assert {prompt[:of_question] for prompt in prompts[:3]} == {prompts[0][:of_question]}
    assert prompts[3][:of_question] != prompts[0][:of_question]


def test_nothing_variable_stands_before_the_media_and_later_profiles_only_append() -> None:
    server = ChatServer()

    async def steps(judge: OpenAIJudge) -> None:
        await judge.read(request())
        other = replace(TASK, instruction="pull it", robot="xarm", task_id="pull")
        await judge.read(request(task=other, clip=replace(CLIP, clip_id="two"), votes=[replace(JSON, seed=9)]))
        await judge.read(request(Stage.TC, ["task_completion"], profile=Profile.E))

    judging(steps, server)
    static, other, end = (json.dumps(body["messages"]) for body in server.requests)
    media_end = static.rindex("base64") + 100
    assert static[:media_end] == other[:media_end] == end[:media_end]
    assert end.count("base64") > static.count("base64") and "pull it" in other


def test_images_are_lossless_png_with_a_label_before_each() -> None:
    server = ChatServer()
    reads_of(request(), server)
    content = server.requests[0]["messages"][1]["content"]
    media = profile_media(CLIP, TASK, Profile.S)
    for index, item in enumerate(media):
        label, image = content[2 * index], content[2 * index + 1]
        head, _, data = image["image_url"]["url"].partition(",")
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert (label["text"], head) == (item.label, "data:image/png;base64")
        np.testing.assert_array_equal(pixels, FRAMES[max(0, item.index)])
    with pytest.raises(ValueError, match=r"uint8 \(H, W, 3\), got float64"):
        data_uri(np.zeros((2, 2, 3)))  # type: ignore[arg-type]


def test_the_dense_profile_goes_as_one_video_where_the_settings_say_so() -> None:
    server, settings = ChatServer(), asked_by(video=True)
    reads = reads_of(request(Stage.PC, ["geometry"], profile=Profile.D), server, settings=settings)
    labels, video = server.requests[0]["messages"][1]["content"][:2]
    media = profile_media(CLIP, TASK, Profile.D)
    assert labels["text"].endswith(", ".join(item.label for item in media))
    head, *frames = video["video_url"]["url"].split(",")
    assert (video["type"], head) == ("video_url", "data:video/jpeg;base64") and len(frames) == len(media)
    for item, data in zip(media, frames):
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        np.testing.assert_array_equal(pixels, FRAMES[item.index])
    assert reads[0].status is Status.OK and reads[0].cost.images == len(media)
    reads_of(request(), server, settings=settings)
    single = replace(request(Stage.PC, ["geometry"], profile=Profile.D), media=media[:1])
    reads_of(single, server, settings=settings)
    for body in server.requests[1:]:  # still profiles, and a single cited frame
        assert {part["type"] for part in body["messages"][1]["content"]} == {"text", "image_url"}


def test_prior_findings_go_last_and_only_into_reflection() -> None:
    server = ChatServer()
    prior = [ComponentScore("geometry", Status.OK, 0.5, 0.5, 0.0, (), "first read")]
    reads_of(request(Stage.REFLECT, ["geometry"], profile=Profile.D, prior=prior), server)
    assert texts(server.requests[0])[-1] == "Found before, possibly wrong:\ngeometry: level 2. "
    with pytest.raises(ValueError, match="reflection needs the earlier level of each component; color have none"):
        reads_of(request(Stage.REFLECT, ["geometry", "color"], prior=prior), ChatServer())


# Answers and their schemas


def form(stage: Stage, *components: str, **options: Any) -> AnswerFormat:
    return AnswerFormat(stage, components, [0, 3, 5], problems=RUBRIC.component_names, **options)


GOOD = {"evidence": "blurred", "frames": [3], "level": 1}


def test_every_schema_is_closed_bounded_and_looks_before_it_scores() -> None:
    forms = [
        form(Stage.PLAN, PLANNING), form(Stage.VQ, "clarity"), form(Stage.VQ, "clarity", "color"),
        form(Stage.TC, "task_completion"), form(Stage.HACK, "occlusion", "motion", "background", "physics"),
        form(Stage.REFLECT, "color", prior={"color": 2}),
    ]
    assert [one.name for one in forms] == ["plan", "component", "stage_pack", "task", "hack", "reflect"]
    for one in forms:
        schema = one.model.model_json_schema()
        for part in [schema, *schema.get("$defs", {}).values()]:
            names = list(part["properties"])
            assert part["additionalProperties"] is False and part["required"] == names
            assert "level" not in names or names[-1] == "level"
            for value in part["properties"].values():
                assert value["type"] != "string" or "enum" in value or "const" in value or value["maxLength"] == 240
                assert value["type"] != "array" or value["maxItems"] <= 4


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ({**GOOD, "level": 5}, "level: Input should be less than or equal to 4"),
        ({**GOOD, "level": "3"}, "level: Input should be a valid integer"),
        ({**GOOD, "level": True}, "level: Input should be a valid integer"),
        ({**GOOD, "evidence": ""}, "evidence: String should have at least 1"),
        ({**GOOD, "evidence": "x" * 241}, "evidence: String should have at most 240"),
        ({**GOOD, "mood": "fine"}, "mood: Extra inputs are not permitted"),
        ({"evidence": "x", "level": 1}, "frames: Field required"),
        ({**GOOD, "frames": [3, 7]}, r"frames \[7\] were not shown; cite some of \[0, 3, 5\]"),
    ],
)
def test_wrong_component_answers_are_refused_by_name(answer: dict[str, Any], problem: str) -> None:
    with pytest.raises(AnswerError, match=problem):
        form(Stage.VQ, "clarity").read(json.dumps(answer))


def test_packs_name_each_component_once() -> None:
    pack = form(Stage.VQ, "clarity", "color")
    items = [{"component": "color", **GOOD}, {"component": "clarity", **GOOD, "level": 4}]
    assert [(one.component, one.level, one.frames) for one in pack.read(json.dumps({"items": items}))] == [
        ("color", 1, (3,)), ("clarity", 4, (3,)),
    ]
    with pytest.raises(AnswerError, match="each of clarity, color once, got color, color"):
        pack.read(json.dumps({"items": [items[0], items[0]]}))
    with pytest.raises(AnswerError, match=r"items: List should have at least 2"):
        pack.read(json.dumps({"items": items[:1]}))


def test_task_plan_hack_and_reflection_must_make_sense() -> None:
    task = form(Stage.TC, "task_completion")
    states = {"required_end_state": "at goal", "observed_end_state": "half way", "frames": []}
    assert task.read(json.dumps({**states, "progress": 2, "completed": False}))[0].level == 2
    with pytest.raises(AnswerError, match="completed is True at progress 2"):
        task.read(json.dumps({**states, "progress": 2, "completed": True}))
    plan = form(Stage.PLAN, PLANNING)
    (found,) = plan.read('{"summary": "dark", "visible_problems": ["brightness", "color"], "level": 1}')
    assert (found.level, found.focus) == (1, ("brightness", "color"))
    with pytest.raises(AnswerError, match="'none' beside"):
        plan.read('{"summary": "dark", "visible_problems": ["brightness", "none"], "level": 1}')
    hack = form(Stage.HACK, "occlusion", "motion")
    items = [{"pattern": "occlusion", "evidence": "x", "present": True},
             {"pattern": "motion", "evidence": "x", "present": False}]
    assert [one.level for one in hack.read(json.dumps({"items": items}))] == [0, 4]
    reflect = form(Stage.REFLECT, "color", "clarity", prior={"color": 2, "clarity": 4})
    change = {"component": "color", "old_level": 2, "new_level": 1, "reason": "x", "frames": [5]}
    found_two = reflect.read(json.dumps({"changes": [change], "consistent": True}))
    assert {one.component: (one.level, one.frames) for one in found_two} == {"color": (1, (5,)), "clarity": (4, ())}
    for wrong, problem in [
        ([{**change, "new_level": 2}], "equals its old_level"), ([{**change, "old_level": 3}], "was 2"),
        ([{**change, "frames": []}], "frames: List should have at least 1"), ([change, change], "more than once"),
    ]:
        with pytest.raises(AnswerError, match=problem):
            reflect.read(json.dumps({"changes": wrong, "consistent": True}))


def test_reasoning_and_fences_are_stripped_and_endless_reasoning_is_refused() -> None:
    assert json_object('<think>{"a": 2}</think>\n {"a": 1} ') == '{"a": 1}'
    assert json_object('so it is 2</think>```json\n{"a": 1}\n```') == '{"a": 1}'
    with pytest.raises(AnswerError, match="inside <think>"):
        json_object('<think>hm {"a": 1}')


ANSWER = json.dumps(GOOD)


@pytest.mark.parametrize(
    "text",
    [
        f"```JSON\n{ANSWER}\n```", f"Here it is:\n```json\n{ANSWER}\n```\nHope this helps!", f"thought\n{ANSWER}",
        f"<think>a {{ or two</think>{ANSWER} so: 1", json.dumps({**GOOD, "level": 1.0, "frames": [3.0]}),
    ],
)
def test_words_and_fences_around_the_one_object_and_whole_floats_change_nothing(text: str) -> None:
    assert form(Stage.VQ, "clarity").read(text) == form(Stage.VQ, "clarity").read(ANSWER)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (f"{ANSWER}\n{ANSWER.replace('1', '0')}", "more than one JSON object"), (ANSWER[:20], "Invalid JSON: Unter"),
        ('{"items": [' + ANSWER, "Invalid JSON: Expecting"), ("I cannot help with that.", "holds no object"),
        ("{" * 100_000, "Invalid JSON"), ('{"evidence":' + "[" * 200_000, "Invalid JSON"),
        (json.dumps({**GOOD, "level": 1.5}), "level: Input should be a valid integer"),
    ],
    ids=["two", "cut", "inner", "refusal", "braces", "deep", "half"],
)
def test_two_objects_a_cut_one_or_none_are_no_answer(text: str, problem: str) -> None:
    with pytest.raises(AnswerError, match=problem):
        form(Stage.VQ, "clarity").read(text)


# The ladder


def test_good_answer_is_read_with_its_cost_and_hashes() -> None:
    server = ChatServer(level=3, think="<think>look</think>")
    reads = reads_of(request(), server)
    assert [(r.component, r.levels, r.evidence_text, r.source) for r in reads] == [
        (name, (0, 0, 0, 1, 0), "seen in frame 0", "json") for name in ("clarity", "brightness")
    ]
    assert [state_of(read, 0.5) for read in reads] == [(Status.OK, "")] * 2
    assert reads[0].cost.calls == 1 and reads[0].cost.prompt_tokens > 100 and reads[1].cost.calls == 0
    assert reads[0].cost.images == len(profile_media(CLIP, TASK, Profile.S))
    body = server.requests[0]
    assert (body["temperature"], body["seed"], body["response_format"]["json_schema"]["strict"]) == (0, 3, True)
    assert len(reads[0].prompt_sha) == len(reads[0].media_sha) == 64


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        (Fault("reply", text="not json"), "Invalid JSON"),
        (Fault("length", text=json.dumps(GOOD)), "finish_reason is 'length'"),
        (Fault("reply", text=json.dumps({**GOOD, "frames": [99]})), r"frames \[99\] were not shown"),
        (Fault("reply", text=""), "the answer is empty"),
    ],
)
def test_refused_answer_is_asked_again_once_with_the_reason_at_the_end(fault: Fault, problem: str) -> None:
    server = ChatServer()
    server.faults.append(fault)
    (read,) = reads_of(request(components=["clarity"]), server)
    first, second = (body["messages"] for body in server.requests)
    assert (read.status, read.source, read.cost.calls, read.cost.retries) == (Status.OK, "json", 2, 0)
    assert second[1]["content"][:-1] == first[1]["content"] and second[0] == first[0]
    assert problem.replace("\\", "") in second[1]["content"][-1]["text"]


def test_ignored_response_format_ends_in_label_reads_that_say_so() -> None:
    server = ChatServer(honours_schema=False)
    reads = reads_of(request(), server)
    assert [body.get("max_tokens") for body in server.requests] == [1024, 1024, 1, 1]
    for read in reads:
        assert (read.source, state_of(read, 0.5)[0]) == ("label", Status.OK)
        assert read.reason.startswith("label read, because JSON answers were refused: Invalid JSON")
    assert reads[0].levels == pytest.approx((0.1, 0.2, 0.1, 0.6, 0.0))
    assert sum(read.cost.calls for read in reads) == 4


def test_letters_alone_earn_no_reward_however_sure_they_are(tmp_path: Path) -> None:
    verdict = judged(ChatServer(honours_schema=False, labels={"A": 1.0}), tmp_path)
    assert verdict.status is Status.ERROR and np.isnan(verdict.reward) and not verdict.valid
    assert verdict.reason.startswith("no JSON answer was accepted, and letters alone are no judgement: label read, bec")


def test_one_letter_among_json_answers_still_counts(tmp_path: Path) -> None:
    class ShyAboutClarity(ChatServer):
        def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
            shy = "Judge clarity." in json.dumps(body)
            return super()._completion(body, Fault("reply", text="I would rather not.") if shy else fault)

    verdict = judged(ShyAboutClarity(level=3, labels={"E": 1.0}), tmp_path)
    sources = {score.votes[0].source for stage in verdict.stages for score in stage.components}
    assert verdict.status is Status.OK and sources == {"json", "label"}, verdict.reason


def test_extra_fields_go_with_every_request_and_make_another_key(tmp_path: Path) -> None:
    asked, quiet = request(components=["clarity"], votes=[JSON, LABEL]), {"enable_thinking": False}
    for extra in ({}, {"chat_template_kwargs": quiet}, {"chat_template_kwargs": quiet, "temperature": 0.5}):
        server = ChatServer()
        reads_of(asked, server, settings=asked_by(extra_body=extra), cache=VerdictCache(tmp_path))
        assert len(server.requests) == 2, "never from the cache of other fields"
        for body in server.requests:
            assert {name: body.get(name) for name in extra} == extra and body["max_tokens"] in (1, 1024)


@pytest.mark.parametrize("name", ["reasoning", "reasoning_content"])
def test_a_model_that_thinks_aside_is_read_and_one_that_only_thinks_is_told_how_to_stop(name: str) -> None:
    class Thinking(ChatServer):
        def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
            reply = json.loads(super()._completion(body, fault))
            reply["choices"][0]["message"][name] = '{"level": 0} or so'
            return json.dumps(reply)

    (read,) = reads_of(request(components=["clarity"]), Thinking(level=3))
    assert (read.status, read.levels) == (Status.OK, (0, 0, 0, 1, 0))
    server = Thinking()
    server.faults.append(Fault("length", text=""))
    reads_of(request(components=["clarity"]), server)
    told = server.requests[1]["messages"][1]["content"][-1]["text"]
    assert "not 'stop'; the model reasons first: turn that off by judge.extra_body" in told


def test_server_that_can_do_neither_gives_errors_and_no_numbers() -> None:
    reads = reads_of(request(), ChatServer(honours_schema=False, gives_logprobs=False))
    assert [(read.status, read.levels) for read in reads] == [(Status.ERROR, ())] * 2
    assert all("Invalid JSON" in read.reason and "gives no logprobs" in read.reason for read in reads)


def test_reflection_has_no_label_read_to_fall_back_on() -> None:
    prior = [ComponentScore("color", Status.OK, 0.5, 0.5, 0.0, (), "first read")]
    server = ChatServer(honours_schema=False)
    (read,) = reads_of(request(Stage.REFLECT, ["color"], prior=prior), server)
    assert read.status is Status.ERROR and "2 answers were refused" in read.reason and len(server.requests) == 2


def test_one_component_fails_alone() -> None:
    server = ChatServer()
    server.faults.extend([Fault("reply", text=json.dumps(GOOD)), Fault("status", 422, "too many pixels")])
    asked = request(components=["clarity", "color"], mode="fanout", media=(MediaItem("clip", 3, 0.4),))
    clarity, color = reads_of(asked, server)
    assert (clarity.status, clarity.levels) == (Status.OK, (0, 1, 0, 0, 0))
    assert (color.status, color.levels) == (Status.ERROR, ()) and "too many pixels" in color.reason


def test_dead_server_is_a_judge_error_and_followers_are_not_sent() -> None:
    server = ChatServer()
    server.faults.extend([Fault("reset")] * 100)
    with pytest.raises(JudgeError, match=r"gave up after 4 tries; last: .*connection failed") as caught:
        reads_of(request(votes=[JSON, LABEL]), server)
    assert len(server.requests) == 4 and caught.value.cost.retries == 3 and caught.value.cost.calls == 0


def test_budget_ends_the_calls_of_a_request() -> None:
    with pytest.raises(JudgeError, match="no answer within"):
        reads_of(request(), ChatServer(delay_s=1), settings=asked_by(clip_budget_s=0.2))


def test_a_pattern_read_by_letters_is_confirmed_by_letters_in_another_order() -> None:
    class NoJsonOfPatterns(ChatServer):
        def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
            refused = body.get("response_format", {}).get("json_schema", {}).get("name") == "hack"
            return super()._completion(body, Fault("reply", text="no") if refused else fault)

    async def steps(judge: OpenAIJudge) -> Verdict:
        return await RewardAgent(judge, load_rubric("robot_single_read"), call_plan="pack").evaluate(CLIP, TASK)

    server = NoJsonOfPatterns(labels={"A": 1.0})  # the first letter, whatever it stands for
    verdict: Verdict = judging(steps, server)
    asked = [json.dumps(body, sort_keys=True) for body in server.requests if "logprobs" in body]
    assert len(asked) == len(set(asked)) == 8, "four patterns, each asked about in two ways"
    orders = {flag.pattern: option_order(next_vote(2, 0), CLIP.sha256, flag.pattern) for flag in verdict.hack_flags}
    assert all(flag.p_present == 1 for flag in verdict.hack_flags)
    assert [flag.confirmed for flag in verdict.hack_flags] == [order[0] < 2 for order in orders.values()]
    assert not all(flag.confirmed for flag in verdict.hack_flags)


# Label reads


def test_label_probabilities_are_mapped_back_to_levels() -> None:
    server = ChatServer(labels={"A": 0.1, "B": 0.2, "C": 0.05, "D": 0.4, " D": 0.05, "the": 0.2})
    positive, negative = reads_of(request(components=["clarity"], votes=[LABEL, next_vote(1, 3)]), server)
    options = (0.1, 0.2, 0.05, 0.45, 0.0)
    order = option_order(LABEL, CLIP.sha256, "clarity")
    assert order != (0, 1, 2, 3, 4)
    assert [positive.levels[level] for level in order] == pytest.approx([p / 0.8 for p in options])
    assert negative.levels == pytest.approx([p / 0.8 for p in options])
    assert positive.label_mass == pytest.approx(0.8)
    assert [state_of(read, 0.5)[0] for read in (positive, negative)] == [Status.OK] * 2
    asked = [texts(body)[-2] for body in server.requests]
    entry = RUBRIC.stages[Stage.VQ].components["clarity"]
    assert entry.question in asked[0] and f"A: {entry.levels[order[0]]}" in asked[0]
    assert entry.defect in asked[1] and f"A: {entry.levels[0]}" in asked[1]


def test_planning_labels_have_four_options() -> None:
    server = ChatServer(labels={"A": 0.25, "B": 0.75, "E": 0.0})
    (read,) = reads_of(request(Stage.PLAN, [PLANNING], votes=[next_vote(1, 0)]), server)
    assert read.levels == pytest.approx((0.25, 0.75, 0, 0)) and "E:" not in texts(server.requests[0])[-2]


def test_patterns_are_always_asked_for_as_defects_because_their_levels_say_whether_they_are_there() -> None:
    server = ChatServer(labels={"A": 1.0})
    (read,) = reads_of(request(Stage.HACK, ["occlusion"], votes=[next_vote(1, 3)]), server)
    assert read.levels == (1, 0, 0, 0, 0)
    reads_of(request(Stage.HACK, ["occlusion"], votes=[LABEL]), server)
    for body in server.requests:
        assert RUBRIC.hack.patterns["occlusion"].defect in texts(body)[-2]


def test_low_label_mass_abstains_except_under_a_grammar() -> None:
    labels = {"A": 0.1, "B": 0.2, "the": 0.7}
    (read,) = reads_of(request(components=["clarity"], votes=[LABEL]), ChatServer(labels=labels))
    assert (read.status, read.levels) == (Status.ABSTAIN, ()) and read.label_mass == pytest.approx(0.3)
    assert "label mass 0.300 is below 0.5" in read.reason
    lenient = load_rubric("robot", {"voting": {"min_label_mass": 0.25}})
    (read,) = reads_of(request(components=["clarity"], votes=[LABEL]), ChatServer(labels=labels), rubric=lenient)
    assert (read.status, read.label_mass) == (Status.OK, pytest.approx(0.3))
    server = ChatServer(labels=labels)
    settings = asked_by(choice_grammar=True, label_token_ids=[65, 66, 67, 68, 69])
    (read,) = reads_of(request(components=["clarity"], votes=[LABEL]), server, settings=settings)
    assert (read.status, read.label_mass) == (Status.OK, 1.0)
    body = server.requests[0]
    assert body["structured_outputs"] == {"choice": list("ABCDE")} and body["logprob_token_ids"] == [65, 66, 67, 68, 69]
    assert "top_logprobs" not in body
    server = ChatServer(labels={"the": 1.0})
    (read,) = reads_of(request(components=["clarity"], votes=[LABEL]), server, settings=settings)
    assert (read.status, read.levels) == (Status.ABSTAIN, ())


def completion(*tops: tuple[str, float]) -> Completion:
    listed = [{"token": token, "logprob": logprob} for token, logprob in tops]
    first = {**listed[0], "top_logprobs": listed}
    return Completion.model_validate({"choices": [{"message": {}, "logprobs": {"content": [first]}}]})


def test_impossible_logprobs_are_refused_and_repeated_tokens_count_once() -> None:
    probabilities, mass = option_probabilities(completion(("A", -0.6931472), ("A", -0.6931472), ("B", -30.0)), "AB")
    assert probabilities[0] == pytest.approx(1) and mass == pytest.approx(0.5)
    for wrong in (0.5, float("nan")):
        with pytest.raises(AnswerError, match="above 0 or NaN"):
            option_probabilities(completion(("A", wrong)), "AB")
    with pytest.raises(AnswerError, match=r"sum to 2\.0"):
        option_probabilities(completion(("A", 0.0), (" A", 0.0)), "AB")
    assert option_probabilities(completion(("x", 0.0)), "AB") == ((), 0.0)
    assert label_options("AB") == {"max_tokens": 1, "logprobs": True, "top_logprobs": 20}


# Cache


def test_second_run_is_bit_equal_and_sends_nothing(tmp_path: Path) -> None:
    asked = request(components=["clarity", "color"], votes=[JSON, LABEL])
    runs = []
    for _ in range(2):
        server = ChatServer()
        runs.append(reads_of(asked, server, cache=VerdictCache(tmp_path)))
        runs.append(server.requests)
    assert (len(runs[1]), len(runs[3])) == (3, 0)
    assert [content_hash(read) for read in runs[0]] == [content_hash(read) for read in runs[2]]
    assert all(read.cost.wall_s == 0 for read in runs[2])


def test_a_second_run_measures_the_servers_cache_as_the_first_whatever_was_asked_twice(tmp_path: Path) -> None:
    async def steps(judge: OpenAIJudge) -> float:
        await judge.read(request(components=["clarity", "brightness", "color", "temporal"], mode="auto"))
        return (await judge.health()).details["cached_ratio"]

    settings = asked_by(repeat_share=1.0)
    first, again = (judging(steps, ChatServer(), settings=settings, cache=VerdictCache(tmp_path)) for _ in range(2))
    assert 0 < first < 1 and again == first


def test_whatever_changes_the_answer_changes_the_key(tmp_path: Path) -> None:
    def sent(asked: ReadRequest, **options: Any) -> int:
        server = ChatServer()
        reads_of(asked, server, cache=VerdictCache(tmp_path), **options)
        return len(server.requests)

    asked = request(components=["clarity"])
    assert [sent(asked), sent(asked)] == [1, 0]
    assert sent(asked, model="other") == 1
    assert sent(asked, rubric=load_rubric(overrides={"revision": 2})) == 1
    assert sent(asked, settings=asked_by(extra_body={"max_tokens": 512})) == 1
    assert sent(replace(asked, task=replace(TASK, instruction="pull"))) == 1
    assert sent(replace(asked, clip=clip_ref("one", FRAMES[:, ::-1], 8.0))) == 1
    assert sent(replace(asked, votes=(replace(JSON, seed=4),))) == 1
    assert sent(replace(asked, clip=replace(CLIP, clip_id="renamed"))) == 0


def test_errors_are_never_cached_and_a_broken_file_is_written_anew(tmp_path: Path) -> None:
    asked = request(components=["clarity"])
    broken = ChatServer(honours_schema=False, gives_logprobs=False)
    assert reads_of(asked, broken, cache=VerdictCache(tmp_path))[0].status is Status.ERROR
    assert not list(tmp_path.rglob("*.json"))
    reads_of(asked, ChatServer(), cache=VerdictCache(tmp_path))
    (file,) = tmp_path.rglob("*.json")
    whole = file.read_text()
    file.write_text(whole[:50])
    server = ChatServer()
    assert reads_of(asked, server, cache=VerdictCache(tmp_path))[0].status is Status.OK
    assert len(server.requests) == 1 and json.loads(file.read_text())[0]["component"] == "clarity"


# Call plans


@pytest.mark.parametrize(("caches", "calls_after"), [(True, 4), (False, 1)])
def test_plan_follows_the_measured_cache(caches: bool, calls_after: int) -> None:
    server = ChatServer(prefix_cache=caches, delay_s=0.05)
    asked = request(components=list(RUBRIC.stages[Stage.VQ].components), mode="auto")

    async def steps(judge: OpenAIJudge) -> dict[str, float]:
        await judge.read(asked)
        assert len(server.requests) == 4 and server.most_in_flight == 3  # the lead alone, then the others
        reads = await judge.read(asked)
        assert len(server.requests) == 4 + calls_after and len(reads) == 4
        return dict((await judge.health()).details)

    ratio = judging(steps, server)["cached_ratio"]
    assert ratio > 0.8 if caches else ratio == 0


def test_threshold_counts_followers_only_and_is_checked_again_after_500_calls() -> None:
    def usage(cached: int) -> Cost:
        return Cost(calls=1, prompt_tokens=100, cached_tokens=cached)

    plan = CallPlan()
    plan.observe(usage(0), follows=False)
    for cached in (60, 60, 59):
        assert (plan.plan, plan.cached_ratio) == ("fanout", None)
        plan.observe(usage(cached), follows=True)
    assert plan.plan == "pack" and plan.cached_ratio == pytest.approx(179 / 300)
    for _ in range(500):
        assert plan.plan == "pack"
        plan.observe(usage(0), follows=True)
    assert plan.is_measuring and plan.plan == "fanout"
    for _ in range(3):
        plan.observe(usage(60), follows=True)
    assert plan.plan == "fanout" and not plan.is_measuring and plan.cached_ratio == 0.6


# The judge as a whole


def test_repeated_calls_tell_how_often_the_server_contradicts_itself_and_the_first_answer_counts() -> None:
    class Wavering(ChatServer):
        def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
            self.level = 3 if len(self.requests) % 2 else 1
            return super()._completion(body, fault)

    async def steps(judge: OpenAIJudge) -> tuple[list[Read], dict[str, float]]:
        reads = await judge.read(request())
        return reads, dict((await judge.health()).details)

    server = Wavering()
    reads, details = judging(steps, server, settings=asked_by(repeat_share=1.0))
    assert [read.levels.index(1) for read in reads] == [3, 3] and len(server.requests) == 2
    assert (details["repeated"], details["flipped"], details["flip_rate"]) == (2, 2, 1)
    assert sum(read.cost.calls for read in reads) == 2
    steady = ChatServer()
    _, details = judging(steps, steady, settings=asked_by(repeat_share=1.0))
    assert details["flip_rate"] == 0 and len(steady.requests) == 2
    _, details = judging(steps, once := ChatServer())
    assert "flip_rate" not in details and len(once.requests) == 1


def test_health_tells_whether_the_model_is_served_and_what_was_measured() -> None:
    async def steps(judge: OpenAIJudge) -> Any:
        await judge.read(request(votes=[JSON, LABEL]))
        return await judge.health()

    health = judging(steps, ChatServer())
    assert health.available and health.details["calls"] == 3 and health.details["reads"] == 4
    assert health.details["label_mass"] == pytest.approx(1.0) and health.details["latency_p95_s"] > 0
    wrong = judging(steps, ChatServer(), model="qwen")
    assert not wrong.available and wrong.reason == "no endpoint serves qwen; served: judge"
    transport = ChatTransport([Endpoint("http://127.0.0.1:9/v1", "judge")])
    assert not asyncio.run(OpenAIJudge(transport, RUBRIC, asked_by()).health()).available


def test_bad_requests_and_settings_name_what_is_wrong() -> None:
    for asked, problem in [
        (request(components=["smell"]), "has no 'smell' for VQ; known: background"),
        (request(components=[]), "needs components and votes"),
        (request(media=(MediaItem("clip", 12),)), "frame 12 is asked for, clip one has 12"),
        (request(media=(MediaItem("goal"),)), "a goal image is asked for, task push has none"),
    ]:
        server = ChatServer()
        with pytest.raises(ValueError, match=problem):
            reads_of(asked, server)
        assert not server.requests
    with pytest.raises(ValueError, match="must serve one model, got a, b"):
        OpenAIJudge(ChatTransport([Endpoint("http://x/v1", "a"), Endpoint("http://y/v1", "b")]), RUBRIC, asked_by())


def test_a_new_domains_component_is_asked_about_gated_and_capped_with_a_file_alone(tmp_path: Path) -> None:
    file = tmp_path / "cooking.yaml"
    file.write_text(COOKING)
    cooking = load_rubric(str(file))

    async def steps(judge: OpenAIJudge) -> Verdict:
        return await RewardAgent(judge, cooking, call_plan="pack").evaluate(CLIP, TASK)

    server = ChatServer(level=4)
    verdict: Verdict = judging(steps, server, rubric=cooking)
    assert verdict.status is Status.OK, verdict.reason
    assert [score.component for score in verdict.stages[3].components][-1] == "liquid"
    assert [flag.pattern for flag in verdict.hack_flags][-1] == "spill"
    asked = [text for body in server.requests for text in texts(body)]
    assert any("liquid: Does liquid flow" in text for text in asked)
    assert any("spill: Is a spill hidden?" in text for text in asked)
    named = [body["response_format"]["json_schema"]["schema"] for body in server.requests if "response_format" in body]
    assert any('"liquid"' in json.dumps(schema) for schema in named)


def judged(server: ChatServer, tmp_path: Path) -> Verdict:
    async def steps(judge: OpenAIJudge) -> Verdict:
        return await RewardAgent(judge, RUBRIC).evaluate(CLIP, TASK)

    verdict: Verdict = judging(steps, server, cache=VerdictCache(tmp_path))
    return verdict


@pytest.mark.parametrize("prefix_cache", [True, False])
def test_the_agent_reaches_a_verdict_and_a_rerun_is_bit_equal_without_a_server(
    prefix_cache: bool, tmp_path: Path
) -> None:
    server = ChatServer(level=3, prefix_cache=prefix_cache)
    verdict = judged(server, tmp_path)
    assert verdict.status is Status.OK and 0.5 < verdict.reward < 1, verdict.reason
    assert verdict.cost.calls == len(server.requests) > 4
    assert all(score.status is Status.OK for stage in verdict.stages for score in stage.components)
    silent = ChatServer()
    assert judged(silent, tmp_path).audit_id == verdict.audit_id and not silent.requests


@pytest.mark.parametrize("after", [0, 3])
def test_a_server_that_dies_leaves_the_verdict_without_a_number(after: int, tmp_path: Path) -> None:
    class Dying(ChatServer):
        async def _answer(self, writer: asyncio.StreamWriter, body: dict[str, Any]) -> None:
            if len(self.requests) > after:
                self.faults.append(Fault("reset"))
            await super()._answer(writer, body)

    verdict = judged(Dying(), tmp_path)
    assert verdict.status is Status.ERROR and np.isnan(verdict.reward) and not verdict.valid
    assert "connection failed" in verdict.reason


def test_no_handler_of_an_error_returns_or_sets_a_number() -> None:
    """A failed judge is never worth 0: nothing below `except` may give a literal number."""
    judge = Path(backends.__path__[0]).parent
    package = judge.parent
    names = ("judge/services", "clip_evaluator_node", "reward_evaluator_node")
    files = [file for folder in ("agent", "backends", ".") for file in sorted((judge / folder).glob("*.py"))]
    files += sorted((package.parent / "benchmarks" / "judge" / "comparisons").glob("*.py"))
    files += [package / "nodes" / f"{name}.py" for name in names]
    files += [judge / "audit" / "recording.py", judge / "audit" / "replay.py"]
    assert len(files) > 40
    assert [line for file in files for line in numbers_in_handlers(file.read_text(), file.name)] == []
    for fallback in ("return 0.0", "value = 0", "return Verdict(reward=0.5)", "return nan, 0.0", "rewards[i] = -1.0"):
        assert numbers_in_handlers(f"try:\n  f()\nexcept E:\n  {fallback}", "x") == ["x:4"], fallback


def numbers_in_handlers(source: str, name: str) -> list[str]:
    """Where an except branch returns or sets a literal number, or gives one as a reward, value or score."""
    found = []
    for handler in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ExceptHandler)):
        for node in ast.walk(handler):
            value = node.value if isinstance(node, (ast.Return, ast.Assign, ast.AnnAssign)) else None
            if isinstance(node, ast.keyword) and node.arg in ("reward", "value", "score", "total", "s"):
                value = node.value
            parts = value.elts if isinstance(value, ast.Tuple) else [value]
            parts = [part.operand if isinstance(part, ast.UnaryOp) else part for part in parts]
            if any(isinstance(part, ast.Constant) and isinstance(part.value, (int, float)) for part in parts):
                found.append(f"{name}:{node.lineno}")  # type: ignore[attr-defined]
    return found
