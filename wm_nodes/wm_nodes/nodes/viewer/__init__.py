"""What the live page shows of a graph, a recording or a run folder; no ROS."""
