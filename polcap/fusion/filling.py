"""Fills texels that no view saw, smoothly over the surface, from those around them.

Values x at the vertices solve (W + λ L) x = W b. W is the diagonal of the mean weights w of the views around each
vertex, b the mean of their values, L the Laplacian of the mesh. Far from seen surface x is harmonic, without steps.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import MATERIAL, WEIGHT, AtlasMaps, on_atlas
from polcap.image_values import Floats
from polcap.optics.texture_rasterizer import rasterize
from polcap.stages import stage

_STIFFNESS = 0.02  # λ, relative to the weight of a vertex that one view sees along the normal
_FADE = 0.1  # weight of the views below which the filled values are mixed in


@stage(version=1)
def fill(maps: AtlasMaps, atlas: Atlas) -> AtlasMaps:
    """Fill albedo, F0 and roughness where no view saw the surface; normals there are those of the mesh already."""
    points = rasterize(atlas.mesh.uv, atlas.mesh.faces, *atlas.covered.shape)
    _, vertex = np.unique(atlas.mesh.vertices, axis=0, return_inverse=True)  # copies at seams get one number
    vertex = vertex.reshape(-1)
    second, third = points.weights.T.astype(np.float64)
    corners = np.stack([1 - second - third, second, third], axis=-1)  # (N, 3) barycentric coordinates of the texels
    rows = np.repeat(np.arange(len(corners)), 3)
    interpolation: Any = sparse.csr_matrix(
        (corners.ravel(), (rows, vertex[points.corners].ravel())), (len(corners), vertex.max() + 1)
    )
    values = maps.texels(atlas.covered)
    material, weight = values[:, MATERIAL].copy(), values[:, WEIGHT].astype(np.float64)
    smooth = interpolation @ _solve_vertices(vertex[atlas.mesh.faces], interpolation, weight, material)
    share = np.clip(weight / _FADE, 0, 1)[:, None]
    values[:, MATERIAL] = share * material + (1 - share) * smooth
    return on_atlas(atlas, values)


def _solve_vertices(faces: NDArray[np.intp], interpolation: Any, weight: Floats, values: Floats) -> Floats:
    """Values (V, C) at the vertices by the equation above, from weights (N,) and values (N, C) of the texels.

    `interpolation` (N, V) makes values at texels from values at vertices.
    """
    count = interpolation.shape[1]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links: Any = sparse.coo_matrix((np.ones(len(ends)), ends.T), (count, count)).tocsr()
    links = ((links + links.T) > 0).astype(np.float64)
    laplacian: Any = sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links
    texels = np.asarray(interpolation.sum(axis=0)).ravel()  # number of them, by vertex
    total = np.asarray(interpolation.T @ weight).ravel()
    w = total / np.maximum(texels, 1e-9)
    b = (interpolation.T @ (weight[:, None] * values)) / np.maximum(total, 1e-9)[:, None]
    system: Any = sparse.diags(w + 1e-9) + _STIFFNESS * laplacian
    return np.asarray(splu(system.tocsc()).solve(w[:, None] * b))
