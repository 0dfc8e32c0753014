"""Online world-model RL as a ROS 2 graph."""

__version__ = "0.1.0"
