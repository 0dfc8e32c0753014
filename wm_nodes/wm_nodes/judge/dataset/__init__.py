"""Clips with labels known from the simulator, to train and to compare judges on."""
