"""Ambient occlusion of a closed mesh, traced from its vertices: share of a uniform sky that the mesh does not hide."""

import numpy as np

from polcap.fusion.atlas import Atlas
from polcap.image_values import Floats
from polcap.optics.outline import fill_outward
from polcap.optics.texture_rasterizer import rasterize

_RAYS = 128  # from a vertex; the share at the bottom of a pit then errs by 0.01
_START = 1e-3  # of the mesh's size: height of the rays' starts; reduced meshes have folds of this height
_GOLDEN = np.pi * (3 - np.sqrt(5))  # rad, between neighbors on Fibonacci's sphere


def ambient_occlusion(atlas: Atlas) -> Floats:
    """Visible share (S, S) of a uniform sky around the object, weighted by the cosine, on the texels of its atlas."""
    image = np.zeros((*atlas.covered.shape, 1), np.float32)
    points = rasterize(atlas.mesh.uv, atlas.mesh.faces, *atlas.covered.shape)
    image[points.covered] = points.interpolate(_visible_sky(atlas)[:, None])
    return np.asarray(fill_outward(image, points.covered)[..., 0])


def _visible_sky(atlas: Atlas) -> Floats:
    """Visible share (V,) of the sky at each vertex: a unit normal plus a point of a unit sphere has Lambert's law."""
    mesh, tracer = atlas.mesh, atlas.tracer()
    start = mesh.vertices + _START * tracer.size * mesh.normals
    height, turn = 1 - (2 * np.arange(_RAYS) + 1) / _RAYS, _GOLDEN * np.arange(_RAYS)
    across = np.sqrt(1 - height**2)
    free = np.zeros(len(start), np.float32)
    for point in np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=-1):
        free += ~tracer.hidden(start, start + 1e3 * tracer.size * (mesh.normals + 0.999 * point))  # never of length 0
    return free / _RAYS
