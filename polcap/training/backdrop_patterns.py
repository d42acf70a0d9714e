"""Random patterns of backdrops for training the mask network: albedo of cloth, paper, wood, stone and prints."""

from collections.abc import Callable

import numpy as np

from polcap.image_values import Floats
from polcap.training import random_shapes


def draw_pattern(position: Floats, rng: np.random.Generator) -> Floats:
    """Albedo (M, 3) of a random pattern in two to six colors at points (M, 3); unit: the object's longest side."""
    u, w = _plane_coordinates(position, rng)
    size = random_shapes.log_uniform(0.05, 0.9, rng)
    if rng.random() < 0.4:  # uneven cloth
        u = u + 0.15 * size * _waves(u / size, w / size, rng)
    level = _PATTERNS[rng.integers(len(_PATTERNS))](u / size, w / size, rng)
    return _color(level, rng)


def draw_print(position: Floats, rng: np.random.Generator) -> Floats:
    """Albedo (M, 3) of a printed pattern in two colors (checks, stripes, dots, markers) at points (M, 3)."""
    u, w = _plane_coordinates(position, rng)
    size = random_shapes.log_uniform(0.04, 0.5, rng)
    u, w = u / size, w / size
    kind = rng.integers(4)
    if kind == 0:
        second = (np.floor(u) + np.floor(w)) % 2 > 0
    elif kind == 1:
        second = u % 1 < rng.uniform(0.2, 0.8)
    elif kind == 2:
        second = np.hypot(u % 1 - 0.5, w % 1 - 0.5) < rng.uniform(0.15, 0.45)
    else:  # squares with random cells, as on a board of markers
        cells = rng.random((7, 7)) < 0.5
        second = cells[np.floor(5 * u).astype(int) % 7, np.floor(5 * w).astype(int) % 7]
    colors = random_shapes.log_uniform(0.02, 0.9, rng, (2, 1)) * np.exp(rng.normal(0, 0.25, (2, 3)))
    return np.asarray(np.clip(colors[second.astype(int)], 0.005, 0.95))


def _plane_coordinates(position: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Project points (M, 3) onto two random perpendicular axes; returns two coordinates (M,)."""
    u, w = (position @ axis for axis in np.linalg.qr(rng.normal(size=(3, 3)))[0][:2])
    return u, w


def _color(level: Floats, rng: np.random.Generator) -> Floats:
    """Map pattern levels 0…1 (M,) to colors (M, 3): a few discrete colors, or a gradient between them."""
    count = int(rng.integers(2, 7))
    middle = random_shapes.log_uniform(0.015, 0.9, rng)
    contrast, hue = rng.uniform(0.15, 1.3), rng.choice([0.05, 0.2, 0.5])
    colors = middle * np.exp(contrast * rng.normal(size=(count, 1)) + hue * rng.normal(size=(count, 3)))
    colors = np.clip(colors, 0.004, 0.95)
    at = np.clip(level, 0, 1 - 1e-6) * count
    if rng.random() < 0.6:
        return np.asarray(colors[at.astype(int)], np.float32)
    low = np.clip(at - 0.5, 0, count - 1).astype(int)
    share = np.clip(at - 0.5 - low, 0, 1)[:, None]
    return np.asarray(colors[low] * (1 - share) + colors[np.minimum(low + 1, count - 1)] * share, np.float32)


def _waves(u: Floats, w: Floats, rng: np.random.Generator, octaves: int = 3) -> Floats:
    """Smooth random noise (M,) of standard deviation about 1, at plane coordinates u, w (M,) in periods."""
    out = np.zeros_like(u)
    for octave in range(octaves):
        for _ in range(5):
            wave = rng.normal(size=2) * 2.2 * 2.0**octave  # wave vector
            out = out + 0.6 * 0.55**octave * np.sin(wave[0] * u + wave[1] * w + rng.uniform(0, 6.28))
    return out


def _blotches(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of a backdrop with camouflage, stains or clouds."""
    return 0.5 + 0.3 * _waves(u, w, rng, int(rng.integers(1, 5)))


def _bands(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of a backdrop like wood, marble or folds."""
    return 0.5 + 0.5 * np.sin(6.28 * u + rng.uniform(0, 3) * _waves(u, w, rng))


def _woven(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of crossing stripes: tartan, tiles or towels."""
    one, other = (rng.random(7), rng.random(7) * (rng.random() < 0.7))
    return np.asarray(0.6 * one[np.floor(5 * u).astype(int) % 7] + 0.4 * other[np.floor(5 * w).astype(int) % 7])


def _cells(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of a backdrop of Voronoi cells: stones, leaves or patchwork. A tile has two periods."""
    seeds, tile = rng.uniform(0, 2, (14, 2)), rng.random(14)
    at = np.stack([u, w], axis=1) % 2
    away = np.abs(at[:, None] - seeds[None])
    away = np.minimum(away, 2 - away)
    return np.asarray(tile[(away**2).sum(-1).argmin(1)])


def _blobs(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of round and oblong spots on a plain ground: flowers or pebbles."""
    out = np.zeros_like(u)
    for _ in range(int(rng.integers(3, 12))):
        center, size, long = rng.uniform(0, 2, 2), rng.uniform(0.08, 0.45), rng.uniform(0.3, 1)
        turn = rng.uniform(0, 3.14)
        x, y = ((a - c + 1) % 2 - 1 for a, c in zip((u, w), center))
        x, y = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        out = np.where(np.hypot(x, y / long) < size, rng.random(), out)
    return out


def _lines(u: Floats, w: Floats, rng: np.random.Generator) -> Floats:
    """Pattern levels (M,) of lines of print: newspaper, packaging or keyboards."""
    words = rng.random((9, 31)) < rng.uniform(0.4, 0.8)
    inked = words[np.floor(4 * w).astype(int) % 9, np.floor(rng.uniform(6, 14) * u).astype(int) % 31]
    return np.asarray(np.where(inked & (4 * w % 1 < rng.uniform(0.3, 0.8)), 0.9, 0.1))


_PATTERNS: list[Callable[[Floats, Floats, np.random.Generator], Floats]] = [
    _blotches, _blotches, _bands, _woven, _cells, _blobs, _lines,
]  # fmt: skip
