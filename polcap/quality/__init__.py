"""Gates: judgements of a capture, each with limit, cost and remedy."""
