"""A judge behind a chat-completions server: vLLM, or any other that speaks the protocol."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import PLANNING, Stage, Status
from wm_nodes.judge.backends.cache import VerdictCache, cache_key
from wm_nodes.judge.backends.calls import (
    Call,
    CallCost,
    Caller,
    Exchange,
    Prompt,
    describe_request,
    sha_of,
)
from wm_nodes.judge.backends.plans import CallPlan
from wm_nodes.judge.backends.prompts import Prompts
from wm_nodes.judge.backends.transport import ChatTransport

TRANSPORT = "openai-chat"
COUNTED = ("reads", "calls", "retries", "cache_hits", "errors", "abstained", "repeated", "flipped")


class OpenAIJudge:
    """A Judge over a ChatTransport. All its endpoints serve one model. Belongs to one event loop, like its transport.

    Args:
        settings: how it is asked; endpoints, model and key are the transport's.
        cache: reads bought before; a hit repeats the Reads with the cost they had then, wall_s 0, without that of
            asking the same twice.
        on_exchange: called with the words of every request and its raw reply, or with "cached" in place of one.

    Raises:
        ValueError: the endpoints name different models; two judges never mix.
    """

    def __init__(
        self, transport: ChatTransport, rubric: Rubric, settings: JudgeConfig,
        cache: VerdictCache | None = None, on_exchange: Callable[[Exchange], None] = lambda exchange: None,
    ) -> None:
        if len(transport.models) != 1:
            raise ValueError(f"a judge's endpoints must serve one model, got {', '.join(sorted(transport.models))}")
        (self._model,) = transport.models
        self._transport, self._rubric, self._cache = transport, rubric, cache
        self._settings = settings
        self._prompts = Prompts(rubric, video=settings.video)
        self._on_exchange = on_exchange
        self._caller = Caller(transport, self._prompts, settings, on_exchange)
        self._plan = CallPlan()
        self._counts: Counter[str] = Counter()

    @property
    def capabilities(self) -> Capabilities:
        components = frozenset({*self._rubric.component_names, *self._rubric.hack.patterns, PLANNING})
        return Capabilities(
            f"{TRANSPORT}:{self._model}", TRANSPORT, self._model, "", components, max_frames=self._settings.max_images
        )

    async def read(self, request: ReadRequest) -> list[Read]:
        """Answer every component once per vote.

        Mode auto is bit-equal from the cache only if requests come in the same order; pack and fanout always are.
        The first call goes alone, so that the others find its media in the server's cache; if nothing comes back, they
        are not sent.

        Raises:
            JudgeError: not one call was answered.
            ValueError: no component or vote, one that the rubric does not describe, or a frame that is not there.
        """
        lead, *followers = self._calls(request)
        reads = await self._read_call(lead, follows=False)
        if _is_unanswered(reads):
            raise JudgeError(reads[0].reason, reads[0].cost)
        for more in await asyncio.gather(*(self._read_call(call, follows=True) for call in followers)):
            reads += more
        return reads

    async def health(self) -> Health:
        """Whether a server answers and serves the model, and what was measured: counts since the start, latencies and
        label mass over the last 200 answers.
        """
        served = await self._transport.served_models()
        details = {name: float(self._counts[name]) for name in COUNTED}
        details["invalid_rate"] = (details["errors"] + details["abstained"]) / max(1.0, details["reads"])
        details["open_breakers"] = float(len(self._transport.open_breakers()))
        if self._counts["repeated"]:
            details["flip_rate"] = details["flipped"] / details["repeated"]
        if (ratio := self._plan.cached_ratio) is not None:
            details["cached_ratio"] = ratio
        if latencies_s := self._caller.latencies_s:
            details["latency_p50_s"], details["latency_p95_s"] = map(float, np.percentile(latencies_s, (50, 95)))
        if masses := self._caller.label_masses:
            details["label_mass"] = float(np.mean(masses))
        names = {name for models in served.values() for name in models}
        if not served:
            return Health(False, "no endpoint answers when asked for its models", details)
        if names and self._model not in names:  # some servers list nothing and serve all the same
            return Health(False, f"no endpoint serves {self._model}; served: {', '.join(sorted(names))}", details)
        return Health(True, "", details)

    def _calls(self, request: ReadRequest) -> list[Call]:
        """JSON votes in one call or one per component, label votes one per component."""
        if not request.components or not request.votes:
            raise ValueError(f"a read needs components and votes, got {request.components} and {request.votes}")
        for name in request.components:
            self._prompts.entry(request.stage, name)
        media = self._prompts.media(request)
        deadline = time.monotonic() + self._settings.clip_budget_s
        media_sha = sha_of(media)
        calls: list[Call] = []
        for vote in request.votes:
            together = vote.kind == "json" and self._is_packed(request)
            groups = [request.components] if together else [(name,) for name in request.components]
            calls += [Call(request, media, media_sha, deadline, vote, group) for group in groups]
        return calls

    def _is_packed(self, request: ReadRequest) -> bool:
        if request.stage in (Stage.HACK, Stage.REFLECT):
            return True
        return (self._plan.plan if request.mode == "auto" else request.mode) == "pack"

    async def _read_call(self, call: Call, *, follows: bool) -> list[Read]:
        """The reads of one call, from the cache or from the server; its cost is on the first of them."""
        prompt = self._caller.prompt(call)
        question = f"{prompt.sha} {call.vote!r}"
        key = cache_key(call.media_sha, question, self._rubric.version, self._model, TRANSPORT)
        known = None if self._cache is None else self._cache.get(key)
        if known is None:
            reads = await self._ask(call, prompt)
            if self._cache is not None:
                self._cache.put(key, reads)
        else:  # what they cost then, but no time
            reads = [replace(read, cost=replace(read.cost, wall_s=0.0)) for read in known]
        cost = reads[0].cost
        if known is not None:
            self._on_exchange({**describe_request(call, prompt.body), "cached": True})
        elif int(key[:8], 16) < self._settings.repeat_share * 16**8 and not _is_unanswered(reads):
            reads = await self._repeat_call(call, prompt, reads)
        self._plan.observe(cost, follows=follows)
        self._counts["reads"] += len(reads)
        self._counts["cache_hits"] += known is not None
        self._counts["errors"] += sum(read.status is Status.ERROR for read in reads)
        self._counts["abstained"] += sum(read.status is Status.ABSTAIN for read in reads)
        return reads

    async def _repeat_call(self, call: Call, prompt: Prompt, reads: list[Read]) -> list[Read]:
        """Ask the same once more and count whose likeliest level is another one; the reads stay, with both costs."""
        again = await self._ask(call, prompt)
        for first, other in zip(reads, again, strict=True):
            if first.status is Status.OK and other.status is Status.OK:
                self._counts["repeated"] += 1
                self._counts["flipped"] += int(np.argmax(first.levels) != np.argmax(other.levels))
        return [replace(reads[0], cost=reads[0].cost + again[0].cost), *reads[1:]]

    async def _ask(self, call: Call, prompt: Prompt) -> list[Read]:
        bill = CallCost(call.media)
        reads = await self._caller.answer(call, prompt, bill)
        self._counts["calls"] += bill.cost.calls
        self._counts["retries"] += bill.cost.retries
        return [
            replace(read, prompt_sha=prompt.sha, media_sha=call.media_sha, cost=Cost() if index else bill.cost)
            for index, read in enumerate(reads)
        ]


def _is_unanswered(reads: list[Read]) -> bool:
    """Whether the call behind these reads got no answer at all from any server."""
    return reads[0].cost.calls == 0 and all(read.status is Status.ERROR for read in reads)
