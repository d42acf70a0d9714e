"""Fills texels that no view saw, smoothly over the surface, from those around them.

Values at the vertices solve (W + λ L) x = W b: W is the weight of the views, b their values, L the Laplacian of the
mesh. Far from seen surface x is harmonic, without steps.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, on_atlas
from polcap.image_values import Floats
from polcap.optics.texture_rasterizer import rasterize
from polcap.stages import stage

_STIFFNESS = 0.02  # λ, relative to the weight of a vertex that one view sees along the normal
_FADE = 0.1  # weight of the views below which the filling shows


@stage(version=1)
def fill(maps: AtlasMaps, atlas: Atlas) -> AtlasMaps:
    """Fill albedo, F0 and roughness where no view saw the surface; normals there are those of the mesh already."""
    size = atlas.covered.shape
    points = rasterize(atlas.mesh.uv, atlas.mesh.faces, *size)
    _, place = np.unique(atlas.mesh.vertices, axis=0, return_inverse=True)  # vertices without the charts' seams
    place = place.reshape(-1)
    second, third = points.weights.T.astype(np.float64)
    shares = np.stack([1 - second - third, second, third], axis=-1)
    rows = np.repeat(np.arange(len(shares)), 3)
    spread: Any = sparse.csr_matrix(
        (shares.ravel(), (rows, place[points.corners].ravel())), (len(shares), place.max() + 1)
    )
    values = maps.texels(atlas.covered)
    material, weight = values[:, 3:10].copy(), values[:, 10].astype(np.float64)
    smooth = spread @ _harmonic(atlas, place, spread, weight, material)
    share = np.clip(weight / _FADE, 0, 1)[:, None]
    values[:, 3:10] = share * material + (1 - share) * smooth
    return on_atlas(atlas, values)


def _harmonic(atlas: Atlas, place: NDArray[np.intp], spread: Any, weight: Floats, values: Floats) -> Floats:
    """Values (V, C) at the vertices without seams, by the equation above."""
    count = spread.shape[1]
    faces = place[atlas.mesh.faces]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links: Any = sparse.coo_matrix((np.ones(len(ends)), ends.T), (count, count)).tocsr()
    links = ((links + links.T) > 0).astype(np.float64)
    laplacian: Any = sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links
    texels = np.asarray(spread.sum(axis=0)).ravel()  # of a vertex
    gathered = np.asarray(spread.T @ weight).ravel()
    seen = gathered / np.maximum(texels, 1e-9)
    mean = (spread.T @ (weight[:, None] * values)) / np.maximum(gathered, 1e-9)[:, None]
    system: Any = sparse.diags(seen + 1e-9) + _STIFFNESS * laplacian
    return np.asarray(splu(system.tocsc()).solve(seen[:, None] * mean))
