"""The OpenAI-compatible judge against software that we did not write: `transformers serve` with a tiny model.

It ignores response_format and knows no logprobs, so it shows what happens with such a server; vLLM knows both. A proxy
in front of it spoils its answers on the way.
"""

import asyncio
import json
import math
import random
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_server import Fault
from fault_proxy import FaultProxy
from tiny_vlm import save_tiny_vlm, transformers_serve

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import load_config
from wm_nodes.judge.agent.judge import JudgeError, ReadRequest
from wm_nodes.judge.agent.levels import first_vote, next_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.profiles import profile_media
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import Profile, Stage, Status, TaskSpec, clip_ref
from wm_nodes.judge.backends.openai_client import OpenAIJudge
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy, TransportError

pytestmark = pytest.mark.slow

ANSWER = {"evidence": "edges are soft", "frames": [0], "level": 3}
VQ = ("clarity", "brightness", "color", "temporal")
SLOW_TRY_S = 15.0
"""For one try where the answer is dripped; whole ones take well below a second on an idle core."""
FRAMES = np.random.default_rng(0).integers(0, 256, (12, 24, 32, 3), np.uint8)
CLIP, TASK = clip_ref("one", FRAMES, 8.0), TaskSpec("push the red cube", "push", "panda", FRAMES[0])


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoint]:
    pytest.importorskip("fastapi", reason="transformers serve needs fastapi and uvicorn of requirements/dev.txt")
    folder: Path = tmp_path_factory.mktemp("tiny_vlm")
    save_tiny_vlm(folder, json.dumps(ANSWER))
    with transformers_serve(folder) as url:
        yield Endpoint(url, str(folder), max_in_flight=4)


def settings(**changes: Any) -> JudgeConfig:
    """Of a judge that asks nothing twice."""
    return load_config("cpu").judge.model_copy(update={"repeat_share": 0.0, **changes})


def with_judge(endpoint: Endpoint, steps: Callable[[OpenAIJudge, ChatTransport], Awaitable[Any]]) -> Any:
    async def run() -> Any:
        transport = ChatTransport([endpoint])
        try:
            return await steps(OpenAIJudge(transport, load_rubric(), settings()), transport)
        finally:
            await transport.close()

    return asyncio.run(run())


def through_proxy(
    endpoint: Endpoint,
    faults: Sequence[Fault],
    steps: Callable[[OpenAIJudge, ChatTransport, FaultProxy], Awaitable[Any]],
    *,
    max_in_flight: int = 4,
) -> Any:
    """As with_judge, with a fault for each of the first requests."""
    timeout_s = SLOW_TRY_S if Fault("slow") in faults else 60.0

    async def run() -> Any:
        async with FaultProxy(endpoint.base_url, deque(faults)).running() as proxy:
            spoiled = replace(endpoint, base_url=proxy.url, max_in_flight=max_in_flight)
            transport = ChatTransport([spoiled], retry=RetryPolicy(base_s=0.01, cap_s=0.02), jitter=random.Random(0))
            judge = OpenAIJudge(transport, load_rubric(), settings(json_timeout_s=timeout_s))
            try:
                return await steps(judge, transport, proxy)
            finally:
                await transport.close()

    return asyncio.run(run())


def request(components: Sequence[str], **changes: Any) -> ReadRequest:
    media = profile_media(CLIP, TASK, Profile.S)
    asked = ReadRequest(CLIP, TASK, Stage.VQ, tuple(components), Profile.S, (first_vote(0),), media, "fanout")
    return replace(asked, **changes)


def test_images_are_taken_and_answers_checked_although_the_server_ignores_the_schema(endpoint: Endpoint) -> None:
    async def steps(judge: OpenAIJudge, _: ChatTransport) -> None:
        reads = await judge.read(request(VQ))
        for read in reads:
            assert (read.status, read.levels, read.source) == (Status.OK, (0, 0, 0, 1, 0), "json"), read.reason
            assert (read.evidence_text, read.frames_cited) == ("edges are soft", (0,))
            assert read.cost.calls == 1 and read.cost.completion_tokens > 0 and read.cost.retries == 0
        fewer = await judge.read(request(["clarity"], media=request(["clarity"]).media[:3]))
        assert fewer[0].cost.prompt_tokens < reads[0].cost.prompt_tokens  # images count
        health = await judge.health()
        assert health.available and health.details["invalid_rate"] == 0, health

    with_judge(endpoint, steps)


def test_what_the_server_cannot_do_is_an_error_with_its_reason_and_no_number(endpoint: Endpoint) -> None:
    async def steps(judge: OpenAIJudge, _: ChatTransport) -> None:
        label = await judge.read(request(["clarity"], votes=(next_vote(1, 0),)))
        pack = await judge.read(request(["clarity", "color"], mode="pack"))
        for read in [*label, *pack]:
            assert (read.status, read.levels) == (Status.ERROR, ()) and "gives no logprobs" in read.reason
        assert "items: Field required" in pack[0].reason

    with_judge(endpoint, steps)


def test_refusals_of_a_real_server_are_not_retried(endpoint: Endpoint) -> None:
    async def steps(_: OpenAIJudge, transport: ChatTransport) -> None:
        with pytest.raises(TransportError, match=r"HTTP 4\d\d") as caught:
            await transport.complete({"messages": [{"role": "user", "content": "x"}], "nonsense": 1}, timeout_s=30)
        assert caught.value.tries == 1

    with_judge(endpoint, steps)


@pytest.mark.parametrize(
    "fault",
    [
        Fault("status", 429, retry_after="1"),
        Fault("status", 500),
        *map(Fault, ("reset", "truncated", "slow", "garbage")),
    ],
    ids=lambda fault: f"{fault.kind}{fault.status if fault.kind == 'status' else ''}",
)
def test_what_is_spoiled_on_the_way_is_asked_for_again_and_the_servers_answer_counts(
    endpoint: Endpoint, fault: Fault
) -> None:
    async def steps(judge: OpenAIJudge, transport: ChatTransport, proxy: FaultProxy) -> None:
        (read,) = await judge.read(request(["clarity"]))
        assert (read.status, read.levels, read.source) == (Status.OK, (0, 0, 0, 1, 0), "json"), read.reason
        assert (read.cost.calls, read.cost.retries, proxy.num_requests) == (1, 1, 2)
        assert len(proxy.answers) == (1 if fault.kind == "status" else 2), "the server answered, the answer was spoiled"
        overload = fault.kind == "slow" or fault.status == 429
        assert transport.limits() == {proxy.url: 2 if overload else 4}
        assert read.cost.wall_s >= {"status": 1.0 * bool(fault.retry_after), "slow": SLOW_TRY_S}.get(fault.kind, 0.0)

    through_proxy(endpoint, [fault], steps)


def test_an_answer_that_the_server_cut_short_is_refused_although_it_can_be_read(endpoint: Endpoint) -> None:
    async def steps(judge: OpenAIJudge, _: ChatTransport, proxy: FaultProxy) -> None:
        (read,) = await judge.read(request(["clarity"]))
        assert (read.status, read.levels) == (Status.OK, (0, 0, 0, 1, 0)), read.reason
        assert (read.cost.calls, read.cost.retries) == (2, 0)
        first, second = (json.loads(answer)["choices"][0] for answer in proxy.answers)
        assert (first["finish_reason"], second["finish_reason"]) == ("length", "stop")
        assert json.loads(first["message"]["content"]) == ANSWER

    through_proxy(endpoint, [Fault("length")], steps)


@pytest.mark.parametrize("limit", [1, 2])
def test_no_more_requests_than_allowed_are_under_way_and_faults_among_them_lose_no_answer(
    endpoint: Endpoint, limit: int
) -> None:
    async def steps(judge: OpenAIJudge, _: ChatTransport, proxy: FaultProxy) -> None:
        reads = await judge.read(request(VQ))
        assert [(read.component, read.status) for read in reads] == [(name, Status.OK) for name in VQ], reads
        assert (sum(read.cost.retries for read in reads), proxy.num_requests) == (3, len(VQ) + 3)
        assert proxy.most_in_flight == limit

    faults = [Fault(""), Fault("status", 500), Fault("reset"), Fault("garbage")]  # the first call goes alone
    through_proxy(endpoint, faults, steps, max_in_flight=limit)


def test_a_server_that_is_lost_or_understands_too_little_gives_an_error_and_no_reward(endpoint: Endpoint) -> None:
    async def lost(judge: OpenAIJudge, _: ChatTransport, proxy: FaultProxy) -> None:
        with pytest.raises(JudgeError, match=r"gave up after 4 tries; last: .*connection failed") as caught:
            await judge.read(request(VQ))
        assert (caught.value.cost.calls, caught.value.cost.retries, proxy.num_requests) == (0, 3, 4)

    async def judged(judge: OpenAIJudge, _: ChatTransport) -> None:
        verdict = await RewardAgent(judge, load_rubric()).evaluate(CLIP, TASK)
        assert verdict.status is Status.ERROR and not verdict.valid and math.isnan(verdict.reward)
        assert "gives no logprobs" in verdict.reason

    through_proxy(endpoint, [Fault("reset")] * 4, lost)
    with_judge(endpoint, judged)


def test_the_probability_of_true_is_no_number_where_the_server_knows_no_logprobs(endpoint: Endpoint) -> None:
    async def judged(judge: OpenAIJudge, _: ChatTransport) -> None:
        verdict = await RewardAgent(judge, load_rubric(), mode="topreward").evaluate(CLIP, TASK)
        assert (verdict.status, verdict.valid, verdict.cost.calls) == (Status.ERROR, False, 1)
        assert math.isnan(verdict.reward) and "gives no logprobs" in verdict.reason

    with_judge(endpoint, judged)
