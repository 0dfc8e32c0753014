"""What every training shares: optimisation loop, checkpoint, weights file, ranks of a process group, metrics."""
