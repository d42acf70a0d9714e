"""Mesh decimation: the same surface with fewer triangles, and its distance from the full mesh.

References
----------
Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997 (fast-simplification).
"""

from dataclasses import dataclass, replace

import numpy as np

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, View
from polcap.optics.projection import project
from polcap.stages.surface.triangles import Back, face_areas, vertex_frames

_FEWEST = 16  # triangles
_MEASURED = 20_000  # vertices, at most, of which the distance is measured


@dataclass(frozen=True)
class DecimatedMesh:
    """A mesh with fewer triangles, and its distance from the full mesh."""

    mesh: Mesh
    error: float  # distance of the full mesh's vertices from this surface, 99th percentile, in the mesh's unit
    error_px: float  # the same in px of the maps, at the object's median depth


def decimate(mesh: Mesh, view: View, count: int, back: Back) -> DecimatedMesh:
    """Reduce a mesh to about `count` triangles; texture coordinates are computed again from the camera's `view`.

    `back` is the setting with which the mesh was made. In an open mesh, triangles that face away from the camera are
    removed.

    Raises
    ------
    ObjectError
        Too few triangles would be left.
    """
    import fast_simplification  # here: its 0.25 s are for exports with levels of detail alone

    if count < _FEWEST:
        raise ObjectError(f"a mesh of {count} triangles is under {_FEWEST}; ask for more triangles or fewer levels")
    points, faces = fast_simplification.simplify(  # which takes no read-only arrays
        np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32), target_count=count
    )
    vertices = np.asarray(points, dtype=np.float64)
    height, width = mesh.depth.shape
    uv = (project(view, vertices) + 0.5) / [width, height]
    faces = np.asarray(faces, dtype=np.int32)
    if back == "open":
        faces = faces[face_areas(uv, faces) > 0]  # the others were folded over by a collapse
    used, faces = np.unique(faces, return_inverse=True)
    vertices, uv, faces = vertices[used], uv[used], faces.reshape(-1, 3).astype(np.int32)
    normals, tangents = vertex_frames(vertices, uv, faces)
    coarser = replace(
        mesh,
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        faces=faces,
    )
    error = _distance(mesh, coarser)
    return DecimatedMesh(coarser, error, error * view.focal / float(np.nanmedian(mesh.depth)))


def _distance(first: Mesh, coarser: Mesh) -> float:
    """Distance of the full mesh's vertices to the nearest triangle's plane in a coarser mesh: 99th percentile."""
    from scipy.spatial import cKDTree  # here: importing it costs .1 s of every start

    corner = coarser.vertices[coarser.faces].astype(np.float64)  # (F, 3, 3)
    share = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [0, 1, 1], [1, 0, 1], [1, 1, 0]], float)
    sample = np.einsum("sk,fkc->fsc", share / share.sum(axis=1, keepdims=True), corner)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    every = max(1, len(first.vertices) // _MEASURED)
    vertex: Floats = first.vertices[::every].astype(np.float64)
    _, nearest = cKDTree(sample.reshape(-1, 3)).query(vertex)
    distance = np.abs(np.sum((vertex - sample.reshape(-1, 3)[nearest]) * normal[nearest // len(share)], axis=-1))
    return float(np.percentile(distance, 99))
