"""One way to spin: a loop of finite spin_once calls, until a signal, on whichever executor was chosen.

EventsExecutor.spin() of the pip wheel delivers nothing, and awaiting in it keeps a core busy; a finite spin_once works.
"""

import gc
import logging
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from wm_nodes.config.load import ConfigError, read_yaml
from wm_nodes.core.memory import keep_freed_memory, limit_memory
from wm_nodes.ros.guard import LOG_PERIOD_S
from wm_nodes.ros.middleware import set_node_defaults

SPIN_ONCE_S = 0.1
"""Longest wait inside one spin_once; a signal is seen after at most this long."""

NO_MEMORY = "dropped what asked for more memory than there is, or than memory_limit_gib allows"
_LOGGER = get_logger("spin")

ANSWER_S = 0.3
"""Time for the results of the goals that the end cuts short to leave."""

SETTLE_S = 2.0
"""Longest time that nodes which still take messages may hold up the end."""

SWITCH_INTERVAL_S = 0.0005
"""Python's thread switch interval: ten times shorter than the default, so that a busy worker delays callbacks less."""


class _Dropping:
    """Executors in Python that drop what there is no memory for. rclpy's own would never serve its sender again: an
    error while they take something leaves the service, client or subscription marked as being at work.
    """

    def _take_service(self, service: Any) -> Any:
        with _dropping():
            return super()._take_service(service)  # type: ignore[misc]

    def _take_client(self, client: Any) -> Any:
        with _dropping():
            return super()._take_client(client)  # type: ignore[misc]

    def _take_subscription(self, subscription: Any) -> Any:
        with _dropping():
            return super()._take_subscription(subscription)  # type: ignore[misc]


class _SingleThreaded(_Dropping, SingleThreadedExecutor):  # type: ignore[misc]
    """The single-threaded executor."""


class _MultiThreaded(_Dropping, MultiThreadedExecutor):  # type: ignore[misc]
    """The multi-threaded executor."""


@contextmanager
def _dropping() -> Iterator[None]:
    """Log a lack of memory, once a minute, and go on: what a request claims to hold is made before any callback."""
    try:
        yield
    except (MemoryError, SystemError) as error:
        if not isinstance(error, MemoryError) and not isinstance(error.__cause__, MemoryError):
            raise
        _LOGGER.error(NO_MEMORY, throttle_duration_sec=LOG_PERIOD_S)


def make_executor(kind: str) -> Executor:
    """Return an executor by its name in ros/params.py; falls back to `single`, with a warning, where rclpy has no
    events executor."""
    if kind == "multi":
        return _MultiThreaded(num_threads=2)
    if kind == "events":
        try:
            from rclpy.experimental import EventsExecutor

            return EventsExecutor()
        except ImportError:
            logging.getLogger(__name__).warning("this rclpy has no EventsExecutor; using the single-threaded executor")
    return _SingleThreaded()


def spin(executor: Executor, until: Callable[[], bool]) -> None:
    """Spin until `until()` is true or the context is shut down. A message for which there is no memory is dropped."""
    try:
        while rclpy.ok() and not until():
            with _dropping():
                executor.spin_once(timeout_sec=SPIN_ONCE_S)
    except ExternalShutdownException:
        return


class StopSignals:
    """Whether SIGINT or SIGTERM has come: a flag, so that nodes can still publish while they stop."""

    def __init__(self) -> None:
        self._interrupting = False
        self._received: list[int] = []

    def __call__(self) -> bool:
        return bool(self._received)

    def note(self, number: int, _frame: FrameType | None) -> None:
        self._received.append(number)
        if self._interrupting:
            self._interrupting = False
            raise KeyboardInterrupt

    def interrupt(self, work: Callable[[], bool]) -> bool:
        """Return work(), or False as soon as a signal comes."""
        if self():
            return False
        try:
            self._interrupting = True
            return work()
        except KeyboardInterrupt:
            return False
        finally:
            self._interrupting = False


@contextmanager
def stop_on_signals() -> Iterator[StopSignals]:
    """Yield what notes SIGINT and SIGTERM."""
    signals = StopSignals()

    previous = {number: signal.signal(number, signals.note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield signals
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def _mark_failed(nodes: list[Any]) -> Iterator[None]:
    """Log an exception that nobody expected, with its trace, and mark the nodes as failed, so that they still stop."""
    try:
        yield
    except Exception:
        for node in nodes:
            node.failed = True
        nodes[0].get_logger().fatal(f"unexpected error; stopping\n{traceback.format_exc()}")


def _limit_memory(nodes: list[Any]) -> None:
    """As the first node's parameter says, and before anybody asks: 48 bytes can claim to be a list of gigabytes."""
    device, file = "auto", Path(str(nodes[0].get_parameter("config_file").value))
    with suppress(ConfigError):  # which configure tells
        device = str(read_yaml(file).get("device", device)) if file.is_file() else device
    limit_memory(float(nodes[0].get_parameter("memory_limit_gib").value), len(nodes), device)


def _answer_goals(executor: Executor, nodes: list[Any]) -> None:
    """End the goals at work and send their results: a client cannot see that its server is gone."""
    ended = [node.end_goals() for node in nodes]
    if any(ended):
        until_s = time.monotonic() + ANSWER_S
        spin(executor, until=lambda: time.monotonic() > until_s)


def _settle(executor: Executor, nodes: list[Any]) -> None:
    began_s = time.monotonic()
    spin(
        executor,
        until=lambda: (
            time.monotonic() - began_s > SETTLE_S or all(node.failed or node.is_settled(began_s) for node in nodes)
        ),
    )


def destroy(executor: Executor, nodes: Iterable[Any]) -> None:
    """Destroy nodes and the executor that spun them; the caller then lets go of both."""
    for node in nodes:
        executor.remove_node(node)
        node.destroy_node()
    executor.shutdown()


@contextmanager
def spinning(node: Node) -> Iterator[None]:
    """Spin a node in a thread of its own; at the end destroy it, and shut rclpy down."""
    executor, ended = make_executor("events"), threading.Event()
    executor.add_node(node)
    thread = threading.Thread(target=spin, args=(executor, ended.is_set), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        destroy(executor, [node])
        rclpy.try_shutdown()


def run_nodes(make_nodes: Callable[[], Iterable[Any]], args: list[str] | None = None) -> int:
    """Create nodes, start them, spin until a signal, stop them, shut down. Return the exit code.

    Each node is a ros.lifecycle.ManagedNode. After the signal it answers the goals at work, and spins until all nodes
    are settled, for at most SETTLE_S. The first node's `executor` parameter chooses the executor.
    A start that fails gives exit code 1 after one line of error; an exception out of a callback gives it after its
    trace, and the nodes still stop in order.
    """
    keep_freed_memory()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    set_node_defaults()
    nodes: list[Any] = []
    code = 0
    try:
        init(args)
        with stop_on_signals() as stopped:
            nodes = list(make_nodes())
            _limit_memory(nodes)
            executor = make_executor(str(nodes[0].get_parameter("executor").value))
            for node in nodes:
                executor.add_node(node)
            with _mark_failed(nodes):
                if stopped.interrupt(lambda: all(node.start() for node in nodes)):
                    spin(executor, until=lambda: stopped() or any(node.failed for node in nodes))
                    _answer_goals(executor, nodes)
                    _settle(executor, nodes)
            for node in reversed(nodes):
                with _mark_failed([node]):
                    node.stop()
            code = int(any(node.failed for node in nodes))
            destroy(executor, nodes)
            del node, executor
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = 1
    finally:
        nodes.clear()
        rclpy.try_shutdown()
        # Lifecycle nodes are reference cycles; while they live, so does the DDS participant with its shared memory.
        gc.collect()
    return code


def init(args: list[str] | None = None) -> None:
    """Initialise rclpy, which leaves signals alone.

    Raises:
        ValueError: a parameter file that cannot be read, or other ROS arguments that are wrong, in one line.
    """
    words = sys.argv if args is None else args
    for option, file in pairwise(words):
        if option == "--params-file":
            read_yaml(Path(file))
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ValueError(f"ROS arguments refused: {str(error).splitlines()[0].partition(', at /')[0]}") from None


def run_node(make_node: Callable[[], Any]) -> int:
    """run_nodes for one node; `sys.exit(run_node(MyNode))` is a node's main."""
    return run_nodes(lambda: [make_node()])
