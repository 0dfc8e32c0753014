"""What a judge is asked per clip, counted in front of it, so that judges that bill differently can be compared.

Calls are counted as a chat judge makes them in the plan `pack`: JSON votes of a request in one call, label votes one
per component (judges/openai_client.py). Tokens are an estimate: 16-px patches merged 2 x 2 and 250 tokens
of text per call. What a server billed is beside it, in Verdict.cost.
"""

import math
from dataclasses import dataclass

from wm_nodes.judge.agent.judge import Capabilities, Health, Judge, Read, ReadRequest

TOKEN_PX = 32
TEXT_TOKENS = 250


@dataclass(frozen=True)
class CallCounts:
    """What one clip's reads amount to. reads: answers on one component. pixels: of all images of all calls."""

    reads: int = 0
    calls: int = 0
    images: int = 0
    pixels: int = 0
    tokens: int = 0

    def __add__(self, other: "CallCounts") -> "CallCounts":
        return CallCounts(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


class CountingJudge:
    """A Judge that passes everything on and counts it in `asked`."""

    def __init__(self, judge: Judge) -> None:
        self.judge = judge
        self.asked = CallCounts()

    @property
    def capabilities(self) -> Capabilities:
        return self.judge.capabilities

    async def read(self, request: ReadRequest) -> list[Read]:
        self.asked += count_request(request)
        return await self.judge.read(request)

    async def health(self) -> Health:
        return await self.judge.health()


def count_request(request: ReadRequest) -> CallCounts:
    calls = sum(1 if vote.kind == "json" else len(request.components) for vote in request.votes)
    images = len(request.media)
    height, width = request.clip.frames.shape[1:3]
    tokens = images * math.ceil(height / TOKEN_PX) * math.ceil(width / TOKEN_PX) + TEXT_TOKENS
    return CallCounts(
        len(request.components) * len(request.votes), calls, calls * images, calls * images * height * width,
        calls * tokens,
    )
