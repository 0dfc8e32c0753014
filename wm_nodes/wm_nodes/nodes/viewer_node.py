"""viewer: the live page of a graph, see reports/live_page.py. It listens, and nobody waits for it: it has no lifecycle,
announces no links, grants no credit, and hears what is not latched as best effort."""

import gc
import os
import sys
from copy import copy
from functools import partial
from pathlib import Path

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from wm_nodes.nodes.viewer.feed import TABLE_S, TYPES, VIEW, Feed
from wm_nodes.nodes.viewer.run_folder import RunFolder
from wm_nodes.recording import topics
from wm_nodes.reports.live_page import LivePage
from wm_nodes.ros.middleware import set_node_defaults
from wm_nodes.ros.params import COMMON, Param, declare
from wm_nodes.ros.qos import topic
from wm_nodes.ros.spin import destroy, executor_kind, init, make_executor, spin, stop_on_signals

PARAMS = (Param("port", 0, "Of the page, on this host only; 0: a free one", read_only=True, minimum=0, maximum=65535),)
NICENESS = 10
"""Whoever trains on the same core goes first."""
DEPTH = 64
SIMULATOR = "sim/"
"""Below the graph's namespace: the environment that the policy is measured in."""


class ViewerNode(Node):  # type: ignore[misc]
    """Serves the page until the process ends."""

    def __init__(self) -> None:
        super().__init__("viewer", enable_rosout=False, start_parameter_services=False)
        declare(self, (*COMMON, *PARAMS))
        run_dir = str(self.get_parameter("run_dir").value)
        self.page = LivePage(int(self.get_parameter("port").value))
        feed = Feed(self.page, RunFolder(Path(run_dir)) if run_dir else None, namespace=self.get_namespace())
        of_simulator = [name for name in TYPES if name.startswith("env/")]
        of_simulator += [topics.EPISODE.name, topics.RUN_STATE.name]
        for name in (*TYPES, *(SIMULATOR + name for name in of_simulator)):
            base = name.removeprefix(SIMULATOR)
            if base != topics.IMAGES.name:  # all environments in one picture: too much for looking on
                kind, profile = (Image, _passing()) if base == VIEW else (topic(base).type, _hearing(base))
                absolute = self.resolve_topic_name(name)
                self.create_subscription(kind, name, partial(feed.put, absolute), profile, raw=True)
        self.create_timer(TABLE_S, feed.tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f"live page {self.page.url}")


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
            executor = make_executor(executor_kind(node))
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
