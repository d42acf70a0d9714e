"""Patterns of backdrops: albedos within their limits."""

import numpy as np

from polcap.training import backdrop_patterns


def test_patterns_are_albedos_in_color() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    for seed in range(16):
        albedo = backdrop_patterns.draw_pattern(points, np.random.default_rng(seed))
        assert albedo.shape == (500, 3) and 0 < albedo.min() <= albedo.max() <= 0.95
