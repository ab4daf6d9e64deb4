"""The error of every source."""


class LogError(ValueError):
    """A file or line cannot be read at all; the text names the place and the remedy."""
