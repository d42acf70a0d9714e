"""Random closed meshes for training: one to seven simple bodies joined, some with arms, legs or branches."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.image_values import Faces, Floats
from polcap.optics.mesh_tracer import Triangles, centred, smooth, union

_RINGS, _SECTORS = 96, 128  # vertices of a body
_BRANCH_RINGS, _BRANCH_SECTORS = 24, 14  # vertices of a branch


def compose(rng: np.random.Generator) -> Triangles:
    """A random mesh joined from one to seven parts, longest side 1, centered."""
    count = 1 if rng.random() < 0.35 else int(rng.integers(2, 8))
    parts = []
    centre = np.zeros(3)
    for index in range(count):
        vertices, faces = _PARTS[rng.integers(len(_PARTS))](rng)
        size = 1.0 if index == 0 else rng.uniform(0.25, 0.9)
        vertices = size * vertices @ rotation(rng).T + centre
        parts.append(smooth(vertices, faces))
        anchor = vertices[rng.integers(len(vertices))]  # the next part grows out of this one's surface
        centre = centre * 0.2 + anchor * 0.8 if rng.random() < 0.6 else anchor * 0.5
    return centred(union(parts))


def compose_with_branches(rng: np.random.Generator) -> Triangles:
    """A random mesh with 2–14 thin branches, mirrored left to right in half of the cases; longest side 1, centered."""
    body = compose(rng)
    parts = [body]
    size, twins = rng.uniform(0.012, 0.05), rng.random() < 0.5
    squash = np.array([1.0, 1.0, rng.choice([1.0, 0.5])])
    for _ in range(int(rng.integers(2, 8 if twins else 15))):
        start = body.vertices[rng.integers(len(body.vertices))]
        vertices, faces = _branch(start, size * rng.uniform(0.6, 1.6), rng.uniform(0.25, 1.0), squash, rng)
        parts.append(smooth(vertices, faces))
        if twins:
            parts.append(smooth(vertices * [-1, 1, 1], faces[:, ::-1]))
    return centred(union(parts))


def log_uniform(low: float, high: float, rng: np.random.Generator, size: int | tuple[int, ...] | None = None) -> Any:
    """Random numbers between `low` and `high` with an even distribution of their logarithm; one without a `size`."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def rotation(rng: np.random.Generator) -> Floats:
    """A uniformly random rotation matrix, (3, 3)."""
    return np.asarray(Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix())  # scalar last


def _displaced(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of an ellipsoid with waves on its surface: vertices and faces."""
    unit, faces = _sphere(_RINGS, _SECTORS)
    field = np.zeros(len(unit))
    for _ in range(int(rng.integers(2, 9))):
        frequency = log_uniform(1.5, 14, rng)
        wave = unit @ (rng.normal(size=3) * frequency)
        field = field + rng.normal() * np.sin(wave + rng.uniform(0, 6.28)) / frequency
    radius = 0.5 * (1 + rng.uniform(0.2, 0.9) * np.tanh(field))
    return unit * radius[:, None] * rng.uniform(0.4, 1.0, 3), faces


def _dented(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of an ellipsoid with hollows and bosses, some with a flat floor, and often fine relief.

    A hollow and a boss polarize light in the same way. Only outline, shadow and neighbors distinguish them.
    """
    unit, faces = _sphere(2 * _RINGS, 2 * _SECTORS)
    radius = np.ones(len(unit))
    widest = log_uniform(0.2, 0.9, rng)  # rad
    for _ in range(int(rng.integers(3, 17))):
        width = widest * rng.uniform(0.4, 1.0)
        away = np.arccos(np.clip(unit @ rotation(rng)[0], -1, 1)) / width
        steep = rng.uniform(1, 4)  # 1: a Gaussian; more: a pit with a wall and a floor
        radius += rng.choice([-1, -1, 1]) * width * rng.uniform(0.2, 0.8) * np.exp(-0.5 * away ** (2 * steep))
    if rng.random() < 0.5:
        away = np.arccos(np.clip(unit @ rotation(rng)[0], -1, 1))
        wave = np.ones(len(unit))
        frequency = rng.uniform(12, 40)
        for _ in range(int(rng.integers(1, 3))):
            wave *= np.sin(frequency * (unit @ rotation(rng)[0]) + rng.uniform(0, 6.28))
        radius += rng.uniform(0.1, 0.5) / frequency * wave * (away < rng.uniform(0.3, 1.2))
    return 0.5 * unit * np.clip(radius, 0.25, None)[:, None] * rng.uniform(0.5, 1.0, 3), faces


def _superquadric(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of a superquadric: box, cylinder, ellipsoid, star and shapes between them."""
    unit, faces = _sphere(_RINGS, _SECTORS)
    east, north = log_uniform(0.12, 2.2, rng, 2)
    longitude = np.arctan2(unit[:, 1], unit[:, 0])
    circle = np.stack([np.cos(longitude), np.sin(longitude)], axis=1)
    ring = np.maximum(1 - unit[:, 2:] ** 2, 0) ** (north / 2)
    heights = _power(unit[:, 2:], north)
    return 0.5 * np.hstack([ring * _power(circle, east), heights]) * rng.uniform(0.25, 1.0, 3), faces


def _lathed(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of a solid of revolution, sometimes with lobes or a twist."""
    height = np.linspace(1, -1, _RINGS)
    profile = np.full(_RINGS, rng.uniform(0.3, 0.6))
    for k in range(1, 7):
        profile = profile + rng.normal() * 0.3 / k * np.cos(k * np.pi * (height + 1) / 2 + rng.uniform(0, 6.28))
    profile = np.clip(np.abs(profile), 0.05, 1.2) * (1 - np.abs(height) ** rng.uniform(4, 40)) ** 0.5
    ring, longitude = profile[:, None], _longitudes()
    if rng.random() < 0.4:
        lobes = rng.integers(2, 14) * longitude + rng.uniform(-4, 4) * height[:, None]
        ring = ring * (1 + rng.uniform(0.02, 0.2) * np.cos(lobes))
    return _revolve(0.45 * ring, 0.45 * rng.uniform(0.4, 1.2) * height), ring_faces(_RINGS, _SECTORS, closed=False)


def _vessel(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of a plate, bowl, cup or vase: an open solid of revolution with a wall and a rim."""
    rise = np.linspace(0, 1, _RINGS // 2)  # from the foot up
    mouth, waist = rng.uniform(0.25, 0.6), rng.normal() * 0.12
    radius = mouth * rise ** rng.uniform(0.15, 0.9) + waist * np.sin(np.pi * rise) * rise
    radius = np.clip(radius + rng.normal() * 0.03 * np.sin(rng.uniform(2, 9) * rise), 0.02, 0.7)
    radius[0] = 0.0
    wall, tall = rng.uniform(0.01, 0.06), log_uniform(0.12, 1.3, rng)
    inner = np.clip(radius[::-1] - wall, 0.0, None)
    height = np.concatenate([rise * tall, np.maximum(rise[::-1] * tall, wall)])
    lobes = 1 + (rng.random() < 0.3) * rng.uniform(0, 0.15) * np.cos(rng.integers(3, 13) * _longitudes())
    vertices = _revolve(np.concatenate([radius, inner])[:, None] * lobes, height - tall / 2)
    return vertices * [1, rng.uniform(0.7, 1.0), 1], ring_faces(_RINGS, _SECTORS, closed=False)[:, ::-1]


def _tube(rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Random mesh of a tube along a closed curve: handle, knot or ring."""
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    curve = np.zeros((len(t), 3))
    for k in range(1, int(rng.integers(2, 5))):
        curve += (np.outer(np.cos(k * t), rng.normal(size=3)) + np.outer(np.sin(k * t), rng.normal(size=3))) / k**1.5
    curve /= 2 * np.abs(curve).max()
    tangent, axis = np.roll(curve, -1, 0) - np.roll(curve, 1, 0), rng.normal(size=3)
    radius = rng.uniform(0.05, 0.18) * (1 + rng.uniform(0, 0.4) * np.sin(rng.integers(1, 6) * t))
    return _sweep(curve, tangent, axis, radius, 40), ring_faces(len(t), 40, closed=True)[:, ::-1]


def _branch(
    start: Floats, radius: float, length: float, squash: Floats, rng: np.random.Generator
) -> tuple[Floats, Faces]:
    """Mesh of a bent, tapering tube that starts inside an ellipsoidal body and leaves it at `start` (3,)."""
    t = np.linspace(0, 1, _BRANCH_RINGS)
    out = start / max(float(np.linalg.norm(start)), 1e-6)
    bend, wave = (rng.normal(size=3) * length * k for k in (0.5, 0.12))
    path = np.outer(t, out * length) + np.outer(t**2, bend) + np.outer(np.sin(rng.uniform(3, 12) * t), wave)
    curve, axis = start * 0.7 + path * squash, rng.normal(size=3)
    knots = 1 + rng.uniform(0, 0.5) * np.sin(rng.uniform(0, 40) * t)
    thickness = radius * (1 - rng.uniform(0, 0.8) * t) * knots
    thickness[[0, -1]] = 1e-4  # closed ends
    vertices = _sweep(curve, np.gradient(curve, axis=0), axis, thickness, _BRANCH_SECTORS)
    return vertices, ring_faces(_BRANCH_RINGS, _BRANCH_SECTORS, closed=False)[:, ::-1]


_PARTS: list[Callable[[np.random.Generator], tuple[Floats, Faces]]] = [
    _displaced, _displaced, _dented, _dented, _dented, _superquadric, _superquadric, _lathed, _vessel, _vessel, _tube,
]  # fmt: skip


def _sphere(rings: int, sectors: int) -> tuple[Floats, Faces]:
    """Unit sphere of latitudes and longitudes from the north pole down, faces counter-clockwise from outside."""
    polar = np.linspace(0, np.pi, rings)
    return _revolve(np.sin(polar)[:, None], np.cos(polar), sectors), ring_faces(rings, sectors, closed=False)


def _longitudes(sectors: int = _SECTORS) -> Floats:
    return np.linspace(0, 2 * np.pi, sectors, endpoint=False)


def _revolve(ring: Floats, height: Floats, sectors: int = _SECTORS) -> Floats:
    """Vertices (R · S, 3) of a solid of revolution with radii (R, S) or (R, 1) at heights (R,)."""
    around = _longitudes(sectors)
    parts = ring * np.cos(around), ring * np.sin(around), height[:, None]
    return np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3)


def _sweep(curve: Floats, tangent: Floats, axis: Floats, radius: Floats, sectors: int) -> Floats:
    """Vertices (R · sectors, 3) of a tube about a curve (R, 3); `axis` (3,) fixes the place of the first sector."""
    tangent = tangent / (np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9)
    side = np.cross(tangent, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-9
    other = np.cross(tangent, side)
    around = _longitudes(sectors)[:, None]
    ring = side[:, None] * np.cos(around) + other[:, None] * np.sin(around)
    return np.asarray((curve[:, None] + radius[:, None, None] * ring).reshape(-1, 3))


def ring_faces(rings: int, sectors: int, *, closed: bool) -> Faces:
    """Triangles that connect successive rings of vertices; with `closed`, also the last ring with the first.

    They are counter-clockwise from outside if the rings are counter-clockwise from above.
    """
    i, j = np.meshgrid(np.arange(rings - (not closed)), np.arange(sectors), indexing="ij")
    here, next_ring = i * sectors, (i + 1) % rings * sectors
    next_sector = (j + 1) % sectors
    a, b, c, d = here + j, next_ring + j, next_ring + next_sector, here + next_sector
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3).astype(np.int32)


def _power(value: Floats, exponent: float) -> Floats:
    """Power of the magnitude, with the sign of the value."""
    return np.asarray(np.sign(value) * np.abs(value) ** exponent)
