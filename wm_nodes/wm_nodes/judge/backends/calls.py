"""One question to a chat server with its fallbacks.

An answer is checked; a refused one is asked for once more with the reason; then each component is read by a label; then
the read is an ERROR.
"""

import asyncio
import hashlib
import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from wm_nodes.config.judge import JudgeConfig
from wm_nodes.judge.agent import topreward
from wm_nodes.judge.agent.judge import Cost, Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import map_back, one_hot, option_order
from wm_nodes.judge.agent.types import NUM_LEVELS, NUM_PLAN_LEVELS, PLANNING, Component, Stage, Status
from wm_nodes.judge.backends.labels import label_options, option_probabilities
from wm_nodes.judge.backends.prompts import LETTERS, Part, Prompts, prior_level, with_problem
from wm_nodes.judge.backends.protocol import Completion
from wm_nodes.judge.backends.schemas import AnswerError, AnswerFormat, ComponentAnswer
from wm_nodes.judge.backends.transport import ChatAnswer, ChatTransport, TransportError

JSON_TRIES = 2
MEASURED_CALLS = 200
SEED_LIMIT = 2**31
MAX_ANSWER_TOKENS = 1024
"""Of a JSON answer, if extra_body sets none; one that needs more has failed."""
OWN_FIELDS = frozenset((
    "model", "messages", "seed", "response_format", "logprobs", "top_logprobs", "logprob_token_ids",
    "structured_outputs", "stream", "n",
))
"""Of a request, which extra_body may not set."""
TOKEN_LIMITS = frozenset(("max_tokens", "max_completion_tokens"))
"""Whichever of them extra_body sets stands in the place of the judge's own limit."""
Exchange = Mapping[str, Any]
"""The texts of a request and the raw reply, as JSON values, for an audit log."""


@dataclass(frozen=True)
class Call:
    """Some components of a request, to one vote."""

    request: ReadRequest
    """That it is part of."""
    media: list[Part]
    """As sent."""
    media_sha: str
    """SHA-256 of them."""
    deadline: float
    """On the time.monotonic clock, s."""
    vote: Vote
    """How they are asked."""
    components: tuple[Component, ...]
    """Those of this call."""


class Prompt:
    """A request body, how its answer is read, and `sha`: of all of it but the media, which have their own hash."""

    def __init__(
        self, call: Call, messages: list[Part], fields: dict[str, Any], reader: AnswerFormat | tuple[int, ...],
        extra_body: Mapping[str, Any],
    ) -> None:
        seed = call.vote.seed % SEED_LIMIT
        given = TOKEN_LIMITS & extra_body.keys()
        own = {name: value for name, value in fields.items() if not (given and name in TOKEN_LIMITS)}
        self.body = {"messages": messages, "temperature": 0, "seed": seed, **extra_body, **own}
        self.reader = reader
        system, user = messages
        self.sha = sha_of([system, user["content"][len(call.media) :], {**self.body, "messages": None}])


class CallCost:
    """Cost of one call with its retries and fallbacks. Requests without an answer count as retries only."""

    def __init__(self, media: Sequence[Part]) -> None:
        """media: parts of the messages as sent; the frames of a video count as images."""
        videos = [str(part["video_url"]["url"]) for part in media if part["type"] == "video_url"]
        self._num_images = sum(url.count(",") for url in videos) + sum(part["type"] == "image_url" for part in media)
        self.cost = Cost()

    def add_answer(self, answer: ChatAnswer) -> None:
        usage = answer.completion.usage
        self.cost += Cost(
            calls=1, prompt_tokens=usage.prompt_tokens, cached_tokens=usage.cached_tokens,
            completion_tokens=usage.completion_tokens, images=self._num_images, wall_s=answer.wall_s,
            retries=answer.tries - 1,
        )

    def add_failure(self, error: TransportError) -> None:
        self.cost += Cost(retries=max(0, error.tries - 1))


class Caller:
    """Builds prompts, sends them, reads the answers. latencies_s, label_masses: of the last 200 answers.

    on_exchange: called with every request that was answered or failed, refused answers included.
    """

    def __init__(
        self, transport: ChatTransport, prompts: Prompts, settings: JudgeConfig,
        on_exchange: Callable[[Exchange], None] = lambda exchange: None,
    ) -> None:
        self._on_exchange = on_exchange
        self.latencies_s: deque[float] = deque(maxlen=MEASURED_CALLS)
        self.label_masses: deque[float] = deque(maxlen=MEASURED_CALLS)
        self._transport, self._prompts, self._settings = transport, prompts, settings

    def prompt(self, call: Call) -> Prompt:
        return self._json_prompt(call) if call.vote.kind == "json" else self._label_prompt(call, call.components[0])

    async def answer(self, call: Call, prompt: Prompt, bill: CallCost) -> list[Read]:
        """One Read per component of the call; those without an answer have status ERROR and say why."""
        try:
            if isinstance(prompt.reader, AnswerFormat):
                return await self._ask_json(call, prompt.body, prompt.reader, bill)
            return [await self._ask_label(call, call.components[0], prompt, bill)]
        except TransportError as error:
            bill.add_failure(error)
            return [_failed_read(component, call.vote, str(error)) for component in call.components]
        except AnswerError as error:
            return [_failed_read(component, call.vote, str(error)) for component in call.components]

    async def _ask_json(self, call: Call, body: dict[str, Any], form: AnswerFormat, bill: CallCost) -> list[Read]:
        messages, problem = body["messages"], ""
        for _ in range(JSON_TRIES):
            answer = await self._send(call, body, bill, self._settings.json_timeout_s)
            try:
                findings = form.read(_answer_text(answer.completion))
            except AnswerError as error:
                problem = str(error)
                body = {**body, "messages": with_problem(messages, problem)}
                continue
            return [_read_of(finding, call.vote) for finding in findings]
        if call.request.stage is Stage.REFLECT:  # a letter cites no frames
            raise AnswerError(f"{JSON_TRIES} answers were refused, the last one: {problem}")
        return list(await asyncio.gather(*(self._ask_fallback(call, name, bill, problem) for name in call.components)))

    async def _ask_fallback(self, call: Call, component: Component, bill: CallCost, problem: str) -> Read:
        """A label read in place of a JSON answer that was refused twice."""
        try:
            read = await self._ask_label(call, component, self._label_prompt(call, component), bill)
        except (TransportError, AnswerError) as error:
            if isinstance(error, TransportError):
                bill.add_failure(error)
            reason = f"{JSON_TRIES} JSON answers were refused ({problem}); then the label read failed: {error}"
            return _failed_read(component, call.vote, reason)
        return replace(read, reason=read.reason or f"label read, because JSON answers were refused: {problem}")

    async def _ask_label(self, call: Call, component: Component, prompt: Prompt, bill: CallCost) -> Read:
        settings, order = self._settings, prompt.reader
        assert isinstance(order, tuple)  # label prompts are read by the order of their options
        answer = await self._send(call, prompt.body, bill, settings.label_timeout_s)
        truth = call.vote.kind == "truth"
        constrained = settings.choice_grammar and not truth
        words = topreward.WORDS if truth else LETTERS[: len(order)]
        probabilities, mass = option_probabilities(answer.completion, words)
        self.label_masses.append(mass)
        least = self._prompts.rubric.voting.min_label_mass
        if mass == 0 or (mass < least and not constrained):
            reason = f"label mass {mass:.3f} is below {least}"
            return Read(component, (), "label", call.vote, mass, Status.ABSTAIN, reason)
        levels = topreward.levels_of(probabilities) if truth else map_back(probabilities, order)
        return Read(component, levels, "label", call.vote, 1.0 if constrained else mass)

    async def _send(self, call: Call, body: dict[str, Any], bill: CallCost, timeout_s: float) -> ChatAnswer:
        try:
            answer = await self._transport.complete(body, timeout_s=timeout_s, deadline=call.deadline)
        except TransportError as error:
            self._on_exchange({**describe_request(call, body), "error": str(error), "tries": error.tries})
            raise
        took = {"endpoint": answer.endpoint, "tries": answer.tries, "wall_s": answer.wall_s}
        self._on_exchange({**describe_request(call, body), "reply": answer.completion.model_dump(mode="json"), **took})
        bill.add_answer(answer)
        self.latencies_s.append(answer.wall_s)
        return answer

    def _json_prompt(self, call: Call) -> Prompt:
        request = call.request
        form = AnswerFormat(
            request.stage, call.components, [item.index for item in request.media if item.kind == "clip"],
            problems=self._prompts.rubric.component_names,
            prior={score.component: level for score in request.prior if (level := prior_level(score)) is not None},
        )
        fields = {"max_tokens": MAX_ANSWER_TOKENS, "response_format": form.response_format}
        messages = self._prompts.json_question(call.media, request, call.components, form)
        return Prompt(call, messages, fields, form, self._settings.extra_body)

    def _label_prompt(self, call: Call, component: Component) -> Prompt:
        request, settings = call.request, self._settings
        if call.vote.kind == "truth":  # neither token ids, which are those of letters, nor a grammar
            messages = self._prompts.truth_question(call.media, request)
            return Prompt(call, messages, label_options(topreward.WORDS), (), settings.extra_body)
        count = NUM_PLAN_LEVELS if request.stage is Stage.PLAN else NUM_LEVELS
        order = option_order(call.vote, request.clip.sha256, component, count)
        messages = self._prompts.label_question(call.media, request, component, call.vote, order)
        fields = label_options(
            LETTERS[:count], token_ids=settings.label_token_ids[:count], grammar=settings.choice_grammar
        )
        return Prompt(call, messages, fields, order, settings.extra_body)


def describe_request(call: Call, body: Mapping[str, Any]) -> dict[str, Any]:
    """The texts and settings of a request; its images are named by their hash."""
    system, user = body["messages"]
    words = [part["text"] for part in user["content"][len(call.media) :]]
    return {
        "components": list(call.components), "vote": call.vote.index, "media_sha": call.media_sha,
        "prompt": [system["content"], *words], "settings": {key: body[key] for key in body if key != "messages"},
    }


def sha_of(value: Any) -> str:
    """SHA-256, hexadecimal, of a value as canonical JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _answer_text(completion: Completion) -> str:
    choice = completion.choices[0]
    message, text = choice.message, choice.message.content or ""
    thought = message.reasoning or message.reasoning_content or "<think>" in text
    remedy = "; the model reasons first: turn that off by judge.extra_body" if thought else ""
    if choice.finish_reason != "stop":
        raise AnswerError(f"finish_reason is {choice.finish_reason!r}, not 'stop'{remedy}")
    if not text:
        raise AnswerError(f"the answer is empty{remedy}")
    return text


def _read_of(finding: ComponentAnswer, vote: Vote) -> Read:
    count = NUM_PLAN_LEVELS if finding.component == PLANNING else NUM_LEVELS
    return Read(
        finding.component, one_hot(finding.level, count), "json", vote, evidence_text=finding.evidence,
        frames_cited=finding.frames, focus=finding.focus,
    )


def _failed_read(component: Component, vote: Vote, reason: str) -> Read:
    source: Literal["json", "label"] = "json" if vote.kind == "json" else "label"
    return Read(component, (), source, vote, label_mass=0.0, status=Status.ERROR, reason=reason)
