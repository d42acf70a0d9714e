"""Normals and tangents of mesh vertices, as means over the triangles around them."""

import numpy as np

from polcap.image_values import Faces, Floats
from polcap.optics.frames import cross, dot, unit


def vertex_frames(vertices: Floats, uv: Floats, faces: Faces) -> tuple[Floats, Floats]:
    """Normals (V, 3) and tangents (V, 4) of mesh vertices, as of `vertex_normals` and `vertex_tangents`."""
    normals = vertex_normals(vertices, faces)
    return normals, vertex_tangents(vertices, uv, faces, normals)


def vertex_normals(vertices: Floats, faces: Faces) -> Floats:
    """Normals (V, 3) of mesh vertices (V, 3): unit, area-weighted means over the triangles around."""
    return unit(_sum_around(area_vectors(vertices, faces), faces, len(vertices)))


def area_vectors(vertices: Floats, faces: Faces) -> Floats:
    """Normals (F, 3) of triangles of vertices (V, 3), each as long as twice the triangle's area."""
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    return np.asarray(cross(one, two))


def vertex_tangents(vertices: Floats, uv: Floats, faces: Faces, normals: Floats) -> Floats:
    """Tangents (V, 4) of mesh vertices: unit, area-weighted means of ∂P/∂u made square to the normals (V, 3).

    v runs down the picture and the normal texture's +Y runs up, so the handedness w of glTF's bitangent w (n × t) is 1.
    """
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    (u1, v1), (u2, v2) = ((uv[faces[:, k]] - uv[faces[:, 0]]).T for k in (1, 2))
    along = (one * v2[:, None] - two * v1[:, None]) * np.sign(u1 * v2 - u2 * v1)[:, None]
    tangents = _sum_around(along, faces, len(vertices))
    tangents = unit(tangents - normals * dot(normals, tangents)[:, None])
    return np.concatenate([tangents, np.ones((len(vertices), 1))], axis=-1)


def _sum_around(values: Floats, faces: Faces, count: int) -> Floats:
    """Sums (V, 3) of values (F, 3) over the triangles around each vertex."""
    corner = faces.ravel()
    return np.stack([np.bincount(corner, np.repeat(values[:, k], 3), count) for k in range(3)], axis=-1)
