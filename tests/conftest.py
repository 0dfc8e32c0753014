"""Fixtures of all tests: an own ROS domain on the local host, nothing left over."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from judge_server import PickyServer, serving

from wm_nodes.launching.domain_lock import DomainLock, first_free
from wm_nodes.launching.environment import graph_environment

if TYPE_CHECKING:
    from pretended_device import Device

ROOT = Path(__file__).resolve().parents[1]
DOMAINS = range(60, 102)
"""tests/graph/harness.py uses 20 to 59 for its own graphs."""

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("OMP_NUM_THREADS", "1")

_session_lock: DomainLock | None = None


@pytest.fixture
def server() -> Iterator[PickyServer]:
    """A judge's server."""
    with serving(PickyServer()) as server:
        yield server


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", choices=("pretended", "cuda"), default="pretended", help="what `device` yields")


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator["Device"]:
    """A CUDA device: pretended, with counts, or the real one where pytest was given --device cuda."""
    from pretended_device import on_device  # torch takes a second, and graphs' tests have no use for it

    with on_device(request.config.getoption("--device")) as device:
        yield device


def pytest_configure() -> None:
    """Whatever a test starts without asking for a domain still meets nobody else's nodes."""
    global _session_lock
    _session_lock = first_free(DOMAINS, "a test run", group="test")
    os.environ["ROS_DOMAIN_ID"] = str(_session_lock.domain)
    environment = graph_environment()
    os.environ.update({name: environment[name] for name in ("AMENT_PREFIX_PATH", "PATH")})


def pytest_sessionstart(session: pytest.Session) -> None:
    """A process that follows one that hung inside DDS does not wait for what that one held."""
    if hasattr(session.config, "workerinput"):
        from left_over import remove_left_over

        remove_left_over(ports=False)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what uses a device. run_tests.py looks for tests marked alone in tests/graph only, to import none twice."""
    for item in items:
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker("device")
        if item.get_closest_marker("alone") and "graph" not in item.path.parts:
            raise pytest.UsageError(f"{item.nodeid} is marked alone; run_tests.py looks for such tests in tests/graph")


def pytest_collection_finish() -> None:
    """What the imported modules hold stays to the end, and no later collection of garbage goes through it: each, of
    which the simulator asks for one per scene, took half a second."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_handlecrashitem(crashitem: str, sched: Any) -> None:
    """For run_tests.py: pytest-xdist runs a test whose process ended again, and lastfailed forgets it if it passes."""
    cache = sched.config.cache
    cache.set("wm/crashed", [*cache.get("wm/crashed", []), crashitem])


def pytest_unconfigure() -> None:
    if _session_lock is not None:
        _session_lock.release()


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other test process uses, also set as ROS_DOMAIN_ID."""
    lock = first_free(DOMAINS, "a test", group="test")
    try:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(lock.domain))
        yield lock.domain
    finally:
        lock.release()


@pytest.fixture
def repository() -> Path:
    return ROOT


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Leave no shared memory behind; the last process looks for ports."""
    from left_over import remove_left_over

    remove_left_over(ports=not hasattr(session.config, "workerinput"))
