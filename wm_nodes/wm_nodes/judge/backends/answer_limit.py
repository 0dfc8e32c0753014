"""An HTTP answer that is read up to a limit only, whatever the server sends. Imported with the client package."""

from collections.abc import AsyncIterator

import httpx2

ANSWER_BYTES = 8 << 20
"""An answer of 1,024 tokens with its reasoning and log-probabilities stays far below it."""


class AnswerRefused(httpx2.TransportError):
    """An answer that is not read to its end."""


class _Bounded(httpx2.AsyncByteStream):
    def __init__(self, stream: httpx2.AsyncByteStream) -> None:
        self._stream = stream

    async def __aiter__(self) -> AsyncIterator[bytes]:
        left = ANSWER_BYTES
        async for chunk in self._stream:
            left -= len(chunk)
            if left < 0:
                raise AnswerRefused(f"the answer is longer than {ANSWER_BYTES >> 20} MiB")
            yield chunk

    async def aclose(self) -> None:
        await self._stream.aclose()


async def bound_answer(response: httpx2.Response) -> None:
    """A response hook of the client, for requests that ask for no compression: a small body could grow to any size."""
    if (encoding := response.headers.get("content-encoding", "identity")) != "identity":
        raise AnswerRefused(f"the answer is compressed ({encoding}) although that was not asked for")
    assert isinstance(response.stream, httpx2.AsyncByteStream)  # of an asynchronous client
    response.stream = _Bounded(response.stream)
