"""The transport of the OpenAI-compatible judge, against a server on real sockets that misbehaves on request."""

import asyncio
import json
import logging
import random
import sys
import time
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from typing import Any
from urllib.parse import quote

import pytest
from chat_server import ChatServer, Fault
from deadlines import within

from wm_nodes.core.imports import MissingPackageError
from wm_nodes.judge.backends.answer_limit import ANSWER_BYTES
from wm_nodes.judge.backends.labels import option_probabilities
from wm_nodes.judge.backends.limits import AdaptiveLimit, Admission, CircuitBreaker
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy, TransportError, retry_after_s

BODY = {"messages": [{"role": "user", "content": "hello"}], "temperature": 0}
QUICK = RetryPolicy(base_s=0.01, cap_s=0.02)


def talk(steps: Callable[[ChatTransport, ChatServer], Awaitable[Any]], server: ChatServer, **options: Any) -> Any:
    """Run `steps` against the server; endpoint options and transport options by name."""

    async def run() -> Any:
        async with server.running():
            own = {name: options.pop(name) for name in ("api_key_env", "max_in_flight") if name in options}
            transport = ChatTransport(
                [Endpoint(server.url, "judge", **own)], **{"retry": QUICK, "jitter": random.Random(0), **options}
            )
            try:
                return await steps(transport, server)
            finally:
                await transport.close()

    return asyncio.run(run())


async def ask(transport: ChatTransport, _: ChatServer) -> Any:
    return await transport.complete(BODY, timeout_s=0.5)


async def ask_patiently(transport: ChatTransport, _: ChatServer) -> Any:
    """For answers that come at once, on a host that may not."""
    return await transport.complete(BODY, timeout_s=20)


def test_answer_usage_and_unknown_fields_pass_through() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        answer = await transport.complete({**BODY, "logprob_token_ids": [5], "seed": 7}, timeout_s=1)
        assert answer.completion.choices[0].message.content == "The clip looks fine to me."
        assert (answer.tries, answer.endpoint) == (1, server.url)
        assert answer.completion.usage.prompt_tokens > 0 and answer.completion.usage.cached_tokens == 0
        assert server.requests == [{**BODY, "model": "judge", "logprob_token_ids": [5], "seed": 7}]

    talk(steps, ChatServer())


@pytest.mark.parametrize(
    "fault",
    [Fault("status", status) for status in (408, 409, 425, 429, 500, 503)]
    + [Fault(kind) for kind in ("reset", "truncated", "slow", "hang", "garbage", "empty")],
    ids=lambda fault: f"{fault.kind}{fault.status if fault.kind == 'status' else ''}",
)
def test_one_failure_is_retried_and_costs_one_try(fault: Fault) -> None:
    server = ChatServer()
    server.faults.append(fault)
    assert talk(ask, server).tries == 2


@pytest.mark.parametrize("count", [-1, 2**64])
def test_an_answer_of_tokens_that_no_message_can_carry_is_none(count: int) -> None:
    class Miscounting(ChatServer):
        def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
            whole = json.loads(super()._completion(body, fault))
            return json.dumps({**whole, "usage": {"prompt_tokens": count, "completion_tokens": 1}})

    with pytest.raises(TransportError, match=r"HTTP 200 without a chat completion: usage\.prompt_tokens"):
        talk(ask_patiently, Miscounting())


@pytest.mark.parametrize("status", [400, 401, 403, 404, 413, 422])
def test_refusals_are_never_retried(status: int) -> None:
    server = ChatServer()
    server.faults.append(Fault("status", status, "bad thing"))
    with pytest.raises(TransportError, match=f"HTTP {status}.*bad thing") as caught:
        talk(ask_patiently, server)
    assert (caught.value.status, caught.value.tries, len(server.requests)) == (status, 1, 1)


def test_gives_up_after_four_tries_and_says_why() -> None:
    server = ChatServer()
    server.faults.extend([Fault("status", 500)] * 4)
    with pytest.raises(TransportError, match=r"gave up after 4 tries.*HTTP 500.*on purpose") as caught:
        talk(ask, server)
    assert (caught.value.status, len(server.requests)) == (500, 4)


def test_retry_after_is_waited_for_and_outside_the_deadline_it_ends_the_call() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        server.faults.append(Fault("status", 429, retry_after="1"))
        began = time.monotonic()
        await transport.complete(BODY, timeout_s=1)
        assert 1.0 <= time.monotonic() - began < within(3)
        server.faults.append(Fault("status", 429, retry_after="60"))
        with pytest.raises(TransportError, match=r"past the deadline; last: .*HTTP 429"):
            await transport.complete(BODY, timeout_s=1, deadline=time.monotonic() + 2)

    talk(steps, ChatServer())


def test_a_deadline_that_cuts_a_try_short_is_not_held_against_the_server() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        async def cut_short() -> None:
            with pytest.raises(TransportError, match=r"past the deadline; last: .*all that the deadline left"):
                await transport.complete(BODY, timeout_s=5, deadline=time.monotonic() + 0.1)

        await asyncio.gather(*(cut_short() for _ in range(20)))
        assert transport.limits() == {server.url: 32} and transport.open_breakers() == []
        with pytest.raises(TransportError, match=r"gave up after 4 tries; last: .*no answer within 0.1 s$"):
            await transport.complete(BODY, timeout_s=0.1)
        assert transport.limits() == {server.url: 2}

    talk(steps, ChatServer(delay_s=0.3))


def test_retry_after_reads_seconds_and_dates_and_nothing_else() -> None:
    soon = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    assert retry_after_s({"retry-after": "7"}) == 7
    assert 28 <= retry_after_s({"retry-after": soon}) <= 30
    past = format_datetime(datetime.now(UTC) - timedelta(seconds=30), usegmt=True)
    assert [retry_after_s({"retry-after": text}) for text in (past, "soon", "nan", "inf", "-3", "", "²")] == [0.0] * 7
    assert retry_after_s({}) == 0


def test_waits_have_full_jitter() -> None:
    asked: list[tuple[float, float]] = []

    class Lowest(random.Random):
        def uniform(self, a: float, b: float) -> float:
            asked.append((a, b))
            return 0.0

    server = ChatServer()
    server.faults.extend([Fault("status", 500)] * 7)
    with pytest.raises(TransportError):
        talk(ask, server, retry=RetryPolicy(tries=7, base_s=0.5, cap_s=8), jitter=Lowest())
    assert asked == [(0, 0.5), (0, 1), (0, 2), (0, 4), (0, 8), (0, 8)]


def test_no_more_calls_at_once_than_the_limit() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        await asyncio.gather(*(transport.complete(BODY, timeout_s=5) for _ in range(12)))
        assert server.most_in_flight == 3

    talk(steps, ChatServer(delay_s=0.02), max_in_flight=3)


def test_one_burst_of_429_halves_the_limit_once() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        server.faults.extend([Fault("status", 429)] * 8)
        await asyncio.gather(*(transport.complete(BODY, timeout_s=5) for _ in range(8)))
        assert transport.limits() == {server.url: 4}

    talk(steps, ChatServer(delay_s=0.05), max_in_flight=8)


def test_fifty_good_answers_raise_the_limit_by_one_up_to_its_maximum() -> None:
    async def run() -> None:
        limit = AdaptiveLimit(4)
        ticket = await limit.acquire()
        limit.record_overload(ticket)
        limit.record_overload(ticket)
        assert limit.limit == 2
        seen = []
        for _ in range(200):
            limit.record_success()
            seen.append(limit.limit)
        assert (seen[48], seen[49], seen[99], seen[199]) == (2, 3, 4, 4)

    asyncio.run(run())


def test_breaker_opens_above_half_of_twenty_and_closes_after_a_good_probe() -> None:
    clock = [0.0]
    breaker = CircuitBreaker(lambda: clock[0])
    for number in range(20):
        breaker.record(breaker.admit(), failed=number % 2 == 0)
    assert not breaker.is_open  # exactly half
    breaker.record(breaker.admit(), failed=False)  # pushes a failure out
    for _ in range(2):
        breaker.record(Admission.YES, failed=True)
    assert not breaker.is_open
    for _ in range(2):
        breaker.record(Admission.YES, failed=True)
    assert breaker.is_open and breaker.admit() is Admission.NO
    clock[0] = 10.0
    assert [breaker.admit(), breaker.admit()] == [Admission.PROBE, Admission.NO]
    breaker.record(Admission.YES, failed=False)  # began before it opened
    breaker.record(Admission.PROBE, failed=True)
    assert breaker.is_open
    clock[0] = 20.0
    breaker.record(breaker.admit(), failed=False)
    assert not breaker.is_open and breaker.admit() is Admission.YES


def test_dead_endpoint_is_left_alone_then_probed_and_used_again() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        server.faults.extend([Fault("status", 500)] * 20)
        for _ in range(5):
            with pytest.raises(TransportError):
                await transport.complete(BODY, timeout_s=1)
        assert transport.open_breakers() == [server.url]
        with pytest.raises(TransportError, match=r"circuit breaker of .* is open"):
            await transport.complete(BODY, timeout_s=1)
        assert len(server.requests) == 20
        await asyncio.sleep(0.3)
        assert (await transport.complete(BODY, timeout_s=1)).tries == 1
        assert transport.open_breakers() == []

    talk(steps, ChatServer(), probe_s=0.3)


def test_second_endpoint_answers_at_once_where_the_first_fails() -> None:
    async def run() -> None:
        first, second = ChatServer(), ChatServer()
        async with first.running(), second.running():
            endpoints = [Endpoint(server.url, "judge") for server in (first, second)]
            transport = ChatTransport(endpoints, retry=RetryPolicy(base_s=8, cap_s=8), jitter=random.Random(1))
            first.faults.append(Fault("status", 429, retry_after="30"))
            began = time.monotonic()
            answer = await transport.complete(BODY, timeout_s=1)
            assert answer.endpoint == second.url and time.monotonic() - began < within(1)
            assert (await transport.complete(BODY, timeout_s=1)).endpoint == first.url
            await transport.close()

    asyncio.run(run())


class EchoingServer(ChatServer):
    """Says in a valid answer what key it was sent."""

    def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
        key = self.headers[-1]["authorization"].removeprefix("Bearer ")
        return super()._completion(body, fault).replace("The clip looks fine to me.", f"I was sent {key}.")


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_a_redirect_is_refused_and_neither_frames_nor_key_go_there(
    status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WM_TEST_KEY", "sk-very-secret")
    elsewhere = ChatServer()

    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        async with elsewhere.running():
            there = f"{elsewhere.url}/chat/completions?key=sk-very-secret"
            server.faults.append(Fault("status", status, location=there))
            with pytest.raises(TransportError, match=r"which is not followed.*name it in judge\.endpoints") as caught:
                await transport.complete(BODY, timeout_s=20)
            host = elsewhere.url.split("/")[2]
            assert f"HTTP {status}: it redirects to {host}," in str(caught.value) and "secret" not in str(caught.value)
            assert (caught.value.status, caught.value.tries) == (status, 1)

    talk(steps, ChatServer(), api_key_env="WM_TEST_KEY")
    assert not elsewhere.requests


@pytest.mark.parametrize("status", [200, 400, 500])
def test_an_endless_answer_is_read_up_to_a_limit_only(status: int) -> None:
    server = ChatServer()
    server.faults.extend([Fault("endless", status)] * 2)
    with pytest.raises(TransportError, match="the answer is longer than 8 MiB"):
        talk(ask_patiently, server, retry=RetryPolicy(tries=2, base_s=0.01, cap_s=0.02))
    assert server.num_endless_bytes < 2 * ANSWER_BYTES + (16 << 20), "the rest lies in the sockets"


def test_a_compressed_answer_which_could_grow_is_no_answer() -> None:
    server = ChatServer()
    server.faults.append(Fault("compressed"))
    assert talk(ask_patiently, server).tries == 2
    assert server.headers[0]["accept-encoding"] == "identity"


@pytest.mark.parametrize("key", ["a/b+c=d/e", 'quo"te\\back', "it's_mine", "<&><&><&>", "%2F%2f%2F", "[0-9]+[a-z]+"])
def test_a_key_is_found_however_it_is_written(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WM_TEST_KEY", key)
    escaped = json.dumps(key)[1:-1].replace("/", "\\/")
    codes = "".join(f"\\u{ord(character):04X}" for character in key)
    inner = json.dumps({"evidence": f"{escaped} {codes}"})
    texts = [key, escaped, codes, quote(key, safe=""), repr(key)[1:-1], inner, json.dumps(inner)]
    server = ChatServer()
    server.faults.extend(Fault("reply", text=f"I was sent {text}.") for text in texts)
    server.faults.append(Fault("status", 401, "x" * 490 + key))

    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        for text in texts:
            answer = await transport.complete(BODY, timeout_s=20)
            said = str(answer.completion.choices[0].message.content)
            assert "[WM_TEST_KEY]" in said and key not in said and text not in said
        with pytest.raises(TransportError) as caught:
            await transport.complete(BODY, timeout_s=20)
        assert key[:2] not in str(caught.value).partition("x" * 400)[2].rstrip("'}")

    talk(steps, server, api_key_env="WM_TEST_KEY")


@pytest.mark.parametrize("key", ["none", "token", "null", "pw", "[0-9]+"])
def test_a_short_key_changes_no_answer_and_stands_in_no_error(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WM_TEST_KEY", key)
    said = '{"visible_problems": ["none"], "summary": "tokens [0-9]+"}'
    server = ChatServer(labels={"A": 1.0})
    server.faults.extend([Fault("reply", text=said), Fault("status", 401, f"wrong key <{key}>")])

    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        answer = await ask_patiently(transport, server)
        assert answer.completion.choices[0].message.content == said and answer.completion.usage.prompt_tokens > 0
        with pytest.raises(TransportError, match=r"<\[WM_TEST_KEY\]>"):
            await ask_patiently(transport, server)
        letters = await transport.complete({**BODY, "logprobs": True}, timeout_s=20)
        assert option_probabilities(letters.completion, "AB") == ((1.0, 0.0), 1.0)

    talk(steps, server, api_key_env="WM_TEST_KEY")


@pytest.mark.parametrize("key", ["two words", "broken\n", "schlüssel"])
def test_a_key_that_no_header_can_carry_is_refused_without_being_repeated(
    key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WM_TEST_KEY", key)
    with pytest.raises(ValueError, match="the key in WM_TEST_KEY holds a blank, a line break") as caught:
        ChatTransport([Endpoint("http://127.0.0.1:1/v1", "judge", "WM_TEST_KEY")])
    assert key.strip() not in str(caught.value)


def test_key_comes_from_the_named_variable_and_reaches_no_log_and_no_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("WM_TEST_KEY", "sk-very-secret")
    monkeypatch.setenv("OPENAI_API_KEY", "sk-not-for-this-server")
    caplog.set_level(logging.DEBUG)
    server = ChatServer()
    server.faults.append(Fault("status", 401, "wrong key: Bearer sk-very-secret"))
    with pytest.raises(TransportError, match=r"wrong key: Bearer \[WM_TEST_KEY\]") as caught:
        talk(ask, server, api_key_env="WM_TEST_KEY")
    assert server.headers[0]["authorization"] == "Bearer sk-very-secret"
    assert "secret" not in caplog.text + repr(caught.value) + repr(caught.value.__cause__)
    echo = talk(ask_patiently, EchoingServer(), api_key_env="WM_TEST_KEY")
    assert echo.completion.choices[0].message.content == "I was sent [WM_TEST_KEY]."
    open_server = ChatServer()
    talk(ask, open_server)
    assert open_server.headers[0]["authorization"] == "Bearer none"


def test_bad_settings_name_the_value_and_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WM_TEST_KEY", raising=False)
    with pytest.raises(ValueError, match="environment variable WM_TEST_KEY; export it"):
        ChatTransport([Endpoint("http://127.0.0.1:1/v1", "judge", "WM_TEST_KEY")])
    with pytest.raises(ValueError, match="at least one endpoint"):
        ChatTransport([])
    with pytest.raises(ValueError, match="must look like http"):
        Endpoint("127.0.0.1:8000", "judge")
    with pytest.raises(ValueError, match="user name") as caught:
        Endpoint("http://me:hunter2@host/v1", "judge")
    assert "hunter2" not in str(caught.value)
    with pytest.raises(ValueError, match="tries must be >= 1"):
        RetryPolicy(tries=0)


def test_missing_package_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(MissingPackageError, match=r"pip install -c .* -r requirements/judge.txt"):
        ChatTransport([Endpoint("http://127.0.0.1:1/v1", "judge")])


def test_served_models_are_listed_and_silent_servers_left_out() -> None:
    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        assert await transport.served_models() == {server.url: ["judge"]}

    talk(steps, ChatServer())
    gone = ChatTransport([Endpoint("http://127.0.0.1:9/v1", "judge")])
    assert asyncio.run(gone.served_models()) == {}


@pytest.mark.parametrize(
    ("listing", "served"),
    [("{}", [[]]), ('{"data": null}', [[]]), ('{"data": [{"id": "judge", "owned_by": 3}]}', [["judge"]]), ("null", []),
     ('{"data": [{}]}', []), ('["judge"]', []), ("[" * 100_000, [])],
    ids=["empty", "null_data", "one", "null", "no_name", "list", "nested"],
)
def test_a_server_that_lists_its_models_otherwise_or_not_at_all_is_told_and_nothing_falls(
    listing: str, served: list[list[str]]
) -> None:
    class Listing(ChatServer):
        async def _send(
            self, writer: asyncio.StreamWriter, status: int, text: str, extra: str = "", length: int | None = None
        ) -> None:
            await super()._send(writer, status, listing)

    async def steps(transport: ChatTransport, server: ChatServer) -> None:
        assert [*(await transport.served_models()).values()] == served

    talk(steps, Listing())
