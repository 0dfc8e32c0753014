"""A node with a mistake in a timer."""

import sys

from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.spin import run_node


class FailingNode(ManagedNode):
    """Divides by zero three seconds after it was activated."""

    def __init__(self) -> None:
        super().__init__("failing")

    def activate(self) -> None:
        self.create_timer(3.0, lambda: 1 // 0)


if __name__ == "__main__":
    sys.exit(run_node(FailingNode))
