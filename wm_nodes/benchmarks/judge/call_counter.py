"""What a judge is asked per clip, counted in front of it, so that judges that bill differently can be compared.

Calls are counted as a chat judge makes them in the plan `pack`: JSON votes of a request in one call, label votes one
per component.
"""

from wm_nodes.judge.agent.judge import ForwardingJudge, Judge, Read, ReadRequest


class CountingJudge(ForwardingJudge):
    """A Judge that passes everything on, and counts calls and the images in them."""

    def __init__(self, judge: Judge) -> None:
        super().__init__(judge)
        self.calls = self.images = 0

    async def read(self, request: ReadRequest) -> list[Read]:
        calls = sum(1 if vote.kind == "json" else len(request.components) for vote in request.votes)
        self.calls += calls
        self.images += calls * len(request.media)
        return await super().read(request)
