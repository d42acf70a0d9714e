"""Scores of an evaluation: limits of the normal error, figures by name, and their table. Imports no torch."""

from collections.abc import Sequence

LIMITS_DEG = (11.25, 22.5, 30.0)  # of the shares of pixels with a smaller normal error

Score = dict[str, float]


def grid(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Markdown table from a header row and body rows."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body))
