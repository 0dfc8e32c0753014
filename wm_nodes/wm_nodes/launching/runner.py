"""Starts a graph as processes, without ROS launch: prefixed logs, readiness, orderly end, first failure as exit code.

with Runner(graph, log_dir=run_dir / "logs") as runner:
    runner.wait_ready(timeout_s=60)
    code = runner.wait()
"""

import fcntl
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TextIO

from wm_nodes.core.errors import RunError
from wm_nodes.core.interrupts import remembering_interrupts
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.domain_lock import DomainInUseError, DomainLock
from wm_nodes.launching.environment import graph_environment, interpreter
from wm_nodes.launching.fork_server import ForkServer
from wm_nodes.launching.graph import RESPAWN_S, Graph, NodeSpec
from wm_nodes.launching.process import NodeProcess
from wm_nodes.launching.readiness import NotReadyError, activate, wait_ready
from wm_nodes.launching.scenarios import describe_arguments, parse_arguments, run_folder
from wm_nodes.ros.middleware import PROFILE, PROFILE_VARIABLE, SEGMENT_BYTES
from wm_nodes.training.run_lock import RunLock

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LAST_OUTPUT_S = 0.2
"""Until what a node wrote before its answer has come through its pipe."""
LEAST_LIFE_S = 10.0
NEW_S = 1.0
"""A process makes the file of a lock so much earlier than it locks it, at most."""
GRACE_S = 5.0
"""Time for an orderly end after SIGINT, and again after SIGTERM."""


class NodeDiedError(RunError):
    """A required node ended; the text names it, its exit code and its log."""


class Runner:
    """The processes of one graph. start() and stop() are called by the context manager.

    Args:
        log: where prefixed lines go; None: nowhere.
        log_dir: folder for one <node>.log each; None: no files.
        python: interpreter of the nodes.
        use_domain_lock: refuse a domain on which another Runner of this host works.
    """

    def __init__(
        self, graph: Graph, *, log: TextIO | None = sys.stdout, log_dir: Path | None = None,
        python: str = sys.executable, use_domain_lock: bool = True,
    ) -> None:
        self.graph = graph
        self.environment = graph_environment(graph.environment, python=python)
        """Variables that every process gets."""
        self.domain = _domain(self.environment)
        self._lock = DomainLock(self.domain, f"graph {graph.name!r}") if use_domain_lock else None
        self._log = log
        self._log_dir = log_dir
        self._colour = log is not None and log.isatty()
        self._python = python
        self._processes: dict[str, NodeProcess] = {}
        # Linux signals a child when the *thread* that made it ends; this one lives until stop().
        self._starter: ThreadPoolExecutor | None = None
        self._forks: ForkServer | None = None
        self._stopping = False

    def start(self) -> None:
        """Start every process.

        Raises:
            DomainInUseError: another graph works on the domain.
        """
        if self._lock is not None:
            self._lock.acquire()
        try:
            clean_shared_memory()
            self._fit_shared_memory()
            if self._log_dir is not None:
                self._log_dir.mkdir(parents=True, exist_ok=True)
            self._starter = ThreadPoolExecutor(max_workers=1, thread_name_prefix="runner")
            if sum(map(_can_fork, self.graph.nodes)) > 1:
                modules = preloaded(self.graph)
                self._forks = self._starter.submit(ForkServer, self._python, modules, self.environment).result()
            for index, node in enumerate(self.graph.nodes):
                self._processes[node.label] = NodeProcess(
                    node, self._python, self.environment, log=self._log, colour=index if self._colour else None,
                    width=max(len(other.label) for other in self.graph.nodes),
                    file=self._log_dir / f"{node.label.replace('/', '.')}.log" if self._log_dir else None,
                )
                self._start(node.label)
        except BaseException:
            self.stop()
            raise

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Return when every required lifecycle node is active and every other required node visible.

        Raises:
            NodeDiedError: a required node ended meanwhile.
            NotReadyError: after timeout_s; names the nodes, their states and their last output.
        """
        try:
            wait_ready(self.graph.nodes, domain=self.domain, timeout_s=timeout_s, check=self.check)
        except NotReadyError as error:
            raise self._add_last_output(error) from None

    def activate(self, timeout_s: float = 60.0) -> None:
        """Configure and activate the nodes of a graph that was started with autostart false.

        Raises:
            NodeDiedError: a required node ended meanwhile.
            NotReadyError: a node refused, or did not answer within timeout_s; with the nodes' last output.
        """
        try:
            activate(self.graph.nodes, domain=self.domain, timeout_s=timeout_s, check=self.check)
        except NotReadyError as error:
            raise self._add_last_output(error) from None

    def _add_last_output(self, error: NotReadyError) -> NotReadyError:
        time.sleep(LAST_OUTPUT_S)
        outputs = [
            process.last_output_line() for process in self._processes.values()
            if {node.full_name for node in process.spec.carried()} & {*error.nodes}
        ]
        return NotReadyError(f"{error}: {'; '.join(outputs)}", error.nodes)

    def check(self) -> None:
        """Raise NodeDiedError if a required node has ended without having been told to."""
        failure = self.failure()
        if failure is not None:
            raise NodeDiedError(failure[1])

    def failure(self) -> tuple[int, str] | None:
        """Exit code (1 to 255) and text of the required node that ended first, or None."""
        ended = [
            process for process in self._processes.values()
            if process.ended_at is not None and process.spec.required and not self._stopping
            and not _comes_back(process)
        ]
        if not ended:
            return None
        first = min(ended, key=lambda process: process.ended_at or 0.0)
        return first.exit_code, first.exit_summary()

    def wait(self, timeout_s: float | None = None, until: Callable[[], bool] = lambda: False) -> int:
        """Return 0 when until() is true, when nothing runs, or after timeout_s; else the exit code of the required node
        that ended first."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not until() and (deadline is None or time.monotonic() < deadline):
            failure = self.failure()
            if failure is not None:
                self._say(failure[1])
                return failure[0]
            self.respawn()
            if not any(process.running or _comes_back(process) for process in self._processes.values()):
                return 0
            time.sleep(0.1)
        return 0

    def respawn(self) -> None:
        """Start again what has ended by itself RESPAWN_S ago and is to come back; wait() does so."""
        for label, process in self._processes.items():
            rested = time.monotonic() - (process.ended_at or 0.0) > RESPAWN_S
            if rested and not self._stopping and _comes_back(process):
                self._say(f"{process.exit_summary()}; starting it again")
                self._start(label)

    def process(self, name: str) -> NodeProcess:
        """The process of a node, as Graph.node finds it."""
        return self._processes[self.graph.node(name).label]

    def stop(self) -> None:
        """End everything: SIGINT, 5 s, SIGTERM, 5 s, SIGKILL; then clean shared memory and free the domain."""
        self._stopping = True
        self._end(list(self._processes.values()))
        for process in self._processes.values():
            process.close()
        if self._forks is not None:
            self._forks.close()
            self._forks = None
        if self._starter is not None:
            self._starter.shutdown()
            self._starter = None
        if self._processes:
            clean_shared_memory()
        if self._lock is not None:
            self._lock.release()

    close = stop

    def __enter__(self) -> "Runner":
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _start(self, label: str) -> None:
        if self._starter is None:
            raise RuntimeError("the runner is stopped; make another one")
        process = self._processes[label]
        self._starter.submit(process.start, self._forks if _can_fork(process.spec) else None).result()

    def _end(self, processes: Sequence[NodeProcess]) -> None:
        for number in STOP_SIGNALS:
            running = [process for process in processes if process.running]
            for process in running:
                process.signal(number)
            if number == signal.SIGKILL and running:
                self._say(f"killed, because 10 s were not enough: {', '.join(p.spec.label for p in running)}")
            deadline = time.monotonic() + GRACE_S
            while any(process.running for process in running) and time.monotonic() < deadline:
                time.sleep(0.02)

    def _fit_shared_memory(self) -> None:
        """Leave the big segment out where /dev/shm (64 MiB in many containers) cannot hold one for each process."""
        if self.environment.get(PROFILE_VARIABLE) != str(PROFILE) or not Path("/dev/shm").is_dir():
            return
        free, needed = shutil.disk_usage("/dev/shm").free, SEGMENT_BYTES * len(self.graph.nodes)
        if free < needed:
            self.environment[PROFILE_VARIABLE] = ""
            self._say(
                f"/dev/shm has {free >> 20} MiB free, {needed >> 20} MiB wanted: going on with small segments; images "
                "above 300 kB may be lost (docker run --shm-size=1g cures it)"
            )

    def _say(self, text: str) -> None:
        if self._log is not None:
            with suppress(OSError):  # its reader has gone; the graph goes on
                print(f"[runner] {text}", file=self._log, flush=True)


def clean_shared_memory() -> None:
    """Remove what dead Fast DDS processes left in /dev/shm: their data segments, of 34 MiB each, under names of their
    own.

    Ports stay, and serve again: `fastdds shm clean` removes by name the one of a killed process, or the one that its
    successor has made there meanwhile, which then hears nobody.
    """
    for lock in Path("/dev/shm").glob(f"fastrtps_{'[0-9a-f]' * 16}_el"):
        with suppress(OSError), lock.open("rb") as file:
            if time.time() - lock.stat().st_mtime > NEW_S:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                lock.with_name(lock.name.removesuffix("_el")).unlink(missing_ok=True)
                lock.unlink()


def main(scenario: str, argv: Sequence[str] | None = None) -> int:
    """`python launch_scripts/<scenario>.launch.py name:=value ... [--show-args] [--compose]`. Return the exit code."""
    given: dict[str, str] = {}
    for text in sys.argv[1:] if argv is None else argv:
        name, separator, value = text.partition(":=")
        if text in {"--show-args", "-s", "--help", "-h"}:
            print(describe_arguments(scenario))
            return 0
        if text == "--compose":
            name, separator, value = "compose", ":=", "true"
        if not separator:
            print(f"error: expected name:=value, got {text!r}; --show-args lists the names", file=sys.stderr)
            return 2
        given[name] = value
    try:
        parse_arguments(scenario, given)
        run_dir = run_folder(scenario, given)
        with RunLock(run_dir, say=_print, new=not given.get("run_dir")) as lock:
            with remembering_interrupts() as check:
                graph, values = launch_arguments.begin(scenario, {**given, "run_dir": str(lock.folder)})
                check()
            return run(graph, lock.folder, interpreter(values))
    except (DomainInUseError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(graph: Graph, run_dir: Path, python: str = sys.executable, ready_s: float = 120.0) -> int:
    """Run a graph until Ctrl-C or SIGTERM (exit code 0; 130 before it is ready), or the end of a required node.

    Raises:
        DomainInUseError, NotReadyError: as the Runner.
        KeyboardInterrupt: while the processes were made.
    """
    received: list[int] = []
    starting = True

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        if starting and len(received) == 1:
            raise KeyboardInterrupt

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    reach = graph.environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if reach not in {"LOCALHOST", "OFF"}:
        print(f"WARNING: discovery range {reach}: whoever reaches this network can steer the graph", flush=True)
    try:
        with Runner(graph, log_dir=run_dir / "logs", python=python) as runner:
            starting = False
            print(f"[runner] {len(graph.nodes)} processes, domain {runner.domain}, run folder {run_dir}", flush=True)
            try:
                wait_ready(graph.nodes, domain=runner.domain, timeout_s=ready_s, check=lambda: _raise(runner, received))
            except NodeDiedError as error:
                print(f"[runner] {error}; stopping", flush=True)
                failure = runner.failure()
                return failure[0] if failure else 1
            except KeyboardInterrupt:
                print("[runner] interrupted; stopping", flush=True)
                return 128 + signal.SIGINT
            print("[runner] ready; Ctrl-C stops", flush=True)
            return runner.wait(until=lambda: bool(received))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _print(text: str) -> None:
    with suppress(OSError):  # as in Runner._say
        print(f"[runner] {text}", flush=True)


def _raise(runner: Runner, received: Sequence[int]) -> None:
    if received:
        raise KeyboardInterrupt
    runner.check()


def preloaded(graph: Graph) -> list[str]:
    """The modules that the fork server imports before it forks."""
    modules = {node.module for node in graph.nodes if _can_fork(node)}
    return sorted(module for module in modules if module.startswith("wm_nodes."))


def _can_fork(node: NodeSpec) -> bool:
    """Whether the node can fork: torchrun starts its own processes."""
    return node.ranks == 1


def _comes_back(process: NodeProcess) -> bool:
    """Whether an ended node is to be started again: one that ended in its first LEAST_LIFE_S would end so again."""
    ended_at = process.ended_at
    return process.spec.respawn and ended_at is not None and ended_at - process.started_at > LEAST_LIFE_S


def _domain(env: Mapping[str, str]) -> int:
    text = env.get("ROS_DOMAIN_ID") or "0"
    if not text.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number from 0 to 101, got {text!r}")
    return int(text)
