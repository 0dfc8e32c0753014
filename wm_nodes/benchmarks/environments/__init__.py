"""What models are worth as the environment of a policy."""
