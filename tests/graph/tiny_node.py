"""A real node for the runner's tests: parameters say how it misbehaves."""

import sys
import time

import rclpy
from rclpy.signals import SignalHandlerOptions

from wm_nodes.ros.spin import stop_on_signals


def main() -> int:
    with stop_on_signals() as stopped:  # before the node can be found, so that no signal to it comes too early
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("tiny")
        die_after_s = node.declare_parameter("die_after_s", 0.0).value
        text = node.declare_parameter("text", "").value
        stubborn = node.declare_parameter("stubborn", False).value
        end = time.monotonic() + die_after_s if die_after_s else float("inf")
        print(f"tiny says {text!r} on domain {node.context.get_domain_id()}", flush=True)
        while time.monotonic() < end and (stubborn or not stopped()):
            rclpy.spin_once(node, timeout_sec=0.1)
    rclpy.try_shutdown()
    if time.monotonic() >= end:
        print("tiny gives up", flush=True)
        return 7
    return 0


if __name__ == "__main__":
    sys.exit(main())
