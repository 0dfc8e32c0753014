"""Parts of the reward evaluator node."""
