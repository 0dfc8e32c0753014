"""The part of a chat completion that a judge reads; servers add more, which is dropped."""

from typing import Any

from pydantic import BaseModel, Field


class TopLogprob(BaseModel):
    token: str
    logprob: float


class TokenLogprobs(TopLogprob):
    top_logprobs: list[TopLogprob] = Field(default_factory=list)


class ChoiceLogprobs(BaseModel):
    content: list[TokenLogprobs] | None = None


class Message(BaseModel):
    """reasoning, reasoning_content: where servers put a model's thoughts; no part of the answer."""

    content: str | None = None
    reasoning: Any = None
    reasoning_content: Any = None


class Choice(BaseModel):
    message: Message
    finish_reason: str | None = None
    logprobs: ChoiceLogprobs | None = None


class PromptTokens(BaseModel):
    cached_tokens: int | None = None


class Usage(BaseModel):
    prompt_tokens: int = 0
    completion_tokens: int = 0
    prompt_tokens_details: PromptTokens | None = None

    @property
    def cached_tokens(self) -> int:
        return (self.prompt_tokens_details and self.prompt_tokens_details.cached_tokens) or 0


class Completion(BaseModel):
    """A body that came with HTTP 200; anything that does not fit is no answer."""

    choices: list[Choice] = Field(min_length=1)
    model: str = ""
    usage: Usage = Field(default_factory=Usage)
