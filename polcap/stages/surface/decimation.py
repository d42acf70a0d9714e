"""A mesh -> the same surface in fewer triangles, and how far it then lies from the first.

References
----------
Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997 (fast-simplification).
"""

from dataclasses import dataclass, replace

import numpy as np

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, View
from polcap.stages.surface import boundary
from polcap.stages.surface.backing import Back
from polcap.stages.surface.triangles import frames

_FEWEST = 16  # triangles
_MEASURED = 20_000  # vertices, at most, whose distance is measured


@dataclass(frozen=True)
class Decimated:
    """A mesh in fewer triangles, and how far it is from the one before."""

    mesh: Mesh
    error: float  # 99th percentile of the first mesh's vertices from this surface, in the mesh's unit of length
    error_px: float  # the same in px of the maps, at the object's middle depth


def decimated(mesh: Mesh, view: View, share: float, back: Back) -> Decimated:
    """The mesh in fewer triangles; textures stay where they are, as seen from the camera.

    Parameters
    ----------
    mesh
        All of it.
    view
        The camera that saw it.
    share
        About this share of its triangles is left, 0…1.
    back
        Whether it has walls, whose triangles face away from the camera.

    Raises
    ------
    ObjectError
        Too few triangles would be left.
    """
    import fast_simplification  # its 0.25 s are for exports with levels alone

    count = round(share * len(mesh.faces))
    if count < _FEWEST:
        raise ObjectError(
            f"{len(mesh.faces)} triangles × {share:g} leave {count}, under {_FEWEST}; ask for fewer levels"
        )
    points, faces = fast_simplification.simplify(  # which takes no read-only arrays
        np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32), target_count=count
    )
    vertices = np.asarray(points, dtype=np.float64)
    height, width = mesh.depth.shape
    a, b = -vertices[:, 0] / vertices[:, 2], -vertices[:, 1] / vertices[:, 2]
    uv = (np.stack([view.center[0] + view.focal * a, view.center[1] - view.focal * b], -1) + 0.5) / [width, height]
    faces = np.asarray(faces, dtype=np.int32)
    if back == "open":
        faces = faces[boundary.area(uv, faces) > 0]  # what a collapse folded over is not seen
    normals, tangents = frames(vertices, uv, faces)
    less = replace(
        mesh,
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        faces=faces,
    )
    error = _distance(mesh, less)
    return Decimated(less, error, error * view.focal / float(np.nanmedian(mesh.depth)))


def _distance(first: Mesh, less: Mesh) -> float:
    """99th percentile of the vertices' distance from the plane of the nearest of the other's triangles."""
    from scipy.spatial import cKDTree  # here: importing it costs .1 s of every start

    corner = less.vertices[less.faces].astype(np.float64)  # (F, 3, 3)
    share = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [0, 1, 1], [1, 0, 1], [1, 1, 0]], float)
    sample = np.einsum("sk,fkc->fsc", share / share.sum(axis=1, keepdims=True), corner)
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-30)
    every = max(1, len(first.vertices) // _MEASURED)
    vertex: Floats = first.vertices[::every].astype(np.float64)
    _, nearest = cKDTree(sample.reshape(-1, 3)).query(vertex)
    off = np.abs(np.sum((vertex - sample.reshape(-1, 3)[nearest]) * flat[nearest // len(share)], axis=-1))
    return float(np.percentile(off, 99))
