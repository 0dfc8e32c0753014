"""Parts of the learner node: assembly of rollouts from the graph or from a bag, and its report."""
