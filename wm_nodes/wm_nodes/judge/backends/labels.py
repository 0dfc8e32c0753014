"""Label reads: one token, and how probable each option was (RA-6)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from wm_nodes.judge.backends.protocol import Completion
from wm_nodes.judge.backends.schemas import AnswerError

TOP_LOGPROBS = 20
ROUNDING = 1e-3
"""Servers round log-probabilities; a mass above 1 by less than this is 1."""


def label_options(letters: Sequence[str], *, token_ids: Sequence[int] = (), grammar: bool = False) -> dict[str, Any]:
    """Body fields of a label read.

    Args:
        token_ids: of the letters, for servers that give log-probabilities of named tokens (vLLM from 0.32); without
            them the letters must be among the 20 likeliest tokens.
        grammar: let the server choose among the letters only (vLLM). Their mass then says nothing about the answer.
    """
    fields: dict[str, Any] = {"max_tokens": 1, "logprobs": True}
    if token_ids:
        fields["logprob_token_ids"] = list(token_ids)
    else:
        fields["top_logprobs"] = TOP_LOGPROBS
    if grammar:
        fields["structured_outputs"] = {"choice": list(letters)}
    return fields


def option_probabilities(completion: Completion, letters: Sequence[str]) -> tuple[tuple[float, ...], float]:
    """Return the probability of each letter, normalised over the letters, and their mass before that, in [0, 1].

    A letter counts with and without a blank around it. With no mass at all the probabilities are empty.

    Raises:
        AnswerError: the server gave no log-probabilities, or impossible ones.
    """
    logprobs = completion.choices[0].logprobs
    if logprobs is None or not logprobs.content:
        raise AnswerError("the server gives no logprobs; label reads need one that does, such as vLLM")
    first = logprobs.content[0]
    by_token: Mapping[str, float] = {top.token: top.logprob for top in (first, *first.top_logprobs)}
    if any(math.isnan(value) or value > ROUNDING for value in by_token.values()):
        raise AnswerError(f"the server gives log-probabilities above 0 or NaN: {dict(by_token)}")
    probabilities = dict.fromkeys(letters, 0.0)
    for token, logprob in by_token.items():
        if token.strip() in probabilities:
            probabilities[token.strip()] += math.exp(logprob)
    mass = math.fsum(probabilities.values())
    if mass > 1 + ROUNDING:
        raise AnswerError(f"probabilities of the options sum to {mass:.4f}")
    if mass == 0:
        return (), 0.0
    return tuple(probability / mass for probability in probabilities.values()), min(mass, 1.0)
