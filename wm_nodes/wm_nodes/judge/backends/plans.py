"""Choose one call per component or one per stage by the measured hit rate of the server's prefix cache (RA-16)."""

from typing import Literal

from wm_nodes.judge.agent.judge import Cost

Plan = Literal["fanout", "pack"]

FOLLOWERS = 3
"""Calls 2 to 4 of the four warm-up calls: those that follow another one on the same media."""
WORTH_IT = 0.6
"""Share of prompt tokens from the cache at which one call per component pays."""
RECHECK_CALLS = 500


class CallPlan:
    """fanout while measuring and as long as the measured share is >= .6, else pack; measured again every 500 calls."""

    def __init__(self) -> None:
        self.cached_ratio: float | None = None
        """cached_tokens / prompt_tokens of the last measurement; None before the first."""
        self._cached = self._prompt = self._followers = 0
        self._calls_left = 0

    @property
    def is_measuring(self) -> bool:
        return self._calls_left <= 0

    @property
    def plan(self) -> Plan:
        if self.is_measuring or (self.cached_ratio is not None and self.cached_ratio >= WORTH_IT):
            return "fanout"
        return "pack"

    def observe(self, cost: Cost, *, follows: bool) -> None:
        """Count one question that was answered, now or in a run whose answer is kept on disk, so that a rerun of the
        same questions decides alike. follows: another one on the same media was answered before it.
        """
        if not self.is_measuring:
            self._calls_left -= cost.calls
            return
        if not follows or not cost.calls:
            return
        self._cached += cost.cached_tokens
        self._prompt += cost.prompt_tokens
        self._followers += 1
        if self._followers >= FOLLOWERS:
            self.cached_ratio = self._cached / self._prompt if self._prompt else 0.0
            self._cached = self._prompt = self._followers = 0
            self._calls_left = RECHECK_CALLS
