"""A real node for the runner's tests: parameters say how it misbehaves."""

import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException


def main() -> int:
    rclpy.init()
    node = rclpy.create_node("tiny")
    die_after_s = node.declare_parameter("die_after_s", 0.0).value
    text = node.declare_parameter("text", "").value
    stubborn = node.declare_parameter("stubborn", False).value
    print(f"tiny says {text!r} on domain {node.context.get_domain_id()}", flush=True)
    end = time.monotonic() + die_after_s if die_after_s else float("inf")
    while True:
        try:
            while rclpy.ok() and time.monotonic() < end:
                rclpy.spin_once(node, timeout_sec=0.1)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        if not stubborn:
            break
        time.sleep(0.05)
    if time.monotonic() >= end:
        print("tiny gives up", flush=True)
        return 7
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
