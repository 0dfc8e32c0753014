"""Fixtures: a graph and a probe on an own domain; nothing is left over afterwards."""

import os
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

pytest.importorskip("rclpy", reason="the graph tests need rclpy")

from graph.harness import Graph, Probe, own_domain
from judge_server import PickyServer, serving
from left_over import remove_left_over

LOG_LINES = 25


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """WM_TEST_RERUNS=1 repeats a failed graph test once, for crowded machines; .ci/run leaves it unset, so none is."""
    reruns = int(os.environ.get("WM_TEST_RERUNS", "0"))
    for item in items:
        if reruns and "graph" in item.path.parts:
            item.add_marker(pytest.mark.flaky(reruns=reruns))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show what the nodes of a failed test said last."""
    report = yield
    if report.failed:
        for graph in Graph.started:
            for log in sorted(graph.folder.glob("*.log")):
                tail = log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_LINES:]
                report.sections.append((f"{graph.folder.name}/{log.name}", "\n".join(tail)))
    if call.when == "teardown":
        Graph.started[:] = [graph for graph in Graph.started if graph.running]
    return report


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as number:
        yield number


@pytest.fixture
def graph(domain: int, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Graph]:
    graph = Graph(domain, tmp_path / "run")
    yield graph
    codes = graph.stop()
    killed = request.node.get_closest_marker("kills") is not None
    if killed or any(codes.values()):
        remove_left_over(ports=not killed)
    if not killed:
        assert all(code == 0 for code in codes.values()), f"exit codes {codes}; logs in {graph.folder}"


@pytest.fixture
def probe(domain: int) -> Iterator[Probe]:
    probe = Probe(domain)
    yield probe
    probe.close()


@pytest.fixture(scope="module")
def server() -> Iterator[PickyServer]:
    """A judge's server of a module's tests; they leave it up and without delay."""
    with serving(PickyServer()) as server:
        yield server
