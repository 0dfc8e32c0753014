"""The chat server of tests/chat_server.py in a thread: a judge whose answers differ from clip to clip."""

import asyncio
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from chat_server import ChatServer, Fault
from deadlines import PATIENCE_S

Server = TypeVar("Server", bound=ChatServer)


@dataclass
class PickyServer(ChatServer):
    """Plans every clip as good and gives each stage level 3 or 4, drawn from what it is asked. down: it resets."""

    down: bool = False
    prefix_cache: bool = False

    async def _answer(self, writer: asyncio.StreamWriter, body: dict[str, Any]) -> None:
        if self.down:
            writer.transport.abort()
            return
        await super()._answer(writer, body)

    def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
        drawn = hashlib.sha256(json.dumps(body["messages"]).encode()).digest()[0] % 2
        self.level = 3 if "visible_problems" in json.dumps(body) else 3 + drawn
        return super()._completion(body, fault)


@contextmanager
def serving(server: Server) -> Iterator[Server]:
    """The server on an event loop of its own thread."""
    loop, ready, stop = asyncio.new_event_loop(), threading.Event(), asyncio.Event()

    async def serve() -> None:
        async with server.running():
            ready.set()
            await stop.wait()
        left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),), name="judge server")
    thread.start()
    assert ready.wait(PATIENCE_S)
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE_S)
        loop.close()
