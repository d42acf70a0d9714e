"""Closed meshes: from signed distances, checked, decimated, and made manifold."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polcap.errors import ObjectError
from polcap.fusion.hull import DistanceGrid
from polcap.fusion.values import ClosedMesh

FEWEST = 16  # triangles of a level of detail
_SEPARATION = 1e-3  # share of the way to their neighbors' middle by which coincident vertices are moved


def iso_surface(of: DistanceGrid) -> ClosedMesh:
    """Mesh of the surface at distance 0."""
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(of.distance, 0.0, spacing=(of.grid.step,) * 3, gradient_direction="descent")
    return ClosedMesh(vertices + of.grid.origin, faces.astype(np.int32))


def is_closed(mesh: ClosedMesh) -> bool:
    """Whether each edge belongs to two triangles that run along it in opposite directions."""
    faces, count = mesh.faces.astype(np.int64), len(mesh.vertices)
    first, last = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    there, back = np.sort(first * count + last), np.sort(last * count + first)  # one number for each directed edge
    return bool(np.array_equal(there, back) and np.all(np.diff(there) > 0))


def solid(mesh: ClosedMesh, floor: float | None = None) -> ClosedMesh:
    """The largest body of a mesh, cut off below the height `floor` [m]; manifold, with outward faces, by manifold3d.

    Raises ObjectError: the mesh is not the border of a body.
    """
    import manifold3d

    raw = manifold3d.Mesh64(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64))
    raw.merge()
    body = manifold3d.Manifold(raw)
    if body.status() != manifold3d.Error.NoError or body.is_empty():
        remedy = "check poses and masks of the views; for a flat sample use `polcap material`"
        raise ObjectError(f"the fused mesh is not closed ({body.status().name}); {remedy}")
    if floor is not None:
        body = body.trim_by_plane((0.0, 1.0, 0.0), floor)
    written = max(body.decompose(), key=lambda part: part.volume()).to_mesh64()
    return _separate(ClosedMesh(np.array(written.vert_properties[:, :3]), np.array(written.tri_verts, np.int32)))


def _separate(mesh: ClosedMesh) -> ClosedMesh:
    """The mesh with coincident vertices moved a little towards their neighbors, so that programs do not merge them."""
    _, place, count = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True, return_counts=True)
    shared = count[place.reshape(-1)] > 1
    if not shared.any():
        return mesh
    middle = neighbor_means(mesh.faces, len(mesh.vertices)) @ mesh.vertices
    vertices = np.where(shared[:, None], mesh.vertices + _SEPARATION * (middle - mesh.vertices), mesh.vertices)
    return ClosedMesh(vertices, mesh.faces)


def decimate(mesh: ClosedMesh, count: int) -> ClosedMesh:
    """The mesh with about `count` triangles, closed and manifold.

    Raises ObjectError: these are too few triangles to enclose a body.
    """
    import fast_simplification

    if count < FEWEST:
        raise ObjectError(f"a level of {count} triangles is under {FEWEST}; ask for more triangles or fewer levels")
    if count >= len(mesh.faces):
        return mesh
    points, faces = fast_simplification.simplify(
        np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32), target_count=count
    )
    return solid(ClosedMesh(np.asarray(points, np.float64), np.asarray(faces, np.int32)))


def neighbor_means(faces: NDArray[np.int32], count: int) -> sparse.csr_matrix:
    """Matrix (V, V) that replaces values at vertices by the mean of their neighbors'."""
    i, j = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    joined = sparse.coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(count, count)).tocsr()
    return sparse.csr_matrix(sparse.diags(1 / np.asarray(joined.sum(axis=1)).ravel()) @ joined)
