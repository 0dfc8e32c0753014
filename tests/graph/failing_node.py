"""A node with a mistake in a timer."""

import sys

from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.spin import run_node


class FailingNode(ManagedNode):
    """Divides by zero once another process listens to run/state: before that nobody could hear its last word."""

    def __init__(self) -> None:
        super().__init__("failing")

    def activate(self) -> None:
        matched = self._heartbeat._publisher.get_subscription_count
        self.create_timer(0.1, lambda: 1 // 0 if matched() > 1 else None)


if __name__ == "__main__":
    sys.exit(run_node(FailingNode))
