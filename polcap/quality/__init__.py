"""Quality gates: checks of a capture, each with limit, cost in degrees of normal error, and remedy."""
