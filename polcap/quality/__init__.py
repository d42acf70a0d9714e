"""Quality gates: figures of a capture against limits, with finding, cost in degrees of normal error, and remedy."""
