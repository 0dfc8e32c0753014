"""Endpoint matching: every node publishes on run/links which of its topics are matched, so that a data flow starts only
when every subscriber gets its first message.

A publisher does not know a subscription that DDS has not discovered yet, and what it sends before is lost to that
subscription. Both ends of a pair must have discovered each other, which only the two nodes know; so each node publishes
its links at every change and once a second.
"""

import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from wm_msgs.msg import ErrorCode, NodeLinks
from wm_nodes.core.errors import WireError
from wm_nodes.ros.guard import check_sender, node_of
from wm_nodes.ros.publishing import StampedPublisher
from wm_nodes.ros.qos import topic
from wm_nodes.ros.worker import Work

Ends = Callable[[str], set[tuple[str, bytes]]]
"""Topic name to the ends of it that are known: node (fully qualified) and DDS identifier."""


@dataclass(frozen=True)
class _Peer:
    session: int
    """Of the node; another one after each configuration, which makes its topics anew."""
    active: bool
    """Whether it is active."""
    publishes: frozenset[str]
    """Its topics, absolute."""
    subscribes: frozenset[str]
    """The topics that it listens to, absolute."""
    linked: frozenset[tuple[str, int]]
    """The nodes, with their sessions, whose ends it has discovered."""


class EndpointTable:
    """What this node knows about the links of all nodes of its namespace. Thread-safe.

    Args:
        own_name: fully qualified name of this node.
    """

    def __init__(self, own_name: str) -> None:
        self._own_name = own_name
        self._lock = threading.Lock()
        self._ends = dict[str, tuple[int, set[bytes], set[bytes]]]()
        """Of the peers that were linked: session, by which ends, and those of the session before, which discovery may
        list although they are gone."""
        self._peers: dict[str, _Peer] = {}
        self._ever: set[str] = set()
        self._lost: set[str] = set()
        self._own = _Peer(0, False, frozenset(), frozenset(), frozenset())

    def note(self, message: NodeLinks) -> None:
        """Take in what another node says. Raises WireError where its lists differ in length."""
        if message.node == self._own_name:
            return
        if len(message.linked) != len(message.linked_sessions):
            raise WireError(
                ErrorCode.BAD_SHAPE, f"linked has {len(message.linked)} nodes, linked_sessions "
                f"{len(message.linked_sessions)}; run the same version of wm_msgs on both sides",
            )
        linked = frozenset(zip(message.linked, message.linked_sessions, strict=True))
        with self._lock:
            self._ever.add(message.node)
            self._lost.discard(message.node)
            self._peers[message.node] = _Peer(
                message.session, message.active, frozenset(message.publishes), frozenset(message.subscribes), linked
            )

    def knows(self, name: str) -> bool:
        return name in self._peers

    def forget(self, name: str, *, lost: bool = False) -> None:
        """A node stopped, and is not waited for until it speaks again; or it is lost, and may come back."""
        with self._lock:
            self._peers.pop(name, None)
            if lost:
                self._lost.add(name)

    def refresh(
        self, session: int, publishes: Collection[str], subscribes: Collection[str], active: bool, readers: Ends,
        writers: Ends,
    ) -> bool:
        """Look at the graph again; return whether this node's announcement has changed.

        Args:
            session: of this node.
            publishes, subscribes: this node's topics, absolute.
            readers, writers: the subscriptions to, or publishers of, a topic that this node has discovered.
        """
        outgoing, incoming = frozenset(publishes), frozenset(subscribes)
        with self._lock:
            peers = dict(self._peers)
        same = (outgoing, incoming) == (self._own.publishes, self._own.subscribes)
        linked = set()
        for name, peer in peers.items():
            key = (name, peer.session)
            if not peer.active:
                continue
            if same and key in self._own.linked:
                linked.add(key)
                continue
            session_before, ends_before, gone = self._ends.get(name, (peer.session, set[bytes](), set[bytes]()))
            if session_before != peer.session:
                gone = ends_before or gone
            known = [{end for node, end in ends(topic) if node == name} - gone for ends, shared in (
                (readers, outgoing & peer.subscribes), (writers, incoming & peer.publishes)) for topic in shared]
            if all(known):
                linked.add(key)
                self._ends[name] = peer.session, set[bytes]().union(*known), gone
        mine = _Peer(session, active, outgoing, incoming, frozenset(linked))
        changed = mine != self._own
        with self._lock:
            self._own = mine
        return changed

    def announcement(self) -> NodeLinks:
        """What this node knows of itself since the last refresh()."""
        mine, names = self._own, sorted(self._own.linked)
        return NodeLinks(
            session=mine.session, node=self._own_name, active=mine.active, publishes=sorted(mine.publishes),
            subscribes=sorted(mine.subscribes), linked=[name for name, _ in names],
            linked_sessions=[session for _, session in names],
        )

    def missing(self, awaited: Iterable[str] = ()) -> list[str]:
        """Return what still lacks until all active nodes know each other; empty: data may flow.

        Args:
            awaited: fully qualified names of nodes that must be there; one that was there and stopped need not.
        """
        with self._lock:
            nodes = {self._own_name: self._own, **self._peers}
            ever, lost = set(self._ever), set(self._lost)
        lacking = [f"{name} has not been heard" for name in awaited if name not in nodes and name not in ever]
        lacking += [f"{name} is lost" for name in awaited if name in lost]
        lacking += [f"{name} is not active" for name in awaited if name in nodes and not nodes[name].active]
        group = {name: node for name, node in nodes.items() if node.active}
        for name, node in group.items():
            for other, peer in group.items():
                if other != name and (other, peer.session) not in node.linked:
                    lacking.append(f"{name} has not matched {other}")
        return lacking


class Links:
    """The part of a node that keeps its EndpointTable and talks on run/links.

    Args:
        session: of the node, as it is now.
        is_active: whether the node is active.
    """

    def __init__(self, node: Node, session: Callable[[], int], is_active: Callable[[], bool]) -> None:
        self._node, self._session, self._is_active = node, session, is_active
        self.table = EndpointTable(node.get_fully_qualified_name())
        self._publisher = StampedPublisher(node, "run/links", session())
        row = topic("run/links")
        self._subscription = node.create_subscription(row.type, row.name, self._on_links, row.reader_qos)

    def announce(self, *, again: bool = False) -> None:
        """Tell the others when this node has come to see more, or less, of them; again: in any case."""
        node = self._node
        changed = self.table.refresh(
            self._session(), {publisher.topic_name for publisher in node.publishers},
            {subscription.topic_name for subscription in node.subscriptions}, self._is_active(),
            lambda name: _ends_of(node.get_subscriptions_info_by_topic(name)),
            lambda name: _ends_of(node.get_publishers_info_by_topic(name)),
        )
        if changed or again:
            message = self.table.announcement()
            message.header.stamp = node.get_clock().now().to_msg()
            self._publisher.enter(message.session)
            self._publisher.publish(message)

    def _on_links(self, message: NodeLinks) -> None:
        if message.node != self._node.get_fully_qualified_name() and not self.table.knows(message.node):
            check_sender(self._node, "run/links", message.node)
        self.table.note(message)
        self.announce()


def _ends_of(ends: Iterable[Any]) -> set[tuple[str, bytes]]:
    return {(node_of(end), bytes(end.endpoint_gid)) for end in ends}


class StartBarrier:
    """Holds a data flow back until no node of the graph can miss its first messages; once for each lack.

    Args:
        node: a ManagedNode with the parameters await_nodes and match_timeout_s.
        table: what this node knows about the links of all nodes.
    """

    def __init__(self, node: Any, table: EndpointTable) -> None:
        self._node, self._table = node, table
        self._given_up: set[str] = set()

    def wait(self, work: Work) -> None:
        """Return when all active nodes know each other, or, with a warning, after match_timeout_s."""
        node, table = self._node, self._table
        namespace = node.get_namespace().rstrip("/")
        awaited = [f"{namespace}/{name}" for name in node.param("await_nodes") if name]
        deadline = time.monotonic() + float(node.param("match_timeout_s"))
        self._given_up &= set(table.missing(awaited))
        while lacking := set(table.missing(awaited)) - self._given_up:
            if time.monotonic() >= deadline:
                text = f"data flow although {'; '.join(sorted(lacking))}: first messages may be missed"
                node.get_logger().warning(text)
                node.diagnostics.count("unmatched_nodes", len(lacking), text=text)
                self._given_up |= lacking
                return
            work.sleep(0.02)
