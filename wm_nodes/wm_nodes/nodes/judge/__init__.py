"""Services and messages of the reward agent."""
