"""Random closed meshes with thin parts: a body and the legs, branches or spouts that grow out of it."""

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.synth.mesh_tracer import Triangles, centred, smooth, union
from polcap.training import shapes

_ALONG, _AROUND = 24, 14  # vertices of a limb


def grown(rng: np.random.Generator) -> Triangles:
    """A body with two to fourteen limbs, half of the time the same on both sides; longest side 1, centred."""
    body = shapes.compose(rng)
    parts = [body]
    size, twins = rng.uniform(0.012, 0.05), rng.random() < 0.5
    squash = np.array([1.0, 1.0, rng.choice([1.0, 0.5])])
    for _ in range(int(rng.integers(2, 8 if twins else 15))):
        start = body.vertices[rng.integers(len(body.vertices))]
        vertices, faces = _limb(start, size * rng.uniform(0.6, 1.6), rng.uniform(0.25, 1.0), squash, rng)
        parts.append(smooth(vertices, faces))
        if twins:
            parts.append(smooth(vertices * [-1, 1, 1], faces[:, ::-1]))
    return centred(union(parts))


def _limb(
    start: Floats, radius: float, length: float, squash: Floats, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int32]]:
    """A bent, tapering tube from the body's middle through `start` outwards."""
    t = np.linspace(0, 1, _ALONG)[:, None]
    out = start / max(float(np.linalg.norm(start)), 1e-6)
    bend, wave = (rng.normal(size=3) * length * k for k in (0.5, 0.12))
    curve = start * 0.7 + (out * length * t + bend * t**2 + wave * np.sin(rng.uniform(3, 12) * t)) * squash
    tangent = np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
    side = np.cross(tangent, rng.normal(size=3))
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-9
    other = np.cross(tangent, side)
    knots = 1 + rng.uniform(0, 0.5) * np.sin(rng.uniform(0, 40) * t[:, 0])
    thick = radius * (1 - rng.uniform(0, 0.8) * t[:, 0]) * knots
    thick[[0, -1]] = 1e-4  # closed
    around = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)[:, None]
    ring = side[:, None] * np.cos(around) + other[:, None] * np.sin(around)
    vertices = (curve[:, None] + thick[:, None, None] * ring).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(_ALONG - 1), np.arange(_AROUND), indexing="ij"))
    a, b = i * _AROUND + j, (i + 1) * _AROUND + j
    c, d = (i + 1) * _AROUND + (j + 1) % _AROUND, i * _AROUND + (j + 1) % _AROUND
    faces = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])
    return vertices, faces.astype(np.int32)
