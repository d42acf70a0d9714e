"""Surface that has the measured normals and touches the silhouettes. The fit begins with the surface of the hull.

It may leave the hull, which is too small wherever a single mask is too narrow.

Each round moves every vertex along its normal, by sparse least squares: the edges of each triangle lie square to the
mean of the normals that the views measured there, and rims stay on their silhouettes. Then the surface is smoothed
where it contradicts these normals, where views contradict each other, and where no view sees it.

References
----------
Nehab et al., Efficiently combining positions and normals for precise 3D geometry, SIGGRAPH 2005 (edges square to
measured normals).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from polcap.fusion.closed_mesh import neighbor_means
from polcap.fusion.hull import DistanceGrid
from polcap.fusion.small_views import SmallView, sample
from polcap.fusion.values import ClosedMesh
from polcap.image_values import Bools, Floats
from polcap.optics.frames import dot, unit
from polcap.optics.mesh_tracer import Tracer, Triangles
from polcap.optics.vertex_frames import area_vectors, vertex_normals

# the numbers: docs/benchmarks/fusion-choices.md; steps are those of the hull's grid
_LIFT = 0.3  # steps off the surface, where rays towards the lenses start
_FACING = 0.1  # least cosine between a vertex's normal and the direction to a lens that sees it
_CAUCHY = np.radians(12.0)  # rad; a view that differs by as much from the mean counts half
_RIM_DEPTH = 3.0  # steps inside the silhouette where rims are searched
_RIM_LAYER = 0.5  # steps; the rim is a vertex of the outermost layer of this thickness
_RIM_SIGMA = np.radians(6.0)  # 1σ of the angle between a rim's mean normal and the silhouette's; weights fall with it
_RIM_LIMIT = 3.0  # σ; vertices beyond are no rims
_HOLLOW_WEIGHT = 0.5  # of the equation that holds a carved vertex at its place
_HOLLOW_DEPTH = 2.0  # steps; vertices at least as far inside the hull were carved
_FACET_POWER = 4  # of the cosine between a mesh's normal and the measured one, in the weight of the measured one
_MOST_MOVE = 1.0  # steps that a vertex may move in a round; more would fold the surface
_DAMPING = 0.02  # weight of the equations displacement = 0
_SMOOTHNESS = 0.03  # weight of the equations displacement = displacement of the neighbor
_PASSES = 5  # of smoothing in a round
_RELAXATION = 0.5  # share of the way to the neighbors' middle, along the surface, where this has the measured normals


@dataclass(frozen=True)
class SurfaceNormals:
    """Mean of the measured normals at each vertex."""

    normal: Floats  # (V, 3) unit, world frame
    weight: Floats  # (V,) 0 where no view sees the vertex … 1 where several views agree
    agreement: Floats  # (V,) share of the views' weight near the mean; 1 where no view sees the vertex


@dataclass(frozen=True)
class Anchors:
    """Vertices with a known place: slope · displacement = distance."""

    vertex: NDArray[np.intp]  # (R,)
    slope: Floats  # (R,) motion towards the place per displacement
    distance: Floats  # (R,) m from the vertex to the place
    weight: Floats  # (R,) of an equation over that of an edge


@dataclass(frozen=True)
class FittedSurface:
    """A closed surface, and the agreement of the views on its normals."""

    mesh: ClosedMesh
    agreement: Floats  # (V,) share of the views' weight near the mean normal
    neighbors: sparse.csr_matrix  # (V, V) mean of the neighbors' values

    def smooth(self, value: Floats, rounds: int) -> Floats:
        """Values (V,), each replaced `rounds` times by the mean of its neighbors'."""
        for _ in range(rounds):
            value = self.neighbors @ value
        return value


def fit_normals(mesh: ClosedMesh, views: Sequence[SmallView], hull: DistanceGrid, rounds: int) -> FittedSurface:
    """Surface with the views' normals, from a mesh of the hull or of the carved hull; same triangles.

    Rims hold the surface at the silhouettes. Hollows have none, so they are held where they were carved. `rounds`
    is at least 1.
    """
    step = hull.grid.step
    start: Floats = mesh.vertices.astype(np.float64)
    hollow = np.flatnonzero(hull.at(start) < -_HOLLOW_DEPTH * step)
    neighbors = neighbor_means(mesh.faces, len(start))
    mesh = ClosedMesh(start, mesh.faces)
    for _ in range(rounds):
        outward = vertex_normals(mesh.vertices, mesh.faces)
        target = _mean_normals(mesh.vertices, outward, visible(mesh, outward, views, step), views)
        rims = _find_rims(mesh.vertices, outward, target, views, step)
        sunk = dot(outward[hollow], start[hollow] - mesh.vertices[hollow])
        carved = Anchors(hollow, np.ones(len(hollow)), sunk, np.full(len(hollow), _HOLLOW_WEIGHT))
        move = _displacements(mesh, outward, target, [rims, carved])
        move = np.clip(move, -_MOST_MOVE * step, _MOST_MOVE * step)
        moved = _smooth(mesh.vertices + outward * move[:, None], mesh.faces, neighbors, target)
        mesh = ClosedMesh(moved, mesh.faces)
    return FittedSurface(mesh, target.agreement, neighbors)


def visible(mesh: ClosedMesh, outward: Floats, views: Sequence[SmallView], step: float) -> Bools:
    """Visibility (N, V) of a mesh's vertices in N views: a vertex faces the lens, and the mesh does not hide it.

    `outward` (V, 3) are the normals; `step` [m] is that of the grid of which the mesh was made.
    """
    trace = tracer(mesh)
    start = mesh.vertices + outward * (_LIFT * step)
    seen = np.zeros((len(views), len(start)), bool)
    for row, view in zip(seen, views):
        facing = np.flatnonzero(dot(outward, view.towards(mesh.vertices)) > _FACING)
        row[facing] = ~trace.hidden(start[facing], view.pose.center)
    return seen


def tracer(mesh: ClosedMesh) -> Tracer:
    """The mesh prepared for ray tracing, without shading normals."""
    normals = np.zeros((len(mesh.faces), 3, 3), np.float32)
    return Tracer(Triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), normals))


def _mean_normals(vertices: Floats, outward: Floats, seen: Bools, views: Sequence[SmallView]) -> SurfaceNormals:
    """Robust mean of the views' normals at each vertex, by expected error and by cosine to the ray.

    It begins at the normal with the least Cauchy loss against all views, so that a wrong half-turn is outvoted.
    """
    n = np.zeros((len(views), len(vertices), 3), np.float32)
    w = np.zeros((len(views), len(vertices)), np.float32)
    for normal, weight, view, row in zip(n, w, views, seen):
        pixel = view.pixels(vertices)
        measured = unit(sample(view.normal, pixel))
        normal[:] = measured
        weight[:] = row * np.maximum(dot(measured, view.towards(vertices)), 0) * sample(view.certainty, pixel)
    loss = [np.sum(w * np.log1p(_angle2(n, one) / _CAUCHY**2), axis=0) for one in n]
    best = np.argmin(np.where(w > 0, loss, np.inf), axis=0)
    mean = n[best, np.arange(len(vertices))]
    for _ in range(3):  # rounds of reweighting
        robust = w / (1 + _angle2(n, mean) / _CAUCHY**2)
        mean = unit(np.sum(robust[..., None] * n, axis=0))
    agreeing, total = np.sum(robust, axis=0), np.sum(w, axis=0)
    count = agreeing / np.maximum(w.max(axis=0), 1e-12)  # of agreeing views, in units of the view that weighs most
    agreement = np.where(total > 0, agreeing / np.maximum(total, 1e-12), 1.0)
    return SurfaceNormals(np.where(count[:, None] > 0, mean, outward), count / (1 + count), agreement)


def _angle2(a: Floats, b: Floats) -> Floats:
    """Squared angle between unit vectors [rad²], by the chord: 1.5 % low at 30°."""
    return np.asarray(2 - 2 * dot(a, b))


def _find_rims(
    vertices: Floats, outward: Floats, target: SurfaceNormals, views: Sequence[SmallView], step: float
) -> Anchors:
    """One vertex for each piece of each silhouette, a step long, with its way to the silhouette.

    Of the outermost vertices at the piece, the vertex is chosen whose mean normal is nearest to the silhouette's. If
    all were held, the surface would stay on the hull: each vertex of the hull touches the cone of some silhouette.
    """
    found = []
    for view in views:
        distance = view.distance(vertices)
        near = np.flatnonzero((distance > -_RIM_DEPTH * step) & (target.weight > 0))
        pixel, rim_normal = view.nearest_rim(vertices[near])
        side = step * view.camera.focal / np.linalg.norm(view.pose.center - vertices.mean(axis=0))
        piece = np.unique(np.round(pixel / side), axis=0, return_inverse=True)[1].ravel()
        outermost = np.full(piece.max(initial=0) + 1, -np.inf)
        np.maximum.at(outermost, piece, distance[near])
        squared = _angle2(target.normal[near], rim_normal) / _RIM_SIGMA**2  # σ²
        squared[distance[near] < outermost[piece] - _RIM_LAYER * step] = np.inf  # covered by others
        order = np.lexsort((squared, piece))
        best = order[np.diff(piece[order], prepend=-1) > 0]  # of each piece
        best = best[squared[best] < _RIM_LIMIT**2]
        slope = dot(rim_normal[best], outward[near[best]])
        found.append(np.stack([near[best], slope, -distance[near[best]], np.exp(-squared[best] / 2)]))
    vertex, slope, distance, weight = np.concatenate(found, axis=1)
    return Anchors(vertex.astype(np.intp), slope, distance, weight)


def _displacements(mesh: ClosedMesh, outward: Floats, target: SurfaceNormals, anchors: Sequence[Anchors]) -> Floats:
    """Displacements d (V,) m of the vertices along `outward` (V, 3) by which triangles get their measured normals.

    Weighted least squares of three kinds of equations, in normal form. An edge from i to j is to lie square to the
    measured normal t of its triangle: t·(x_j + d_j n_j − x_i − d_i n_i) = 0, with the outward normals n. An anchored
    vertex is to reach its place: slope · d_i = distance. Neighbors move alike, and little: d_i = d_j, d_i = 0.
    """
    vertices, faces, count = mesh.vertices, mesh.faces, len(mesh.vertices)
    measured = unit(np.sum((target.normal * target.weight[:, None])[faces], axis=1))  # (F, 3)
    facing = np.maximum(dot(measured, unit(area_vectors(vertices, faces))), 0)
    weight = target.weight[faces].mean(axis=1) * facing**_FACET_POWER
    i, j = (np.concatenate([faces[:, (k + first) % 3] for k in range(3)]) for first in (0, 1))
    t, w2 = np.tile(measured, (3, 1)), np.tile(weight**2, 3)
    a_i, a_j = dot(t, outward[i]), dot(t, outward[j])
    b = -dot(t, vertices[j] - vertices[i])
    diagonal = np.full(count, _DAMPING**2)
    smooth2 = _SMOOTHNESS**2
    diagonal += np.bincount(i, w2 * a_i**2 + smooth2, count) + np.bincount(j, w2 * a_j**2 + smooth2, count)
    right = np.bincount(j, w2 * a_j * b, count) - np.bincount(i, w2 * a_i * b, count)
    for held in anchors:
        diagonal += np.bincount(held.vertex, held.weight**2 * held.slope**2, count)
        right += np.bincount(held.vertex, held.weight**2 * held.slope * held.distance, count)
    coupling = sparse.coo_matrix((-w2 * a_i * a_j - smooth2, (i, j)), shape=(count, count)).tocsr()
    matrix = coupling + coupling.T + sparse.diags(diagonal)
    # a ball on the finest grid (300) needs 160 steps; a solution cut short is a shorter move, the next round goes on
    move, _ = cg(matrix, right, rtol=1e-3, maxiter=200, M=sparse.diags(1 / diagonal))
    return np.asarray(move)


def _smooth(vertices: Floats, faces: NDArray[np.int32], neighbors: sparse.csr_matrix, target: SurfaceNormals) -> Floats:
    """Vertices moved to the middle of their neighbors, but not off a surface that has the measured normals.

    This removes folds, smooths surface that no view sees, and tightens surface of the hull alone, e.g. between fingers.
    """
    for _ in range(_PASSES):
        outward = vertex_normals(vertices, faces)
        trust = np.maximum(dot(outward, target.normal), 0) ** _FACET_POWER * target.agreement * (target.weight > 0)
        step = neighbors @ vertices - vertices
        along = step - outward * dot(step, outward)[:, None]
        vertices = vertices + (1 - trust)[:, None] * step + _RELAXATION * trust[:, None] * along
    return np.asarray(vertices)
