"""Random fine relief for training: waves, embossing, grooves and weave, added to traced normals.

Each relief is a height field in space with a known gradient, so that the true normals are exact at every pixel.
"""

from math import pi

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats
from polcap.optics import frames

_WAVES = 16  # plane waves in a random height field
_LONGEST, _SHORTEST = 40.0, 4.0  # wavelengths, px
_MAX_SLOPE = 1.2  # steeper relief would hide parts of itself
_SMOOTH_SHARE = 0.2  # of objects, which have no relief


def random_slopes(position: Floats, px: float, rng: np.random.Generator) -> Floats:
    """Gradients (M, 3) of a random relief at positions (M, 3), in the same frame; `px` is the length of a pixel."""
    if rng.random() < _SMOOTH_SHARE:
        return np.zeros_like(position)
    wavelength = px * _SHORTEST * (_LONGEST / _SHORTEST) ** rng.random()
    height, gradient = _waves(position, wavelength, rng)
    kind = rng.integers(4)
    if kind == 1:  # embossed: two levels with a flank between them
        gradient = gradient / np.cosh(rng.uniform(2, 6) * (height + rng.normal(0, 0.5)))[:, None] ** 2
    elif kind == 2:  # grooves along the lines of height 0
        width = rng.uniform(0.15, 0.5)
        gradient = (height / width * np.exp(-((height / width) ** 2)))[:, None] * gradient
    elif kind == 3:  # weave
        gradient = _woven(position, wavelength, rng)
    steep = np.sqrt(np.mean(np.sum(gradient**2, axis=1))) + 1e-9
    gradient = gradient / steep * rng.uniform(0.03, 0.5) * rng.choice([-1, 1])
    if rng.random() < 0.5:  # on a part of the object only
        region, _ = _waves(position, px * rng.uniform(80, 300), rng)  # positive in that part
        gradient = gradient / (1 + np.exp(-8 * region))[:, None]
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.asarray(gradient * np.minimum(1, _MAX_SLOPE / np.maximum(length, 1e-9)), np.float32)


def _waves(position: Floats, wavelength: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """A random relief of plane waves of similar length: height (M,) of standard deviation 1, and gradient (M, 3)."""
    direction = frames.unit(rng.normal(size=(_WAVES, 3)))
    wave_vectors = 2 * pi / wavelength * rng.uniform(0.5, 1.3, (_WAVES, 1)) * direction
    phase: NDArray[np.float64] = position @ wave_vectors.T + rng.uniform(0, 2 * pi, _WAVES)
    scale = np.sqrt(2 / _WAVES)
    return np.asarray(scale * np.cos(phase).sum(1)), np.asarray(-scale * np.sin(phase) @ wave_vectors)


def _woven(position: Floats, wavelength: float, rng: np.random.Generator) -> Floats:
    """Gradient (M, 3) of a woven relief: two sets of threads that cross."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] * 2 * pi / wavelength
    phase = position @ axes.T + rng.uniform(0, 2 * pi, 2)
    return np.asarray(np.cos(phase) @ axes)
