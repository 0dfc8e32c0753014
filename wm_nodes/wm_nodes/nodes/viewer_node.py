"""viewer: the live page of a graph, see reports/live_page.py. It listens, and nobody waits for it: it has no lifecycle,
announces no links, grants no credit, and hears what is not latched as best effort.

What comes with every step, and pictures, it subscribes to only while somebody looks.
"""

import gc
import math
import os
import sys
import time
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from wm_nodes.nodes.viewer.feed import PER_STEP, TABLE_S, TYPES, VIEW, Feed
from wm_nodes.nodes.viewer.run_folder import RunFolder
from wm_nodes.recording import topics
from wm_nodes.reports.live_page import LivePage
from wm_nodes.ros.middleware import set_node_defaults
from wm_nodes.ros.params import COMMON, Param, declare
from wm_nodes.ros.qos import topic
from wm_nodes.ros.spin import destroy, init, make_executor, spin, stop_on_signals

PARAMS = (Param("port", 0, "Of the page, on this host only; 0: a free one", read_only=True, minimum=0, maximum=65535),)
NICENESS = 10
"""Whoever trains on the same core goes first."""
DEPTH = 64
SIMULATOR = "sim/"
"""Below the graph's namespace: the environment that the policy is measured in."""
GRACE_S = 5.0
"""A page that is loaded again, or connects again, within this time has never been away."""


class ViewerNode(Node):  # type: ignore[misc]
    """Serves the page until the process ends."""

    def __init__(self) -> None:
        super().__init__("viewer", enable_rosout=False, start_parameter_services=False)
        declare(self, (*COMMON, *PARAMS))
        run_dir = str(self.get_parameter("run_dir").value)
        self.page = LivePage(int(self.get_parameter("port").value))
        self._feed = Feed(self.page, RunFolder(Path(run_dir)) if run_dir else None, namespace=self.get_namespace())
        of_simulator = [name for name in TYPES if name.startswith("env/")]
        of_simulator += [topics.EPISODE.name, topics.RUN_STATE.name]
        shown = [*TYPES, *(SIMULATOR + name for name in of_simulator)]
        shown = [name for name in shown if _base(name) != topics.IMAGES.name]  # all environments: too much for looking
        self._only_watched = [name for name in shown if _base(name) in PER_STEP]
        self._while_watched: list[Any] = []
        """Their subscriptions, while somebody looks."""
        self._watched_s = -math.inf
        for name in shown:
            if _base(name) not in PER_STEP:
                self._hear(name)
        self.create_timer(TABLE_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f"live page {self.page.url}")

    def _hear(self, name: str) -> Any:
        base, absolute = _base(name), self.resolve_topic_name(name)
        kind, profile = (Image, _passing()) if base == VIEW else (topic(base).type, _hearing(base))
        return self.create_subscription(kind, name, partial(self._feed.put, absolute), profile, raw=True)

    def _tick(self) -> None:
        """Show what is due to those who look; begin and end, on this thread, what only they cause."""
        now = time.monotonic()
        if self.page.browsers:
            self._watched_s = now
            self._feed.tick()
        watched = now - self._watched_s < GRACE_S
        if watched and not self._while_watched:
            self._while_watched = [self._hear(name) for name in self._only_watched]
        while self._while_watched and not watched:
            self.destroy_subscription(self._while_watched.pop())


def _base(name: str) -> str:
    """A topic's name without the simulator's namespace."""
    return name.removeprefix(SIMULATOR)


def _passing() -> QoSProfile:
    return QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)


def _hearing(name: str) -> QoSProfile:
    """Latched topics as they are published, so that what was said before is heard; of others what passes by."""
    offered = topic(name).reader_qos
    return copy(offered) if offered.durability == DurabilityPolicy.TRANSIENT_LOCAL else _passing()


def main() -> int:
    """Serve until SIGINT or SIGTERM; exit code 1 after one line where the page cannot be opened."""
    set_node_defaults()
    os.nice(NICENESS)
    try:
        init()
        with stop_on_signals() as stopped:
            node = ViewerNode()
            executor = make_executor(str(node.get_parameter("executor").value))
            executor.add_node(node)
            spin(executor, stopped)
            node.page.close()
            destroy(executor, [node])
            del node, executor
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 1
    finally:
        rclpy.try_shutdown()
        gc.collect()
    return 0


if __name__ == "__main__":
    sys.exit(main())
