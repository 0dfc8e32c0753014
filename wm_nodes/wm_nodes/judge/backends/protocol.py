"""The parts of a chat completion and of a list of models that a judge reads; servers add more, which is dropped."""

from typing import Annotated, Any

from pydantic import BaseModel, Field

Count = Annotated[int, Field(ge=0, lt=2**31)]
"""Fits into messages, also many together."""


class TopLogprob(BaseModel):
    token: str
    logprob: float


class TokenLogprobs(TopLogprob):
    top_logprobs: list[TopLogprob] = Field(default_factory=list)


class ChoiceLogprobs(BaseModel):
    content: list[TokenLogprobs] | None = None


class Message(BaseModel):
    """What the model said."""

    content: str | None = None
    """The answer."""
    reasoning: Any = None
    """Where servers put a model's thoughts; no part of the answer."""
    reasoning_content: Any = None
    """The same, of other servers."""


class Choice(BaseModel):
    """One answer."""

    message: Message
    """Of the model."""
    finish_reason: str | None = None
    """"length" where it was cut off."""
    logprobs: ChoiceLogprobs | None = None
    """Where they were asked for."""


class PromptTokens(BaseModel):
    cached_tokens: Count | None = None


class Usage(BaseModel):
    """Tokens of a request."""

    prompt_tokens: Count = 0
    """Sent."""
    completion_tokens: Count = 0
    """Received."""
    prompt_tokens_details: PromptTokens | None = None
    """How many of them the server had."""

    @property
    def cached_tokens(self) -> int:
        return (self.prompt_tokens_details and self.prompt_tokens_details.cached_tokens) or 0


class Completion(BaseModel):
    """A body that came with HTTP 200; anything that does not fit is no answer."""

    choices: list[Choice] = Field(min_length=1)
    """One."""
    model: str = ""
    """Its name."""
    usage: Usage = Field(default_factory=Usage)
    """What it took."""


class ListedModel(BaseModel):
    id: str


class ModelList(BaseModel):
    """What a server says that it serves; some say nothing."""

    data: list[ListedModel] | None = None
