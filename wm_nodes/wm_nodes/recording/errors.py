"""What can be wrong with a bag."""


class BagError(ValueError):
    """A bag that cannot be used as asked; the text names the value and the remedy."""


class RecordingError(OSError):
    """Writing failed (disk full, folder gone); the text says what is safe and how to get at it."""
