"""Errors that end a command: their text says what happened and what to do."""


class RunError(RuntimeError):
    """A run cannot go on, for a reason outside of this program, e.g. a node that ended."""


class ModelNotAcceptedError(RunError):
    """A world model does not pass acceptance, so no policy may be trained in it."""
