"""How long the learner waits for a lost node, and how often it repeats a rollout of which something is missing."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from wm_msgs.action import Rollout
from wm_nodes.nodes.learner import rollout_sources
from wm_nodes.nodes.learner.rollout_sources import MAX_GAP_RETRIES, RETRY_S, LiveRollouts
from wm_nodes.ros.wire import PeerLost

RECOVERY_S = 60.0


class Bench:
    """A learner's rollouts with a clock of its own. Each attempt is a function that passes time and returns how many
    lock-steps will lack something, or raises PeerLost; the last one is repeated."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *attempts: Callable[["Bench"], int], join_s: float = 5.0):
        self.now_s, self.made, self._attempts, self._gap = 0.0, 0, list(attempts), 0
        self.warnings: list[str] = []
        monkeypatch.setattr(rollout_sources, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        monkeypatch.setattr(rollout_sources, "run_goal", self._run_goal)
        params = {"recovery_timeout_s": RECOVERY_S, "join_timeout_s": join_s}
        logger = SimpleNamespace(info=lambda text: None, warning=self.warnings.append)
        node: Any = SimpleNamespace(
            param=params.get, get_logger=lambda: logger, get_namespace=lambda: "/wm",
            peers=SimpleNamespace(lost=(), identity=lambda name: 1, is_lost=lambda name: False),
            diagnostics=SimpleNamespace(count=lambda *args, **more: None),
        )
        self.assembler = assembler = SimpleNamespace(
            num_collected=0, begin=lambda: None, missing=lambda *span: [0] * self._gap, wait=self.pass_time,
            take=lambda *args: "rollout",
        )
        work: Any = SimpleNamespace(sleep=self.pass_time)
        progress: Any = SimpleNamespace(version=1)
        self.source = LiveRollouts(
            node, work, lambda: None, progress, assembler, object(), num_steps=4, seed=0  # type: ignore[arg-type]
        )

    def pass_time(self, seconds: float) -> None:
        self.now_s += seconds

    def _run_goal(self, *args: Any, **more: Any) -> Rollout.Result:
        attempt = self._attempts[min(self.made, len(self._attempts) - 1)]
        self.made, self.assembler.num_collected = self.made + 1, 0
        self._gap = attempt(self)
        return Rollout.Result(termination_reason=Rollout.Result.FINISHED)


def lost(after_s: float, steps: int = 0) -> Callable[[Bench], int]:
    def attempt(bench: Bench) -> int:
        bench.pass_time(after_s)
        bench.assembler.num_collected = steps
        raise PeerLost("/wm/environment is silent")

    return attempt


def made(after_s: float, gap: int = 0) -> Callable[[Bench], int]:
    def attempt(bench: Bench) -> int:
        bench.pass_time(after_s)
        return gap

    return attempt


def test_the_wait_for_a_lost_node_begins_when_it_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, lost(70.0), lost(5.0), lost(0.0), made(70.0))
    assert bench.source.next() == "rollout"
    assert bench.made == 4
    bench = Bench(monkeypatch, lost(70.0, steps=90), lost(70.0, steps=90), made(70.0))
    assert bench.source.next() == "rollout", "the node was there for the 70 s of the second attempt"


def test_a_node_that_does_not_come_back_in_time_ends_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, lost(70.0), lost(0.0))
    with pytest.raises(PeerLost, match="environment is silent; nothing came back for 60 s"):
        bench.source.next()
    assert bench.now_s == pytest.approx(70.0 + RECOVERY_S, abs=2 * RETRY_S)
    bench = Bench(monkeypatch, lost(10.0))
    with pytest.raises(PeerLost, match="nothing came back for 60 s"):
        bench.source.next()
    assert bench.now_s == pytest.approx(10.0 + RECOVERY_S, abs=11.0), "attempts that wait for an answer count"
    bench = Bench(monkeypatch, lost(1.2 * RECOVERY_S))
    with pytest.raises(PeerLost, match="nothing came back for 60 s"):
        bench.source.next()
    assert bench.made == 2, "however long they wait"


def test_a_rollout_with_gaps_is_repeated_by_count_however_long_each_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, made(90.0, gap=1), made(90.0), join_s=600.0)
    assert bench.source.next() == "rollout"
    assert bench.made == 2 and "1 lock-steps did not arrive" in bench.warnings[0]
    bench = Bench(monkeypatch, made(90.0, gap=1), join_s=600.0)
    assert bench.source.next() == "rollout"
    assert bench.made == MAX_GAP_RETRIES + 2, "the last one is taken with its gaps"


def test_a_lost_node_is_no_gap_and_a_rollout_that_was_made_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    losses = [lost(0.0)] * 5
    bench = Bench(monkeypatch, *losses, *[made(50.0, gap=1)] * (MAX_GAP_RETRIES + 1), *losses, made(1.0))
    assert bench.source.next() == "rollout"
    assert bench.made == 10 + MAX_GAP_RETRIES + 2
