"""A small server that speaks the chat-completions protocol over real sockets, and misbehaves on request.

Answers are a function of the request alone: label reads get `labels`, requests with a schema get an instance of it.
Prompt tokens are characters / 4; `cached_tokens` is what a prefix cache of the prompts seen so far would have hit.
"""

import asyncio
import json
import math
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

CHARS_PER_TOKEN = 4


@dataclass(frozen=True)
class Fault:
    """What happens to one request instead of a good answer.

    kind: status | reset | truncated | slow | hang | garbage | empty | length | reply | endless | compressed.
    text: the body of a status, the content of a reply or length. retry_after, location: headers of a status.
    """

    kind: str
    status: int = 500
    text: str = "on purpose"
    retry_after: str = ""
    location: str = ""


@asynccontextmanager
async def listening(
    serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
) -> AsyncIterator[str]:
    """Serve connections on a free port of this host; yields http://host:port."""
    server = await asyncio.start_server(serve, "127.0.0.1", 0, limit=1 << 26)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()


@dataclass
class ChatServer:
    """labels: probability per token of a label read. faults: consumed one per request, in order."""

    labels: Mapping[str, float] = field(default_factory=lambda: {"A": 0.1, "B": 0.2, "C": 0.1, "D": 0.5, " D": 0.1})
    honours_schema: bool = True
    gives_logprobs: bool = True
    prefix_cache: bool = True
    think: str = ""
    delay_s: float = 0.0
    level: int = 3
    faults: deque[Fault] = field(default_factory=deque)
    requests: list[dict[str, Any]] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    in_flight: int = 0
    most_in_flight: int = 0
    num_endless_bytes: int = 0
    url: str = ""
    _seen: list[str] = field(default_factory=list)

    @asynccontextmanager
    async def running(self) -> AsyncIterator["ChatServer"]:
        async with listening(self._serve) as origin:
            self.url = f"{origin}/v1"
            yield self

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := (await reader.readline()).decode():
                path = line.split()[1]
                headers = {}
                while (header := (await reader.readline()).decode().strip()) != "":
                    name, _, value = header.partition(":")
                    headers[name.lower()] = value.strip()
                body = json.loads(await reader.readexactly(int(headers.get("content-length", 0))) or b"{}")
                if path.endswith("/models"):
                    listing = {"object": "list", "data": [{"id": "judge", "object": "model", "created": 0}]}
                    await self._send(writer, 200, json.dumps(listing))
                    continue
                self.requests.append(body)
                self.headers.append(headers)
                self.in_flight += 1
                self.most_in_flight = max(self.most_in_flight, self.in_flight)
                try:
                    await self._answer(writer, body)
                finally:
                    self.in_flight -= 1
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    async def _answer(self, writer: asyncio.StreamWriter, body: dict[str, Any]) -> None:
        fault = self.faults.popleft() if self.faults else None
        kind = fault.kind if fault else ""
        await asyncio.sleep(self.delay_s)
        if fault and kind == "status":
            extra = f"Retry-After: {fault.retry_after}\r\n" if fault.retry_after else ""
            extra += f"Location: {fault.location}\r\n" if fault.location else ""
            await self._send(writer, fault.status, json.dumps({"error": {"message": fault.text}}), extra)
        elif kind == "reset":
            writer.transport.abort()
        elif fault and kind == "endless":
            writer.write(f"HTTP/1.1 {fault.status} X\r\nContent-Type: application/json\r\n\r\n".encode())
            while True:  # until the client has enough
                writer.write(b" " * (1 << 16))
                await writer.drain()
                self.num_endless_bytes += 1 << 16
        elif kind == "compressed":
            await self._send(writer, 200, self._completion(body, None), "Content-Encoding: gzip\r\n")
        elif kind == "hang":
            await asyncio.sleep(60)
        elif kind == "garbage":
            await self._send(writer, 200, "<html>a proxy says hello</html>")
        elif kind == "empty":
            await self._send(writer, 200, json.dumps({"choices": []}))
        elif kind == "truncated":
            await self._send(writer, 200, self._completion(body, None)[:60], length=5000)
            writer.transport.abort()
        elif kind == "slow":
            text = self._completion(body, None)
            writer.write(_head(200, len(text)))
            for character in text:
                writer.write(character.encode())
                await writer.drain()
                await asyncio.sleep(0.05)
        else:
            await self._send(writer, 200, self._completion(body, fault))

    async def _send(
        self, writer: asyncio.StreamWriter, status: int, text: str, extra: str = "", length: int | None = None
    ) -> None:
        writer.write(_head(status, len(text.encode()) if length is None else length, extra) + text.encode())
        await writer.drain()

    def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
        prompt = json.dumps(body["messages"])
        hit = max((_common(prompt, seen) for seen in self._seen), default=0) if self.prefix_cache else 0
        self._seen.append(prompt)
        choice: dict[str, Any] = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant"}}
        if body.get("logprobs"):
            best = max(self.labels, key=lambda label: self.labels[label])
            choice["message"]["content"] = best
            choice["finish_reason"] = "length"
            tops = [{"token": token, "logprob": math.log(p), "bytes": None} for token, p in self.labels.items() if p]
            if self.gives_logprobs:
                best_logprob = math.log(self.labels[best])
                choice["logprobs"] = {"content": [{"token": best, "logprob": best_logprob, "top_logprobs": tops}]}
        elif fault:
            choice["message"]["content"] = fault.text
            choice["finish_reason"] = "length" if fault.kind == "length" else "stop"
        elif "response_format" in body and self.honours_schema:
            schema = body["response_format"]["json_schema"]["schema"]
            choice["message"]["content"] = self.think + json.dumps(self._instance(schema, schema, 0))
        else:
            choice["message"]["content"] = "The clip looks fine to me."
        usage = {
            "prompt_tokens": len(prompt) // CHARS_PER_TOKEN, "completion_tokens": 1, "total_tokens": 0,
            "prompt_tokens_details": {"cached_tokens": hit // CHARS_PER_TOKEN},
        }
        return json.dumps({"id": "1", "object": "chat.completion", "created": 0, "model": body["model"],
                           "choices": [choice], "usage": usage})

    def _instance(self, schema: dict[str, Any], root: dict[str, Any], index: int) -> Any:
        """The value of the schema that a model would give which always says `level`."""
        if "$ref" in schema:
            return self._instance(root["$defs"][schema["$ref"].rsplit("/", 1)[1]], root, index)
        if "enum" in schema:
            return schema["enum"][index % len(schema["enum"])]
        if "const" in schema:
            return schema["const"]
        kind = schema["type"]
        if kind == "object":
            return {name: self._instance(part, root, index) for name, part in schema["properties"].items()}
        if kind == "array":
            count = schema.get("minItems", 0)
            return [self._instance(schema["items"], root, number) for number in range(count)]
        if kind == "boolean":
            return self.level >= 3
        return self.level if kind == "integer" else "seen in frame 0"


def _head(status: int, length: int, extra: str = "") -> bytes:
    return f"HTTP/1.1 {status} X\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n{extra}\r\n".encode()


def _common(one: str, other: str) -> int:
    return next((i for i, (a, b) in enumerate(zip(one, other)) if a != b), min(len(one), len(other)))
