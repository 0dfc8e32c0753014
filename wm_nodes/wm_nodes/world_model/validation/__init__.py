"""How good a world model is on held-out episodes, and whether a policy may be trained in it."""
