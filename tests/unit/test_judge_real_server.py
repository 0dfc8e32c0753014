"""The OpenAI-compatible judge against software that we did not write: `transformers serve` with a tiny model.

It ignores response_format and knows no logprobs, so it shows what happens with such a server; vLLM knows both.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_vlm import save_tiny_vlm, transformers_serve

from wm_nodes.reward.agent.levels import first_vote, next_vote
from wm_nodes.reward.agent.profiles import profile_media
from wm_nodes.reward.agent.rubric import load_rubric
from wm_nodes.reward.agent.types import Profile, ReadRequest, Stage, Status, TaskSpec, clip_ref
from wm_nodes.reward.judges import ChatTransport, Endpoint, OpenAIJudge, TransportError

pytestmark = pytest.mark.slow

ANSWER = {"evidence": "edges are soft", "frames": [0], "level": 3}
FRAMES = np.random.default_rng(0).integers(0, 256, (12, 24, 32, 3), np.uint8)
CLIP, TASK = clip_ref("one", FRAMES, 8.0), TaskSpec("push the red cube", "push", "panda", FRAMES[0])


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoint]:
    pytest.importorskip("fastapi", reason="transformers serve needs fastapi and uvicorn of requirements/dev.txt")
    folder: Path = tmp_path_factory.mktemp("tiny_vlm")
    save_tiny_vlm(folder, json.dumps(ANSWER))
    with transformers_serve(folder) as url:
        yield Endpoint(url, str(folder), max_in_flight=4)


def with_judge(endpoint: Endpoint, steps: Callable[[OpenAIJudge, ChatTransport], Awaitable[Any]]) -> Any:
    async def run() -> Any:
        transport = ChatTransport([endpoint])
        try:
            return await steps(OpenAIJudge(transport, load_rubric()), transport)
        finally:
            await transport.close()

    return asyncio.run(run())


def request(components: Sequence[str], **changes: Any) -> ReadRequest:
    media = profile_media(CLIP, TASK, Profile.S)
    asked = ReadRequest(CLIP, TASK, Stage.VQ, tuple(components), Profile.S, (first_vote(0),), media, "fanout")
    return replace(asked, **changes)


def test_images_are_taken_and_answers_checked_although_the_server_ignores_the_schema(endpoint: Endpoint) -> None:
    async def steps(judge: OpenAIJudge, _: ChatTransport) -> None:
        reads = await judge.read(request(["clarity", "brightness", "color", "temporal"]))
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
