"""A proxy in front of a chat server that we did not write, which spoils its answers on request.

Statuses come from the proxy, as from a gateway that refuses; everything else is the server's own answer to the request
as it was sent: lost, cut, dripped or maimed on its way back. Only `length` changes the request: one token is asked for,
and the server says itself that this was too few.
"""

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from chat_server import Fault, listening

DRIP_S = 0.5
"""Between two bytes of a slow answer."""


@dataclass
class FaultProxy:
    """target: base URL of the server. faults: one per request for a completion, in order; "" lets it pass. answers:
    bodies that the server gave. most_in_flight: requests that were under way at once.
    """

    target: str
    faults: deque[Fault] = field(default_factory=deque)
    answers: list[bytes] = field(default_factory=list)
    num_requests: int = 0
    in_flight: int = 0
    most_in_flight: int = 0
    url: str = ""

    @asynccontextmanager
    async def running(self) -> AsyncIterator["FaultProxy"]:
        async with listening(self._serve) as origin:
            self.url = origin + urlsplit(self.target).path
            yield self

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One request per connection."""
        try:
            head, body = await _message(reader)
            counted = b"/chat/completions" in head[0]
            fault = self.faults.popleft() if counted and self.faults else Fault("")
            self.num_requests += counted
            self.in_flight += counted
            self.most_in_flight = max(self.most_in_flight, self.in_flight)
            try:
                await self._answer(writer, head, body, fault)
            finally:
                self.in_flight -= counted
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    async def _answer(self, writer: asyncio.StreamWriter, head: list[bytes], body: bytes, fault: Fault) -> None:
        if fault.kind == "status":
            text = json.dumps({"error": {"message": fault.text}}).encode()
            extra = [f"Retry-After: {fault.retry_after}".encode()] if fault.retry_after else []
            writer.write(_joined([f"HTTP/1.1 {fault.status} X".encode(), *extra], text))
            await writer.drain()
            return
        if fault.kind == "length":
            body = json.dumps({**json.loads(body), "max_tokens": 1}).encode()
        head, answer = await self._asked(head, body)
        self.answers.append(answer)
        if fault.kind == "reset":
            writer.transport.abort()
        elif fault.kind == "truncated":
            writer.write(_joined(head, answer)[: -len(answer) // 2])
            await writer.drain()
        elif fault.kind == "slow":
            for byte in _joined(head, answer):
                writer.write(bytes([byte]))
                await writer.drain()
                await asyncio.sleep(DRIP_S)
        else:
            writer.write(_joined(head, answer[: len(answer) // 2] if fault.kind == "garbage" else answer))
            await writer.drain()

    async def _asked(self, head: list[bytes], body: bytes) -> tuple[list[bytes], bytes]:
        """The server's answer to a request."""
        there = urlsplit(self.target)
        reader, writer = await asyncio.open_connection(there.hostname, there.port, limit=1 << 26)
        try:
            writer.write(_joined(head, body))
            await writer.drain()
            return await _message(reader)
        finally:
            writer.close()


async def _message(reader: asyncio.StreamReader) -> tuple[list[bytes], bytes]:
    """First line and headers, and the body, of a request or an answer."""
    *head, _, _ = (await reader.readuntil(b"\r\n\r\n")).split(b"\r\n")
    lengths = [line.split(b":")[1] for line in head if line.lower().startswith(b"content-length:")]
    return head, await reader.readexactly(int(lengths[0]) if lengths else 0)


def _joined(head: list[bytes], body: bytes) -> bytes:
    """A message with the length that its body has, on a connection of its own."""
    kept = [line for line in head if not line.lower().startswith((b"content-length:", b"connection:"))]
    return b"\r\n".join([*kept, b"Content-Length: %d" % len(body), b"Connection: close", b"", body])
