"""What the live page costs a graph: CPU time of its nodes for the same lock-steps, with and without it."""

import os
import tempfile
import threading
import time
import urllib.request
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.experiment import Count, Experiment, console
from benchmarks.speed.graph import DOMAINS, TIMEOUT_S
from benchmarks.speed.inputs import prepare_model
from wm_nodes.config.load import load_config
from wm_nodes.core.processes import stat_fields, used_cpu_s
from wm_nodes.reports.console_table import make_table
from wm_nodes.reports.live_page import HOST, free_port

WAYS = NONE, _, OPEN = ("no page", "page, not open", "page in a browser")


@dataclass(kw_only=True)
class View(Experiment):
    """What the live page costs: CPU time of the nodes of a rollout without it, with it, and while a browser looks."""

    preset: str = "smoke"
    """Settings and model size; the smaller the model, the more the page weighs."""
    steps: Count = 600
    """Lock-steps of each run."""
    triples: Count = 3
    """Runs of each kind, which alternate."""

    def run(self) -> None:
        """Measure, show the ratios, write --json."""
        with tempfile.TemporaryDirectory(prefix="wm_benchmark_") as name:
            model, starts, description = prepare_model(load_config(self.preset), Path(name), None)
            given = {"preset": self.preset, "model_dir": str(model), "starts_file": str(starts)}
            triples = [
                {way: self.measure(way, {**given, "run_dir": f"{name}/{i} {way}"}) for way in WAYS}
                for i in range(self.triples)
            ]
        viewer = {way: [one[way].pop("viewer", 0.0) / sum(one[NONE].values()) for one in triples] for way in WAYS}
        nodes = {way: [sum(one[way].values()) / sum(one[NONE].values()) for one in triples] for way in WAYS}
        rows = [(way, *(" ".join(f"{v:.2f}" for v in part[way]) for part in (nodes, viewer))) for way in WAYS]
        columns = ("", "CPU time of the other nodes", "of the viewer")
        console.print(make_table(f"over that without page, {self.steps} steps", columns, rows, caption=description))
        self.write({"nodes_cpu_ratio": nodes, "viewer_cpu_ratio": viewer, "cpu_s": triples, "steps": self.steps})

    def measure(self, way: str, given: dict[str, str]) -> dict[str, float]:
        """CPU s of each node."""
        from wm_nodes.launching.arguments import prepare
        from wm_nodes.launching.domain_lock import first_free
        from wm_nodes.launching.graph_client import GraphClient
        from wm_nodes.launching.runner import Runner

        console.print(f"{self.steps} steps: {way}", highlight=False)
        given = given if way == NONE else {**given, "view": "page", "view_port": free_port("0")}
        with ExitStack() as stack:
            lock = first_free(DOMAINS, "the benchmark", group="graph")
            stack.callback(lock.release)
            graph, _ = prepare("rollout_record", {**given, "domain_id": str(lock.domain)})
            graph = replace(graph, nodes=tuple(replace(node, required=True) for node in graph.nodes))
            runner = stack.enter_context(Runner(graph, log=None, use_domain_lock=False))
            runner.wait_ready(TIMEOUT_S)
            os.environ.update(runner.environment)
            operator = stack.enter_context(GraphClient(alive=runner.check))
            if way == OPEN:
                threading.Thread(target=deque, args=(_events(given["view_port"]), 0), daemon=True).start()
            operator.rollout(20)
            before = {node.name: used_cpu_s(stat_fields(runner.process(node.name).pid)) for node in graph.nodes}
            operator.rollout(self.steps)
            return {name: used_cpu_s(stat_fields(runner.process(name).pid)) - spent for name, spent in before.items()}


def _events(port: str) -> Any:
    """What a browser reads, once there is a page: a node is seen before its page is."""
    until_s = time.monotonic() + TIMEOUT_S
    while True:
        try:
            return urllib.request.urlopen(f"http://{HOST}:{port}/events")
        except OSError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.1)
