"""Chat completions over an ordered list of endpoints: bounded, retried, never silently wrong.

The `openai` package speaks the protocol; its own retries are off, because which endpoint a retry goes to, how long it
waits and what counts against an endpoint are decided here.
"""

import asyncio
import contextlib
import os
import random
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import urlsplit

from pydantic import ValidationError

from wm_nodes.core.imports import optional_package
from wm_nodes.judge.audit.log import MIN_SECRET
from wm_nodes.judge.backends.limits import AdaptiveLimit, Admission, CircuitBreaker
from wm_nodes.judge.backends.protocol import Completion, ModelList

CONNECT_S = 5.0
OVERLOAD = (429, 503)
_RETRIED = (408, 409, 425, 429)
_HEADER_VALUE = re.compile("[!-~]+")
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class TransportError(RuntimeError):
    """No usable answer came back. status: the last HTTP status, None without one. tries: requests that were sent."""

    def __init__(self, reason: str, *, status: int | None = None, tries: int = 0) -> None:
        super().__init__(reason)
        self.status, self.tries = status, tries

    def with_reason(self, reason: str) -> "TransportError":
        """Why the call ends with this error instead of one more try."""
        return TransportError(f"{reason}; last: {self}", status=self.status, tries=self.tries)


@dataclass(frozen=True)
class Endpoint:
    """One server. Raises ValueError: a URL that is not http(s), or one with a user name or password in it."""

    base_url: str
    """With its /v1."""
    model: str
    """The name the server knows."""
    api_key_env: str = ""
    """The environment variable that holds the key, "" for a server that wants none; a key itself is never part of any
    setting."""
    max_in_flight: int = 32
    """Calls under way at once."""

    def __post_init__(self) -> None:
        parts = urlsplit(self.base_url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"base_url must look like http://127.0.0.1:8000/v1, got {self.base_url!r}")
        if parts.username or parts.password or parts.query:
            raise ValueError(
                f"base_url of {parts.hostname} carries a user name, password or query; "
                "put the key into an environment variable and name it in api_key_env"
            )

    def api_key(self) -> str:
        """Return the key, or "none" for a server that wants none. Raises ValueError: the variable is not set."""
        if not self.api_key_env:
            return "none"
        key = os.environ.get(self.api_key_env, "")
        if not key:
            raise ValueError(f"{self.base_url} needs a key in the environment variable {self.api_key_env}; export it")
        if not _HEADER_VALUE.fullmatch(key):
            raise ValueError(
                f"the key in {self.api_key_env} holds a blank, a line break or a character that is not ASCII, which no "
                "HTTP header carries; export it again without that"
            )
        return key


@dataclass(frozen=True)
class RetryPolicy:
    """How often and when a call is tried again; a longer Retry-After is honoured."""

    tries: int = 4
    """Requests per call at most."""
    base_s: float = 0.5
    """Waits are drawn from [0, min(cap_s, base_s 2^i)] before retry i (full jitter)."""
    cap_s: float = 8.0
    """The longest wait."""

    def __post_init__(self) -> None:
        if self.tries < 1 or not 0 <= self.base_s <= self.cap_s:
            raise ValueError(f"tries must be >= 1 and 0 <= base_s <= cap_s, got {self}")


@dataclass(frozen=True)
class ChatAnswer:
    """A completion, and what it took."""

    completion: Completion
    """The answer."""
    endpoint: str
    """URL of the server."""
    tries: int
    """Requests sent, at least 1."""
    wall_s: float
    """With waits and retries."""


class _Server:
    """An endpoint with its client, limit and breaker."""

    def __init__(self, endpoint: Endpoint, client: Any, probe_s: float) -> None:
        self.endpoint, self.client = endpoint, client
        key = endpoint.api_key() if endpoint.api_key_env else ""
        self._key, self._is_key_unique = _written_anyhow(key) if key else None, len(key) >= MIN_SECRET
        self.limit = AdaptiveLimit(endpoint.max_in_flight)
        self.breaker = CircuitBreaker(time.monotonic, probe_s=probe_s)

    def clean(self, text: str) -> str:
        """The text without the key: servers repeat headers in their error messages."""
        return self._key.sub(f"[{self.endpoint.api_key_env}]", text) if self._key else text

    def clean_answer(self, body: str) -> str:
        """The body without the key, which some servers repeat, too. One like `none` or `token` may be any word of an
        answer, and stays."""
        return self.clean(body) if self._is_key_unique else body


class ChatTransport:
    """Sends chat completions. Belongs to the event loop of its first call; close it there.

    Raises:
        MissingPackageError: the openai package is not installed.
        ValueError: no endpoint, or a key's environment variable is not set.
    """

    def __init__(
        self, endpoints: Sequence[Endpoint], *, retry: RetryPolicy | None = None, probe_s: float = 10.0,
        jitter: random.Random | None = None,
    ) -> None:
        if not endpoints:
            raise ValueError("a judge needs at least one endpoint, e.g. http://127.0.0.1:8000/v1")
        if len({endpoint.base_url for endpoint in endpoints}) < len(endpoints):
            raise ValueError(f"an endpoint is named twice in {[endpoint.base_url for endpoint in endpoints]}")
        self._openai = optional_package(
            "openai", needed_by="the OpenAI-compatible judge needs", requirements="judge.txt"
        )
        self._retry = retry or RetryPolicy()
        self._jitter = jitter or random.Random()
        self._servers = [_Server(endpoint, self._client(endpoint), probe_s) for endpoint in endpoints]

    @property
    def models(self) -> set[str]:
        """Names of the models that the endpoints serve."""
        return {server.endpoint.model for server in self._servers}

    async def close(self) -> None:
        for server in self._servers:
            await server.client.close()

    def open_breakers(self) -> list[str]:
        """URLs of the endpoints that are left alone at present."""
        return [server.endpoint.base_url for server in self._servers if server.breaker.is_open]

    def limits(self) -> dict[str, int]:
        """Calls that may be under way at once, by URL."""
        return {server.endpoint.base_url: server.limit.limit for server in self._servers}

    async def served_models(self) -> dict[str, list[str]]:
        """Model names by URL, of the endpoints that answer within the time to connect; one try each."""
        models = {}
        for server in self._servers:
            try:
                async with asyncio.timeout(2 * CONNECT_S):
                    raw = await server.client.models.with_raw_response.list()
                listed = ModelList.model_validate_json(raw.http_response.text)
            except (self._openai.OpenAIError, TimeoutError, ValueError):
                continue
            models[server.endpoint.base_url] = [model.id for model in listed.data or ()]
        return models

    async def complete(self, body: Mapping[str, Any], *, timeout_s: float, deadline: float | None = None) -> ChatAnswer:
        """Send one chat completion; `body` holds everything but the model, unknown fields included.

        Args:
            timeout_s: for one try, from the free place to the last byte; a server that drips bytes is caught too.
            deadline: of all tries, on the time.monotonic clock, s.

        Raises:
            TransportError: refused (a status that is never retried), all tries used up, every breaker open, or the
                deadline passed.
        """
        began = time.monotonic()
        tried: set[str] = set()
        last = TransportError("no endpoint was asked")
        for attempt in range(self._retry.tries):
            picked = self._pick(tried)
            if picked is None:
                urls = ", ".join(self.open_breakers())
                raise last.with_reason(f"the circuit breaker of {urls} is open after too many failures")
            server, admission = picked
            url = server.endpoint.base_url
            tried.add(url)
            try:
                completion = await self._try(server, admission, body, timeout_s, deadline)
                return ChatAnswer(completion, url, attempt + 1, time.monotonic() - began)
            except _FailedTry as failure:
                last = TransportError(f"{url}: {server.clean(str(failure))}", status=failure.status, tries=attempt + 1)
                if failure.refused:
                    raise last from None
                asked_s = failure.retry_after_s
            # a retry goes to another endpoint at once
            untried = any(not s.breaker.is_open and s.endpoint.base_url not in tried for s in self._servers)
            if attempt + 1 < self._retry.tries and not untried:
                longest_s = min(self._retry.cap_s, self._retry.base_s * 2**attempt)
                wait_s = max(self._jitter.uniform(0, longest_s), asked_s)
                if deadline is not None and time.monotonic() + wait_s > deadline:
                    raise last.with_reason(f"the next try, in {wait_s:.1f} s, is past the deadline")
                await asyncio.sleep(wait_s)
        raise last.with_reason(f"gave up after {self._retry.tries} tries")

    def _pick(self, tried: set[str]) -> tuple[_Server, Admission] | None:
        """The first endpoint, in order, that admits a call; those that failed in this call come last."""
        for server in sorted(self._servers, key=lambda server: server.endpoint.base_url in tried):
            admission = server.breaker.admit()
            if admission is not Admission.NO:
                return server, admission
        return None

    async def _try(
        self, server: _Server, admission: Admission, body: Mapping[str, Any], timeout_s: float, deadline: float | None
    ) -> Completion:
        """One request to one server, counted in its limit and breaker."""
        limit, breaker = server.limit, server.breaker
        try:
            async with asyncio.timeout(_left_s(deadline)):
                ticket = await limit.acquire()
        except TimeoutError:
            raise _FailedTry("no place became free before the deadline") from None
        try:
            completion = await self._request(server, body, timeout_s, _left_s(deadline))
        except _FailedTry as failure:
            if failure.status in OVERLOAD or failure.timed_out:
                limit.record_overload(ticket)
            if not failure.out_of_time:
                breaker.record(admission, failed=not failure.refused and failure.status != 429)
            raise
        else:
            limit.record_success()
            breaker.record(admission, failed=False)
            return completion
        finally:
            await limit.release()

    async def _request(
        self, server: _Server, body: Mapping[str, Any], timeout_s: float, left_s: float | None
    ) -> Completion:
        openai = self._openai
        create = server.client.chat.completions.with_raw_response.create
        cut_short = left_s is not None and left_s < timeout_s
        allowed_s = left_s if cut_short else timeout_s
        try:
            async with asyncio.timeout(allowed_s):
                raw = await create(
                    model=server.endpoint.model,
                    messages=body["messages"],
                    extra_body={key: value for key, value in body.items() if key != "messages"},
                )
            return Completion.model_validate_json(server.clean_answer(raw.http_response.text))
        except (TimeoutError, openai.APITimeoutError):
            text = f"no answer within {allowed_s:.1f} s"
            if cut_short:
                raise _FailedTry(f"{text}, all that the deadline left", out_of_time=True) from None
            raise _FailedTry(text, timed_out=True) from None
        except openai.APIStatusError as error:
            status = error.status_code
            text = f"HTTP {status}: {server.clean(error.message)[:500]}"
            if error.response.has_redirect_location:
                to = urlsplit(server.clean(error.response.headers["location"])).netloc or "another path"
                text = (
                    f"HTTP {status}: it redirects to {to[:200]}, which is not followed, as frames and key would go "
                    "there; if it is the judge, name it in judge.endpoints"
                )
            refused = status not in _RETRIED and status < 500
            raise _FailedTry(text, status, retry_after_s(error.response.headers), refused=refused) from None
        except openai.APIConnectionError as error:
            raise _FailedTry(f"connection failed: {error.__cause__ or error}") from None
        except ValidationError as error:
            first = error.errors(include_input=False, include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "body"
            raise _FailedTry(f"HTTP 200 without a chat completion: {where}: {first['msg']}") from None

    def _client(self, endpoint: Endpoint) -> Any:
        """A client without retries of its own that follows no redirect and reads no endless answer. A loopback server
        is never reached through a proxy.
        """
        from wm_nodes.judge.backends.answer_limit import bound_answer  # it needs the client package

        loopback = urlsplit(endpoint.base_url).hostname in _LOOPBACK
        return self._openai.AsyncOpenAI(
            base_url=endpoint.base_url, api_key=endpoint.api_key(), max_retries=0,
            timeout=self._openai.Timeout(None, connect=CONNECT_S),
            http_client=self._openai.DefaultAsyncHttpxClient(
                trust_env=not loopback, follow_redirects=False, event_hooks={"response": [bound_answer]},
                headers={"Accept-Encoding": "identity"},
            ),
        )


class _FailedTry(Exception):
    """refused: the server will not change its mind. timed_out: it had its full time. out_of_time: it had not."""

    def __init__(
        self, text: str, status: int | None = None, retry_after_s: float = 0.0, *,
        refused: bool = False, timed_out: bool = False, out_of_time: bool = False,
    ) -> None:
        super().__init__(text)
        self.status, self.retry_after_s = status, retry_after_s
        self.refused, self.timed_out, self.out_of_time = refused, timed_out, out_of_time


def _written_anyhow(key: str) -> re.Pattern[str]:
    """What finds a key as it is, and as it stands in JSON or in a URL: servers may write / as \\/, \\u002f or %2F.

    The backslashes may have been doubled, by JSON inside JSON.
    """
    forms = (rf"(?:{re.escape(c)}|u00{ord(c):02x}|%{ord(c):02x})" for c in key)
    return re.compile("".join(rf"\\{{0,16}}{form}" for form in forms), re.IGNORECASE)


def _left_s(deadline: float | None) -> float | None:
    return None if deadline is None else deadline - time.monotonic()


def retry_after_s(headers: Mapping[str, str]) -> float:
    """Seconds that a Retry-After header asks for, as a number or as an HTTP date; 0 without a readable one."""
    value = headers.get("retry-after", "").strip()
    if value.isdecimal():
        return float(value)
    with contextlib.suppress(ValueError):
        moment = parsedate_to_datetime(value)
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        return max(0.0, (moment - datetime.now(UTC)).total_seconds())
    return 0.0

