"""The live page's server: the newest content of each panel, for browsers of this host, whatever they do."""

import http.client
import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from wm_nodes.reports import live_page
from wm_nodes.reports.live_page import LivePage, free_port

LARGE = "x" * 1_000_000


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage() as opened:
        yield opened


def get(page: LivePage, path: str, host: str = "") -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=30)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{page.port}"})
    return connection.getresponse()


def next_event(response: http.client.HTTPResponse) -> dict[str, Any]:
    while True:
        line = response.readline()
        assert line, "the page ended"
        if line.startswith(b"data: "):
            event: dict[str, Any] = json.loads(line.removeprefix(b"data: "))
            return event


def test_who_comes_late_gets_the_newest_content_of_each_panel_and_then_what_changes(page: LivePage) -> None:
    for step in range(100):
        page.show("pictures /wm", {"step": step, "signal": [0.5, float("nan")]})
    page.show("nodes", {"rows": []})
    events = get(page, "/events")
    first = [next_event(events) for _ in range(2)]
    assert first[0] == {"panel": "pictures /wm", "content": {"step": 99, "signal": [0.5, None]}}
    assert first[1]["panel"] == "nodes"
    page.show("pictures /wm", {"step": 100})
    assert next_event(events)["content"] == {"step": 100}
    again = get(page, "/events")
    assert [next_event(again)["panel"] for _ in range(2)] == ["pictures /wm", "nodes"], "as after a reconnect"


def test_a_browser_that_reads_nothing_holds_nobody_up_and_is_let_go(
    page: LivePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page._Browser, "timeout", 0.5)
    slow = socket.create_connection(("127.0.0.1", page.port))
    slow.sendall(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
    quick = get(page, "/events")

    def read_to_the_last() -> None:
        while next_event(quick)["content"]["number"] < 99:
            pass

    with ThreadPoolExecutor(1) as reader:
        read = reader.submit(read_to_the_last)
        began = time.process_time()
        for number in range(100):
            page.show("large", {"number": number, "text": LARGE})
        assert time.process_time() - began < 20
        read.result()
    deadline = time.monotonic() + 60
    while page.browsers > 1 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert page.browsers == 1, "the slow one has its seat no more"
    slow.close()


def test_only_pages_of_this_host_are_answered(page: LivePage) -> None:
    assert get(page, "/").status == 200
    assert get(page, "/", host=f"localhost:{page.port}").status == 200
    for path in ("/", "/events"):
        assert get(page, path, host="evil.example").status == 403
    assert get(page, "/etc/passwd").status == 404
    assert page.url.startswith("http://127.0.0.1:")
    assert "script-src 'sha256-" in str(get(page, "/").getheader("Content-Security-Policy"))


def test_more_browsers_than_seats_are_refused_until_one_goes(page: LivePage) -> None:
    page.show("nodes", {"rows": []})
    looking = [get(page, "/events") for _ in range(live_page.BROWSERS)]
    assert [events.status for events in looking] == [200] * live_page.BROWSERS
    assert page.browsers == live_page.BROWSERS
    assert get(page, "/events").status == 503
    looking.pop().close()
    deadline = time.monotonic() + 60
    while page.browsers == live_page.BROWSERS and time.monotonic() < deadline:
        page.show("nodes", {"rows": []})
        time.sleep(0.05)
    assert get(page, "/events").status == 200


def test_a_port_in_use_is_named_with_the_remedy_and_a_closed_page_frees_it(page: LivePage) -> None:
    said = rf"port {page.port} of this host cannot be used .*: Address already in use; give another, or 0"
    for make in (LivePage, lambda port: free_port(str(port))):
        with pytest.raises(ValueError, match=said):
            make(page.port)
    for wrong in ("70000", "-1", "many"):
        with pytest.raises(ValueError, match=f"port.*{wrong}.*or 0 for a free one"):
            free_port(wrong)
    events = get(page, "/events")
    port = page.port
    page.close()
    assert events.read() == b"", "the browser is let go at once"
    with LivePage(port) as again:
        assert again.port == port != int(free_port("0"))
