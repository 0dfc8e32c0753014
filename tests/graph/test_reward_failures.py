"""The reward evaluator where what it asks fails: every step gets an answer that says so, and the node lives on."""

import math
import time
from pathlib import Path
from typing import Any

import pytest
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.test_environment import Client
from judge_server import PickyServer

from wm_nodes.config.load import load_config
from wm_nodes.judge.audit.media import FOLDER

pytestmark = pytest.mark.graph


class Steps:
    """Steps the environment until there is what is asked for."""

    def __init__(self, probe: Probe) -> None:
        self._client = Client(probe)
        wait_until("the evaluator", lambda: probe.value("/wm/reward_evaluator", "state") == "active")
        self._last = self._client.reset().step_id

    def until(self, what: str, ready: Any) -> Any:
        def stepped() -> Any:
            self._last += 1
            self._client.step(self._client.command(self._last))
            time.sleep(0.1)
            return ready()

        return wait_until(what, stepped)


def invalid(rewards: list[Any], reason: str) -> list[Any]:
    return [reward for reward in rewards if reason in reward.invalid_reason and not all(reward.valid)]


def test_whatever_a_reward_of_ones_own_raises_or_returns_is_an_invalid_reward_and_a_summary_says_so(
    graph: Graph, probe: Probe
) -> None:
    rewards, summaries = probe.listen("reward"), probe.listen("reward/summary")
    graph.start_environment()
    graph.start("reward_evaluator", reward__factory="toy:make_failing_reward")
    steps = Steps(probe)
    steps.until("an error", lambda: invalid(rewards, "KeyError: 'no such part'"))
    steps.until("a wrong shape", lambda: invalid(rewards, "ValueError: total of the rewards is of shape (3,)"))
    summary = wait_until("a summary", lambda: summaries[:1])[0]
    assert summary.invalid > 0 and math.isnan(summary.mean_total)
    wait_until("the count", lambda: probe.value("/wm/reward_evaluator", "invalid_rewards"))
    assert graph.running


def test_an_episode_that_the_audit_log_cannot_take_has_no_reward_and_the_node_lives_on(
    server: PickyServer, tmp_path: Path
) -> None:
    judge = {"judge.endpoints": [server.url], "judge.model": "judge", "judge.tries": 1}
    with own_domain() as domain:
        graph, probe = Graph(domain, tmp_path / "run", load_config("smoke", judge)), Probe(domain)
        try:
            rewards = probe.listen("reward")
            graph.start_environment()
            node = graph.start("reward_evaluator", reward="agent", audit_dir="audit")
            steps = Steps(probe)
            (graph.folder / "audit" / FOLDER).write_text("no folder: no picture can be stored")
            steps.until("an invalid reward", lambda: invalid(rewards, "NotADirectoryError"))
            assert node.poll() is None
            assert "has no verdict: NotADirectoryError" in graph.log("/wm/reward_evaluator")
        finally:
            probe.close()
            assert set(graph.stop().values()) == {0}
