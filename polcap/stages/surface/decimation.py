"""Mesh decimation: the same surface with fewer triangles, and its distance from the full mesh.

References
----------
Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997 (fast-simplification).
"""

from dataclasses import dataclass, replace

import numpy as np

from polcap.errors import ObjectError
from polcap.image_values import Faces, Floats, View
from polcap.mesh_values import Mesh, ReliefMesh
from polcap.optics.frames import unit
from polcap.optics.projection import project
from polcap.optics.vertex_frames import vertex_frames
from polcap.stages.surface.triangles import Back, add_back, boundary_edges, face_areas

_FEWEST = 16  # triangles
_FRONT = {"open": 1.0, "skirt": 1.0, "closed": 0.6}  # of the requested triangles: those of the front at first
_LEAST_FRONT = 3  # a back takes no more than the other triangles; a coarse front would lose its shape
_AROUND = {"skirt": 2, "closed": 3}  # triangles of the back, at least, per edge of the boundary
_MEASURED = 20_000  # vertices, at most, of which the distance is measured


@dataclass(frozen=True)
class DecimatedMesh:
    """A mesh with fewer triangles, and its distance from the full mesh."""

    mesh: Mesh
    error: float  # distance of the full mesh's vertices from this surface, 99th percentile, in the mesh's unit
    pixel: float  # side of a map pixel at the object's median depth, in the mesh's unit

    @property
    def error_px(self) -> float:
        """The distance in px of the maps."""
        return self.error / self.pixel


def decimate(front: ReliefMesh, view: View, count: int, back: Back) -> DecimatedMesh:
    """Reduce an open mesh to about `count` triangles, those of a back included.

    Texture coordinates are computed again from the camera's `view`. A back is made from the boundary of the reduced
    front: the walls of a full mesh are slivers, which no collapse removes. Triangles of the front that face away from
    the camera are removed.

    Raises ObjectError: too few triangles would be left.
    """
    if count < _FEWEST:
        raise ObjectError(f"a mesh of {count} triangles is under {_FEWEST}; ask for more triangles or fewer levels")
    reduced = _simplify(front, view, round(_FRONT[back] * count))
    folded = face_areas(reduced.uv, reduced.faces) <= 0  # by a collapse
    reduced = _with_triangles(front, view, reduced.vertices, reduced.faces[~folded])
    if back != "open":
        around = _AROUND[back] * len(boundary_edges(reduced.faces))
        if len(reduced.faces) + around > count:
            reduced = _simplify(reduced, view, max(count - around, count // _LEAST_FRONT))
        reduced = _simplify(add_back(reduced, back), view, count)
    return DecimatedMesh(reduced, _distance(front, reduced), float(np.nanmedian(front.depth)) / view.focal)


def _simplify(mesh: ReliefMesh, view: View, count: int) -> ReliefMesh:
    """Collapse edges until about `count` triangles are left."""
    import fast_simplification  # here: its 0.25 s are for exports with levels of detail alone

    if count >= len(mesh.faces):
        return _with_triangles(mesh, view, mesh.vertices, mesh.faces)
    points, faces = fast_simplification.simplify(  # which takes no read-only arrays
        np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32), target_count=count
    )
    return _with_triangles(mesh, view, np.asarray(points), np.asarray(faces))


def _with_triangles(mesh: ReliefMesh, view: View, vertices: Floats, faces: Faces) -> ReliefMesh:
    """A copy of the mesh with other triangles: computes texture coordinates by the camera's view, normals, tangents."""
    height, width = mesh.depth.shape
    used, renumbered = np.unique(faces, return_inverse=True)
    faces = renumbered.reshape(-1, 3).astype(np.int32)
    vertices = vertices[used].astype(np.float64)
    uv = (project(view, vertices) + 0.5) / [width, height]
    normals, tangents = vertex_frames(vertices, uv, faces)
    return replace(
        mesh,
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        faces=faces,
    )


def _distance(full: ReliefMesh, coarser: ReliefMesh) -> float:
    """Distance of the full mesh's vertices to the nearest triangle's plane in a coarser mesh: 99th percentile."""
    from scipy.spatial import cKDTree  # here: importing it costs .1 s of every start

    corner = coarser.vertices[coarser.faces].astype(np.float64)  # (F, 3, 3)
    barycentric = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [0, 1, 1], [1, 0, 1], [1, 1, 0]], float)
    samples = np.einsum("sk,fkc->fsc", barycentric / barycentric.sum(axis=1, keepdims=True), corner)
    normal = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    every = max(1, len(full.vertices) // _MEASURED)
    vertex: Floats = full.vertices[::every].astype(np.float64)
    _, nearest = cKDTree(samples.reshape(-1, 3)).query(vertex)
    distance = np.abs(np.sum((vertex - samples.reshape(-1, 3)[nearest]) * normal[nearest // len(barycentric)], axis=-1))
    return float(np.percentile(distance, 99))
