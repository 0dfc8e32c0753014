"""How a graph is started, watched and stopped: scenarios, processes, readiness, launch descriptions."""
