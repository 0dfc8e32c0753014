"""Speed of the graph, the world model and the simulator, side by side in one run."""
