"""Progress of training and tracing as lines of text."""

from collections.abc import Callable

Report = Callable[[str], None]  # called with one line


def silent(text: str) -> None:
    """Report nothing."""
