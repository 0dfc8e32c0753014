"""Whether a model may train policies, and what policies are worth, imagined and real."""
