"""The live page of a running graph: what it shows, and that nobody waits for it, whatever becomes of it."""

import http.client
import json
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from deadlines import PATIENCE_S
from graph.harness import Graph, Probe, own_domain, wait_until
from graph.test_runner import graph as runner_graph
from graph.test_runner import tiny
from graph.test_training import train, weights_in

from wm_msgs.action import Train
from wm_msgs.msg import LearnerMetrics
from wm_nodes.config.load import load_config
from wm_nodes.launching.graph import NodeSpec
from wm_nodes.launching.runner import Runner
from wm_nodes.nodes.viewer.feed import PER_STEP, TABLE_S, TYPES, VIEW
from wm_nodes.reports.live_page import LivePage

pytestmark = [pytest.mark.graph, pytest.mark.kills, pytest.mark.slow]
UPDATES = 4
MOST_TRAININGS = 20
"""A picture that comes before the viewer and the environment have found each other is lost."""
NODES = {f"/wm/{name}" for name in ("environment", "policy", "reward_evaluator", "learner")}


def read_panels(url: str, until: Any) -> dict[str, Any]:
    """The newest content of each panel, once until(panels) is true. Fails where the page ends before."""
    host = url.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(host, timeout=PATIENCE_S)
    connection.request("GET", "/events")
    events, panels = connection.getresponse(), dict[str, Any]()
    deadline = time.monotonic() + PATIENCE_S
    while not until(panels):
        assert time.monotonic() < deadline, f"not whole within {PATIENCE_S:g} s: {panels}"
        line = events.readline()
        assert line, f"the page ended with {sorted(panels)}"
        if line.startswith(b"data: "):
            event = json.loads(line.removeprefix(b"data: "))
            panels[event["panel"]] = event["content"]
    connection.close()
    return panels


def is_whole(panels: dict[str, Any]) -> bool:
    """Whether a picture with its environment's name, every node and a loss of each update so far have come."""
    return (
        panels.keys() >= {"pictures /wm", "charts", "nodes", "run"}
        and "environment" in panels["pictures /wm"]
        and any(chart["title"].startswith("value loss") and len(line["points"]) >= UPDATES
                for chart in panels["charts"]["charts"] for line in chart["lines"])
        and {row["node"] for row in panels["nodes"]["rows"] if "level" in row} >= NODES  # their diagnostics
    )


def start_viewed(graph: Graph) -> str:
    """Start the nodes of a training and the viewer; the page's URL."""
    graph.start("viewer")
    graph.start_environment(view_env=0)
    graph.start_policy(await_nodes=["environment", "reward_evaluator", "learner"])
    graph.start_reward()
    graph.start_learner()
    return page_of(graph)


def page_of(graph: Graph) -> str:
    log = graph.log_path("/wm/viewer")
    text = wait_until("the URL", lambda: "live page http" in log.read_text() and log.read_text())
    return str(text.partition("live page ")[2].split()[0])


def subscriptions_of_the_viewer(probe: Probe) -> set[str]:
    return {
        name for name in (*TYPES, *(f"sim/{name}" for name in TYPES if not name.startswith("/")))
        for end in probe.node.get_subscriptions_info_by_topic(probe.node.resolve_topic_name(name))
        if end.node_name == "viewer"
    }


def takes_steps(probe: Probe) -> bool:
    return "env/transition" in subscriptions_of_the_viewer(probe)


def test_a_training_is_shown_and_ends_with_the_same_weights_where_the_viewer_is_killed_or_never_was(
    tmp_path: Path,
) -> None:
    weights, trainings = [], 0
    for viewed in (True, False):
        with own_domain() as domain, ThreadPoolExecutor(1) as browser:
            graph, probe = Graph(domain, tmp_path / f"viewed_{viewed}", load_config("smoke")), Probe(domain)
            try:
                if viewed:
                    looking = browser.submit(read_panels, start_viewed(graph), is_whole)
                    wait_until("the viewer's steps", partial(takes_steps, probe))
                    while not trainings or (not looking.done() and trainings < MOST_TRAININGS):
                        assert train(probe, updates=UPDATES).termination_reason == Train.Result.FINISHED
                        trainings += 1
                    panels = looking.result()
                    assert panels["pictures /wm"]["environment"] == "toy/reach" and panels["pictures /wm"]["picture"]
                    assert all(row["level"] == 0 for row in panels["nodes"]["rows"] if row["node"] in NODES)
                    assert "/wm/viewer" not in {row["node"] for row in panels["nodes"]["rows"]}
                    graph.processes["/wm/viewer"].send_signal(signal.SIGKILL)
                else:
                    graph.start_training_nodes()
                    for _ in range(trainings):
                        assert train(probe, updates=UPDATES).termination_reason == Train.Result.FINISHED
                result = train(probe, updates=2)
                assert result.termination_reason == Train.Result.FINISHED, result.message
                assert result.updates == trainings * UPDATES + 2
                losses = [text for texts in probe.seen_errors.values() for text in texts]
                assert losses == [], "nobody misses the viewer"
                weights.append(weights_in(graph.folder))
            finally:
                graph.stop()
                probe.close()
    assert weights[0] == weights[1] and f"policy_{trainings * UPDATES + 3:06d}.safetensors" in weights[0]


def test_the_viewer_takes_steps_and_pictures_only_while_somebody_looks_and_curves_always(
    domain: int, tmp_path: Path
) -> None:
    costly = {name for name in (*PER_STEP, "sim/env/transition", f"sim/{VIEW}") if name != "env/image"}
    always = {*TYPES, "sim/env/spec", "sim/episode", "sim/run/state"} - {*PER_STEP}
    graph, probe = Graph(domain, tmp_path), Probe(domain)
    try:
        graph.start("viewer", run_dir="''")
        url = page_of(graph)
        metrics = probe.publisher("learner/metrics")
        wait_until("the viewer's ears", lambda: subscriptions_of_the_viewer(probe) >= always)
        wait_until("their match", metrics.get_subscription_count)
        for update in (1, 2, 3) * 5:  # what comes before the viewer has matched, too, is lost
            metrics.publish(LearnerMetrics(update=update, success_rate=0.25 * update))
            time.sleep(TABLE_S / 4)
        assert subscriptions_of_the_viewer(probe) == always, "nobody looks"
        for _ in range(2):

            def until(panels: dict[str, Any]) -> bool:
                return "charts" in panels and subscriptions_of_the_viewer(probe) == always | costly

            charts = read_panels(url, until)["charts"]["charts"]
            assert {point[0] for point in charts[0]["lines"][0]["points"]} == {1, 2, 3}, "from before"
            wait_until("the end of looking", lambda: subscriptions_of_the_viewer(probe) == always)
        assert graph.processes["/wm/viewer"].poll() is None
    finally:
        probe.close()
        codes = graph.stop()
    assert codes == {"/wm/viewer": 0}


def test_a_viewer_that_cannot_open_its_page_does_not_end_the_graph(ros_domain: int, tmp_path: Path) -> None:
    with LivePage() as other:
        viewers = [
            NodeSpec("wm_nodes.nodes.viewer_node", name, "/wm", {"port": port}, lifecycle=False, required=False)
            for name, port in (("viewer", 0), ("refused", other.port))
        ]
        with Runner(runner_graph(tiny("a"), *viewers), log=None, log_dir=tmp_path) as runner:
            runner.wait_ready(60)
            assert runner.process("refused").wait(60) == 1
            text = (tmp_path / "wm.refused.log").read_text()
            assert f"error: port {other.port} of this host cannot be used" in text and "Traceback" not in text
            log = tmp_path / "wm.viewer.log"
            wait_until("the page", lambda: log.is_file() and "live page http" in log.read_text())
            assert runner.wait(0.5) == 0 and runner.failure() is None
        assert runner.process("viewer").wait(10) == 0, "SIGINT ends it in order"


def test_the_benchmark_counts_the_cpu_time_of_the_nodes_with_and_without_the_page(tmp_path: Path) -> None:
    program = "import sys; from wm_nodes.apps.cli import main; sys.exit(main(sys.argv[1:]))"
    file = tmp_path / "view.json"
    words = ["benchmark", "view", "--steps", "20", "--triples", "1", "--json", str(file)]
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0 and "page in a browser" in done.stdout, done.stdout + done.stderr
    results = json.loads(file.read_text())
    assert results["nodes_cpu_ratio"]["no page"] == [1.0] and results["viewer_cpu_ratio"]["no page"] == [0.0]
    assert results["viewer_cpu_ratio"]["page in a browser"][0] > 0
    nodes = {"environment", "reward_evaluator", "policy", "recorder"}
    assert [set(spent) for spent in results["cpu_s"][0].values()] == [nodes] * 3
