"""Random relief: its gradient is that of a height field, and normals lean away from the slope."""

import numpy as np
from numpy.typing import NDArray

from polcap.optics import frames
from polcap.training import relief


def test_slopes_are_gradients_of_a_height_field() -> None:
    """Differences of the height over small steps along each axis equal the gradient."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-1, 1, (200, 3))
    step = 1e-4
    for seed in range(8):

        def at(shift: NDArray[np.float64], seed: int = seed) -> NDArray[np.float64]:
            height, _ = relief._waves(place + shift, 0.1, np.random.default_rng(seed))
            return np.asarray(height)

        _, gradient = relief._waves(place, 0.1, np.random.default_rng(seed))
        for axis, direction in enumerate(np.eye(3)):
            measured = (at(step * direction) - at(-step * direction)) / (2 * step)
            assert np.abs(measured - gradient[:, axis]).max() < 1e-2 * np.abs(gradient).max()
        slope = relief.random_slopes(place, 0.01, np.random.default_rng(seed))
        assert slope.shape == (200, 3) and np.linalg.norm(slope, axis=1).max() < 1.3


def test_normals_lean_away_from_the_slope() -> None:
    up, slope = np.array([[0.0, 0, 1]]), np.array([[0.5, 0, 0.7]])
    assert np.allclose(frames.unit(frames.tilted(up, slope)), np.array([[-0.5, 0, 1]]) / np.sqrt(1.25), atol=1e-6)
