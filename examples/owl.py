"""The mesh of an owl, 1 high, y up and facing z: the object of the bundled capture.

Parts with a distance field are joined smoothly, and feathers are added to the surface. Needs scikit-image.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.special import expit
from skimage.measure import marching_cubes

Array = np.ndarray
_STEP = 1.06 / 380  # of the grid
_LOW, _HIGH = np.array([-0.36, -0.53, -0.32]), np.array([0.36, 0.53, 0.34])
_WING = ((0.238, -0.13, -0.01), (0.068, 0.30, 0.19))  # middle and semi-axes


def write(file: Path) -> None:
    """Write the mesh as an .npz that polcap reads."""
    vertices, faces = mesh()
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0).max()
    quantized = np.rint((vertices - low) / size * 65535).astype(np.uint16)
    np.savez_compressed(file, faces=faces.astype(np.int32), vq=quantized, vscale=size, vmin=low)


def mesh() -> tuple[Array, Array]:
    """Vertices (V, 3) and triangles (F, 3)."""
    x, y, z = (np.arange(low, high, _STEP) for low, high in zip(_LOW, _HIGH))
    field = np.stack([distance(np.stack(np.meshgrid(one, y, z, indexing="ij"), axis=-1)[0]) for one in x])
    vertices, faces, normals, _ = marching_cubes(field, 0.0, spacing=(_STEP,) * 3)
    edges = sparse.coo_matrix((np.ones(faces.size), (faces.ravel(), np.roll(faces, 1, axis=1).ravel())))
    joined = ((edges + edges.T).tocsr() > 0).astype(float)
    mean = sparse.diags(1 / np.asarray(joined.sum(axis=1)).ravel()) @ joined  # over the neighbors of each vertex
    vertices = vertices + _LOW
    height = feathers(vertices)
    for _ in range(3):
        height = 0.3 * height + 0.7 * (mean @ height)
    for _ in range(2):
        vertices = 0.5 * vertices + 0.5 * (mean @ vertices)
    return vertices - normals * height[:, None], faces  # these normals point inside


def distance(p: Array) -> Array:
    """Distance field (...,) of the owl without feathers at points (..., 3); both halves are alike."""
    m = p * np.where(p[..., :1] < 0, (-1, 1, 1), 1)
    d = ellipsoid(p, (0, -0.13, 0), (0.285, 0.39, 0.265))
    d = join(d, ellipsoid(p, (0, 0.235, 0), (0.262, 0.205, 0.235)), 0.10)
    d = join(d, rod(m, (0.165, 0.36, 0.02), (0.235, 0.475, 0), (0.062, 0.014)), 0.07)  # ear
    d = join(d, ellipsoid(m, *_WING, turn=-0.10), 0.035)
    d = join(d, rod(m, (0.02, 0.285, 0.222), (0.17, 0.385, 0.155), (0.020, 0.026)), 0.08)  # brow
    d = join(d, ring(m, (0.112, 0.245, 0.205), (0.28, 0.05, 1), (0.086, 0.017)), 0.05)
    d = join(d, ellipsoid(m, (0.108, 0.245, 0.185), (0.058, 0.058, 0.062)), 0.008)  # eye
    d = join(d, ellipsoid(p, (0, 0.185, 0.245), (0.030, 0.062, 0.040)), 0.012)  # beak
    for x in (0.075, 0.12, 0.165):  # toes
        d = join(d, ellipsoid(m, (x, -0.455, 0.165 - abs(x - 0.12) / 4), (0.027, 0.036, 0.085)), 0.03)
    return np.asarray(np.maximum(d, -0.492 - p[..., 1]))


def feathers(vertices: Array) -> Array:
    """Height (V,) of the feathers on breast and wings over the surface."""
    x, y, z = vertices.T
    wing = (ellipsoid(np.abs(vertices) * (1, 0, 0) + vertices * (0, 1, 1), *_WING, turn=-0.10) < 0.008) & (y < 0.2)
    breast = scales(np.arctan2(x, z) * 3.3, y / 0.070) * expit((0.06 - y) / 0.012) * expit((y + 0.40) / 0.012)
    wings = scales(z / 0.095 + 0.1 * y, y / 0.125) * expit((0.16 - y) / 0.01) * expit(z / 0.02)
    return np.asarray(np.where(wing, 0.013 * wings, 0.016 * breast * (z > -0.05)))


def scales(u: Array, v: Array) -> Array:
    """Height 0…1 of overlapping scales in rows, one per unit of u and of v; the upper rows cover the lower ones."""
    height, covered = np.zeros(u.shape), np.zeros(u.shape, bool)
    for k in range(4):
        row = np.floor(v) + 2 - k
        across = u - 0.5 * (row % 2)
        across = across - np.round(across)
        down = row - v  # from the scale's root
        radius = np.hypot(across / 0.62, np.where(down > 0, down / 1.35, -9 * down))
        shape = 0.25 + 0.75 * np.clip(down / 1.35, 0, 1) - 0.35 * radius**6
        shaft = 0.16 * np.exp(-((across / 0.05) ** 2)) * np.clip(down, 0, 1)
        new = (radius < 1) & ~covered
        height[new] = (shape + shaft)[new]
        covered |= new
    return height


def join(one: Array, other: Array, width: float) -> Array:
    """Distance field of the union of two shapes, rounded over `width`."""
    near = np.maximum(width - np.abs(one - other), 0) / width
    return np.asarray(np.minimum(one, other) - near**2 * width / 4)


def ellipsoid(p: Array, middle: Sequence[float], size: Sequence[float], turn: float = 0.0) -> Array:
    """Approximate distance field of an ellipsoid that is turned about z by `turn` rad."""
    c, s = np.cos(turn), np.sin(turn)
    q = (p - middle) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    near, slope = np.linalg.norm(q / size, axis=-1), np.linalg.norm(q / np.square(size), axis=-1)
    return np.asarray(near * (near - 1) / np.maximum(slope, 1e-6))


def rod(p: Array, start: Sequence[float], end: Sequence[float], radii: tuple[float, float]) -> Array:
    """Distance field of a rod whose radius changes from end to end."""
    axis = np.subtract(end, start)
    along = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
    return np.asarray(np.linalg.norm(p - start - along[..., None] * axis, axis=-1) - np.interp(along, (0, 1), radii))


def ring(p: Array, middle: Sequence[float], axis: Sequence[float], radii: tuple[float, float]) -> Array:
    """Distance field of a ring: its radius, and that of its cross section."""
    unit, q = np.asarray(axis) / np.linalg.norm(axis), p - middle
    return np.asarray(np.hypot(np.linalg.norm(np.cross(q, unit), axis=-1) - radii[0], q @ unit) - radii[1])
