"""Liveliness of the nodes of a graph: each publishes a heartbeat on run/state twice a second; a silent one is lost.

Silence is judged by what the peer could have sent. A process of this host that is stopped or gone is lost after the
timeout; one that computes, or waits for a core, only after BUSY_FACTOR times as long.
"""

import math
import os
import re
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from wm_msgs.msg import ErrorCode, RunState
from wm_nodes.core.errors import WireError
from wm_nodes.core.processes import Activity, ActivityWatch
from wm_nodes.ros import diagnostics
from wm_nodes.ros.guard import check_sender
from wm_nodes.ros.publishing import wait_until_heard
from wm_nodes.ros.qos import topic

HEARTBEAT_S = 0.5
ASLEEP_S = 3 * HEARTBEAT_S
"""Checks come once per heartbeat. Where one comes later than this, its own process stood still and heard nobody: on a
crowded machine, or in the middleware, where `kill -9` of a node can hold all its peers up for 2 to 3 s (after 4 of
264 kills)."""
AWAKE_S = 2 * HEARTBEAT_S
"""After it stood still a process takes what has come meanwhile; a peer of which nothing has come by then is lost."""
BUSY_FACTOR = 5
"""How many times the timeout a process may be silent that is seen to compute."""


class PeerWatch:
    """Keeps the last time each other node was heard. Times are monotonic, in s; pass `now` in tests.

    Args:
        activity: tells what a silent peer's process does, by its identity; None where nobody can know.
    """

    def __init__(
        self, own_name: str, timeout_s: float, activity: Callable[[str], Activity | None] = lambda identity: None
    ) -> None:
        self._own_name, self.timeout_s, self._activity = own_name, timeout_s, activity
        self._heard: dict[str, float] = {}
        self._lost: set[str] = set()
        self._identities: dict[str, str] = {}
        self._checked: float | None = None

    def heard(self, name: str, now: float | None = None, identity: str = "") -> None:
        """Note a sign of life of a process."""
        if name == self._own_name:
            return
        self._identities[name] = identity
        self._lost.discard(name)
        self._heard[name] = time.monotonic() if now is None else now

    def left(self, name: str) -> None:
        """A peer said that it stops: its silence is no loss."""
        self._heard.pop(name, None)
        self._identities.pop(name, None)
        self._lost.discard(name)

    def check(self, now: float | None = None) -> list[str]:
        """Return the peers that became lost since the last check. Of the time in which this process stood still, no
        more counts than leaves a peer AWAKE_S to be heard."""
        now = time.monotonic() if now is None else now
        apart = 0.0 if self._checked is None else now - self._checked
        if apart > ASLEEP_S:
            slept_s, enough = apart - HEARTBEAT_S, now - max(0.0, self.timeout_s - AWAKE_S)
            self._heard = {name: max(last, min(last + slept_s, enough)) for name, last in self._heard.items()}
        self._checked = now
        silent = {name: now - last for name, last in sorted(self._heard.items()) if name not in self._lost}
        fresh = [name for name, silent_s in silent.items() if self._is_over(name, silent_s)]
        self._lost.update(fresh)
        return fresh

    def _is_over(self, name: str, silent_s: float) -> bool:
        if silent_s <= self.timeout_s:
            return False
        busy = self._activity(self.identity(name)) is Activity.BUSY
        return not busy or silent_s > BUSY_FACTOR * self.timeout_s

    def is_lost(self, name: str) -> bool:
        return name in self._lost

    def silence_s(self, name: str, now: float | None = None) -> float:
        """How long a peer has not been heard; 0 while it was not heard at all."""
        now = time.monotonic() if now is None else now
        return now - self._heard.get(name, now)

    def knows(self, name: str) -> bool:
        return name in self._heard

    def identity(self, name: str) -> str:
        """The process that a peer is; empty while none is known. Another one than before: it was restarted."""
        return self._identities.get(name, "")

    @property
    def lost(self) -> list[str]:
        return sorted(self._lost)


class Heartbeat:
    """The part of a node that says that it lives, and that watches the others.

    Args:
        node: a ManagedNode.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._identity = f"process {os.getpid()} on {socket.gethostname()} since {time.time():.6f}"
        self._activity = activities_here()
        self.peers = PeerWatch(self._name, float(node.param("peer_timeout_s")), self._activity)
        row = topic("run/state")
        self._publisher = node.create_publisher(RunState, row.name, row.qos)
        self.watch("")

    def watch(self, prefix: str) -> Any:
        """Hear the nodes of a relative namespace, e.g. "sim/"; return the subscription."""
        row = topic("run/state")
        name = prefix + row.name
        return self._node.create_subscription(RunState, name, lambda message: self._note(message, name), row.reader_qos)

    def beat(self) -> list[str]:
        """Publish the heartbeat; return the peers that have become lost, and report them."""
        node, peers = self._node, self.peers
        peers.timeout_s = float(node.param("peer_timeout_s"))
        self.publish(RunState.RUNNING if node.active else RunState.IDLE, self._identity)
        lost = peers.check()
        for name in lost:
            text = f"{name} is lost: silent for {peers.silence_s(name):.1f} s{self._reason(name)}; restart it"
            node.get_logger().error(text)
            node.diagnostics.set_condition(f"peer {name}", diagnostics.ERROR, text)
        return lost

    def end(self, state: int) -> None:
        """Say that this node stops, and wait until those who listen know it: a publisher that is gone delivers nothing.

        Args:
            state: RunState.FINISHED or FAILED.
        """
        self.publish(state, "stopped")
        wait_until_heard(self._publisher)

    def publish(self, state: int, detail: str) -> None:
        """state: a constant of RunState."""
        node = self._node
        message = RunState(state=state, node=self._name, detail=detail)
        message.run_id = Path(str(node.param("run_dir"))).name
        message.header.stamp = node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _note(self, message: RunState, topic_name: str) -> None:
        name, peers, node = message.node, self.peers, self._node
        if name == self._name:
            self._check_name(message)
        elif message.state in (RunState.FINISHED, RunState.FAILED):
            peers.left(name)
            node.links.table.forget(name)
            node.diagnostics.clear_condition(f"peer {name}")
        else:
            if not peers.knows(name):
                check_sender(node, topic_name, name)
            if peers.is_lost(name):
                node.diagnostics.clear_condition(f"peer {name}")
                node.get_logger().info(f"{name} is back after {peers.silence_s(name):.1f} s")
            peers.heard(name, identity=message.detail)

    def _check_name(self, message: RunState) -> None:
        """End this node where another one of its name was there before: both would answer the same services.

        Only a living process sends a heartbeat, so what a killed one left in the ROS graph does not count; and only a
        node of that name in the ROS graph counts, so one message of another node does not end this one.
        """
        node = self._node
        if message.state not in (RunState.IDLE, RunState.RUNNING) or message.detail == self._identity or node.failed:
            return
        if start_time(message.detail) >= start_time(self._identity):
            return
        names = [f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()]
        if names.count(self._name) < 2:
            raise WireError(ErrorCode.OUT_OF_ORDER, f"a heartbeat of another {self._name}, which is not in the graph")
        node.failed = True
        node.get_logger().error(
            f"another {message.node} is there already ({message.detail}): stop it, or give this one another "
            "namespace (-r __ns:=...) or ROS_DOMAIN_ID"
        )

    def _reason(self, name: str) -> str:
        identity = self.peers.identity(name)
        activity = self._activity(identity)
        return f"; {identity.partition(' on ')[0]} {activity.value}" if activity is not None else ""


def activities_here() -> Callable[[str], Activity | None]:
    """A function that tells what the process of an identity does, where it is one of this host."""
    activities = ActivityWatch()

    def look(identity: str) -> Activity | None:
        match = re.fullmatch(r"process (\d{1,9}) on (\S+) since \S+", identity)
        return activities.look(int(match[1])) if match and match[2] == socket.gethostname() else None

    return look


def start_time(identity: str) -> float:
    """When a process of this name began, in s since 1970; never, where another program wrote the heartbeat."""
    _, separator, text = identity.rpartition(" since ")
    try:
        return float(text) if separator else math.inf
    except ValueError:
        return math.inf
