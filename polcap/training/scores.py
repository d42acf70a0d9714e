"""Scores: error figures by name, their means and their table; limits of the normal error. Imports no torch."""

from collections.abc import Sequence

import numpy as np

LIMITS_DEG = (11.25, 22.5, 30.0)  # as is usual; figures are the shares of pixels with a smaller normal error

Score = dict[str, float]


def mean_score(scores: Sequence[Score]) -> Score:
    """Mean of each figure over the scores that have it."""
    names = dict.fromkeys(name for score in scores for name in score)
    return {name: float(np.mean([score[name] for score in scores if name in score])) for name in names}


def grid(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Markdown table from a header row and body rows."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body))
