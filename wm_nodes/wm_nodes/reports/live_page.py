"""A live page for people: one self-contained HTML file and server-sent events, for this host only.

Whoever shows something never waits: of each panel the newest content is kept, and a browser that is slow, closed or
late gets that one. Nothing that the page is given becomes markup, and its policy lets nothing run but its own script.
"""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any

from jinja2 import Environment, PackageLoader

from wm_nodes.reports.summary import plain

HOST = "127.0.0.1"
TEMPLATE = "live.html"
BROWSERS = 16
"""Browsers that may look at once."""
SILENCE_S = 5.0
"""A browser is written to at least this often, so that one that has gone is noticed."""
SLOW_S = 10.0
"""A browser that takes nothing for so long is let go; it connects again by itself."""


class LivePage:
    """Panels by name, each with its newest content; thread-safe. Use as a context manager.

    Args:
        port: to listen on; 0: a free one.

    Raises:
        ValueError: no such port, or another program listens on it.
    """

    def __init__(self, port: int = 0) -> None:
        if not 0 <= port <= 65535:
            raise ValueError(f"port {port} does not exist; give 1024 to 65535, or 0 for a free one")
        self.html, self.policy = _page()
        self._changed = threading.Condition()
        self._panels: dict[str, tuple[int, bytes]] = {}
        """The number of its change, and the event that a browser gets."""
        self._changes, self._closed = 0, False
        self.browsers = 0
        """How many look now."""
        try:
            self._server = _Server(self, port)
        except OSError as error:
            raise ValueError(
                f"port {port} of this host cannot be used for the live page: {error.strerror}; give another, or 0 for "
                "a free one"
            ) from None
        self.port = int(self._server.server_address[1])
        self.url = f"http://{HOST}:{self.port}/"
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def show(self, panel: str, content: Mapping[str, Any]) -> None:
        """Put the content, plain data, in the panel's place. Numbers that are not finite are null in the page."""
        text = json.dumps({"panel": panel, "content": plain(dict(content))}, allow_nan=False)
        with self._changed:
            self._changes += 1
            self._panels[panel] = self._changes, f"data: {text}\n\n".encode()
            self._changed.notify_all()

    def since(self, seen: int, timeout_s: float) -> tuple[int, list[bytes]]:
        """The newest event of each panel that has changed since change `seen`, and the number of the last change; none
        after timeout_s. Raises ConnectionAbortedError once the page is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._changes > seen or self._closed, timeout_s)
            if self._closed:
                raise ConnectionAbortedError
            return self._changes, [event for number, event in self._panels.values() if number > seen]

    @contextmanager
    def seat(self) -> Iterator[bool]:
        """Whether one more browser may look; if so, it counts among `browsers` until the context ends."""
        with self._changed:
            seated = self.browsers < BROWSERS
            self.browsers += seated
        try:
            yield seated
        finally:
            with self._changed:
                self.browsers -= seated

    def close(self) -> None:
        """Let the browsers go and free the port."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Server(ThreadingTCPServer):
    daemon_threads, block_on_close, allow_reuse_address = True, False, True

    def __init__(self, page: LivePage, port: int) -> None:
        self.page = page
        super().__init__((HOST, port), _Browser)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""


class _Browser(BaseHTTPRequestHandler):
    server: _Server
    timeout = SLOW_S

    def do_GET(self) -> None:
        page = self.server.page
        if self.headers.get("Host") not in {f"{name}:{page.port}" for name in (HOST, "localhost")}:
            self.send_error(403)  # a page of another host that found a name for this address
        elif self.path == "/":
            self._begin("text/html; charset=utf-8", {"Content-Security-Policy": page.policy})
            self.wfile.write(page.html)
        elif self.path != "/events":
            self.send_error(404)
        else:
            with page.seat() as seated:
                if seated:
                    self._begin("text/event-stream", {})
                    self._tell(page)
                else:
                    self.send_error(503, f"{BROWSERS} browsers look already; close one")

    def log_message(self, *arguments: Any) -> None:
        """Nobody reads who looked."""

    def _tell(self, page: LivePage) -> None:
        seen = 0
        while True:
            seen, events = page.since(seen, SILENCE_S)
            for event in events or [b": still here\n\n"]:
                self.wfile.write(event)

    def _begin(self, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(200)
        for name, value in {"Content-Type": kind, "Cache-Control": "no-store", **headers}.items():
            self.send_header(name, value)
        self.end_headers()


def free_port(given: str) -> str:
    """The port of a page to be opened: the given one, or for 0 a free one. Raises ValueError as LivePage."""
    if not given.isdecimal():
        raise ValueError(f"port must be a whole number, got {given!r}; give 1024 to 65535, or 0 for a free one")
    with LivePage(int(given)) as page:
        return str(page.port)


def _page() -> tuple[bytes, str]:
    """The page and its content security policy."""
    html = Environment(loader=PackageLoader("wm_nodes.reports"), autoescape=True).get_template(TEMPLATE).render()
    (style, script) = (re.search(f"<{tag}>(.*?)</{tag}>", html, re.S) for tag in ("style", "script"))
    assert style is not None and script is not None
    digests = [base64.b64encode(hashlib.sha256(part[1].encode()).digest()).decode() for part in (style, script)]
    return html.encode(), (
        f"default-src 'none'; img-src data:; connect-src 'self'; style-src 'sha256-{digests[0]}'; "
        f"script-src 'sha256-{digests[1]}'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
