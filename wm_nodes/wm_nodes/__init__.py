"""Online world-model RL as a ROS 2 graph."""

__version__ = "0.2.0"
