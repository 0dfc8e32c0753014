"""The comparison rewards through any chat server: one question, one retry with the reason, then no number."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from benchmarks.judge.comparisons.protocols import PairwiseProtocol, Parts, PointwiseProtocol
from wm_nodes.judge.agent.judge import Cost
from wm_nodes.judge.agent.profiles import uniform
from wm_nodes.judge.agent.types import ClipRef, TaskSpec
from wm_nodes.judge.backends.prompts import Part, data_uri, with_problem
from wm_nodes.judge.backends.schemas import AnswerError
from wm_nodes.judge.backends.transport import ChatTransport, TransportError

TRIES = 2
T = TypeVar("T")


@dataclass(frozen=True)
class ComparisonReward:
    """value: of a clip, or the preference for the first of two, in [0, 1]; NaN without a number, `reason` says why.
    parts: in the protocol's own units. consistent: of two clips in both orders, both named one winner."""

    value: float
    parts: Parts = field(default_factory=dict)
    reason: str = ""
    consistent: bool = True
    cost: Cost = field(default_factory=Cost)

    @property
    def valid(self) -> bool:
        return not math.isnan(self.value)


class ChatComparison:
    """Asks a model that sees images. Belongs to the event loop of its transport. timeout_s: per try. max_tokens: of an
    answer. seed: sent along; temperature is 0.
    """

    def __init__(
        self, transport: ChatTransport, *, timeout_s: float = 120.0, max_tokens: int = 2048, seed: int = 0
    ) -> None:
        self._transport, self._timeout_s, self._max_tokens, self._seed = transport, timeout_s, max_tokens, seed

    async def score(self, protocol: PointwiseProtocol, clip: ClipRef, task: TaskSpec) -> ComparisonReward:
        """Score one clip by a pointwise protocol."""
        count = protocol.frames or max(2, math.ceil(clip.duration_s * protocol.fps))
        content = [*_images(clip, count), _text(protocol.question(task.instruction))]
        parts, reason, cost = await self.ask(content, protocol.read, count)
        if parts is None:
            return ComparisonReward(math.nan, reason=reason, cost=cost)
        return ComparisonReward(protocol.value(parts), parts, cost=cost)

    async def compare(
        self, protocol: PairwiseProtocol, first: ClipRef, second: ClipRef, task: TaskSpec
    ) -> ComparisonReward:
        """Compare two clips of one instruction, in both orders, because models prefer a place; published: in one."""
        forward = await self._compare_once(protocol, first, second, task)
        if not forward.valid:
            return forward
        other = await self._compare_once(protocol, second, first, task)
        cost = forward.cost + other.cost
        if not other.valid:
            return ComparisonReward(math.nan, reason=other.reason, cost=cost)
        turned = 1 - other.value
        same = (forward.value - 0.5) * (turned - 0.5) > 0
        return ComparisonReward((forward.value + turned) / 2, forward.parts, consistent=same, cost=cost)

    async def ask(
        self, content: Sequence[Part], read: Callable[[str], T], num_images: int, system: str = ""
    ) -> tuple[T | None, str, Cost]:
        """What `read` makes of an answer, or None with the reason; and what it cost."""
        messages: list[Part] = [{"role": "user", "content": list(content)}]
        if system:
            messages = [{"role": "system", "content": system}, *messages]
        cost, reason, began = Cost(), "", time.monotonic()
        for _ in range(TRIES):
            body = {"messages": messages, "temperature": 0, "seed": self._seed, "max_tokens": self._max_tokens}
            try:
                answer = await self._transport.complete(body, timeout_s=self._timeout_s)
            except TransportError as error:
                return None, str(error), cost + Cost(retries=max(0, error.tries - 1))
            usage, choice = answer.completion.usage, answer.completion.choices[0]
            cost += Cost(
                1, usage.prompt_tokens, usage.cached_tokens, usage.completion_tokens, num_images, answer.wall_s,
                answer.tries - 1,
            )
            try:
                if choice.finish_reason != "stop":
                    raise AnswerError(f"finish_reason is {choice.finish_reason!r}, not 'stop'")
                return read(choice.message.content or ""), "", cost
            except AnswerError as error:
                reason = str(error)
                messages = with_problem(messages, reason)
        waited = time.monotonic() - began
        return None, f"{TRIES} answers were refused in {waited:.1f} s, the last one: {reason}", cost

    async def _compare_once(
        self, protocol: PairwiseProtocol, first: ClipRef, second: ClipRef, task: TaskSpec
    ) -> ComparisonReward:
        images = [*_images(first, protocol.frames, "video 1, "), *_images(second, protocol.frames, "video 2, ")]
        content = [*images, _text(protocol.question(task.instruction))]
        answer, reason, cost = await self.ask(content, protocol.read, len(images) // 2)
        if answer is None:
            return ComparisonReward(math.nan, reason=reason, cost=cost)
        preference, parts = answer
        return ComparisonReward(preference, parts, cost=cost)


def _images(clip: ClipRef, count: int, prefix: str = "") -> list[Part]:
    """A label and a PNG per frame, evenly spaced from the first to the last."""
    parts: list[Part] = []
    for index in uniform(len(clip.frames), count):
        parts.append(_text(f"{prefix}frame {index} at {index / clip.fps:.2f} s"))
        parts.append({"type": "image_url", "image_url": {"url": data_uri(clip.frames[index])}})
    return parts


def _text(text: str) -> Part:
    return {"type": "text", "text": text}
