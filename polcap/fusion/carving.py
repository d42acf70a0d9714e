"""Hollows that no silhouette shows: depths by a plane sweep, carved out of the hull.

Where views contradict each other on the surface inside the hull, each view searches along its rays for the depth at
which other views measured the same world normal and the same albedo. Neither depends on the direction of view, as the
flash photographs do. The space in front of these depths is carved.

References
----------
Collins, A space-sweep approach to true multi-image matching, CVPR 1996. Curless & Levoy, A volumetric method for
building complex models from range images, SIGGRAPH 1996 (mean of truncated signed distances).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from polcap import parallel
from polcap.fusion.closed_mesh import iso_surface
from polcap.fusion.hull import DistanceGrid, plain_body
from polcap.fusion.normal_surface import FittedSurface, tracer, visible
from polcap.fusion.small_views import SmallView, sample
from polcap.image_values import Bools, Floats
from polcap.optics.frames import dot, unit
from polcap.optics.mesh_tracer import Tracer
from polcap.optics.projection import back_project
from polcap.optics.vertex_frames import vertex_normals

_DOUBT = 0.4  # share of the views' weight against the mean normal; all numbers: docs/benchmarks/fusion-choices.md
_PASSES = 6  # of averaging over neighbors
_LEAST_PART = 0.01  # of all vertices; smaller doubtful parts of the surface are no hollows
_PLANES = 1.5  # steps between the sweep's planes
_NORMAL_DEG = 15.0  # 1σ of the angle between two views' normals of one point
_ALBEDO = 0.12  # 1σ of the relative difference of two views' albedos
_FACING = 0.2  # least cosine at which another view can have measured a normal
_AGREEING = 3  # views, of which the mean agreement is the score of a depth
_WINDOW = 5  # px of the sweep over which scores are averaged
_LEAST_SCORE = 0.45  # of a depth
_SUPPORT = 3.0  # steps; a depth of another view confirms a depth within this distance
_TRUNCATION = 2.5  # steps; larger distances from a view's surface count as this one
_SOLID = 0.1  # weight of a vote for solid at every point, so that points without depths stay
_SMOOTHING = 1.0  # steps, 1σ of the Gaussian over the mean distances
_WALL = 1.5  # steps, thickness that stays behind a wall: surface behind which no view has a depth
_OPEN = 0.2  # largest share, around a vertex of a wall, of vertices behind which views have a depth


@dataclass(frozen=True)
class HollowDepths:
    """Depths of one view inside the hull."""

    view: SmallView  # on the grid of the sweep
    depth: Floats  # (H, W) m along the optical axis; NaN where none is known


def carve(hull: DistanceGrid, surface: FittedSurface, views: Sequence[SmallView]) -> DistanceGrid:
    """Signed distances of the hull less its hollows; the hull itself where views agree on the surface."""
    doubtful = _find_doubtful(surface)
    if not doubtful.any():
        return hull
    step, trace = hull.grid.step, tracer(surface.mesh)
    sweeps = [partial(_sweep, k, views, trace, doubtful, hull) for k in range(len(views))]
    depths = _confirm(parallel.results(sweeps), step)
    free = _mean_distance(hull, depths)
    wall = _find_walls(surface, depths, step)
    inner = iso_surface(hull).vertices[wall]  # where masks are too narrow, the fitted surface lies outside the hull
    walls = np.concatenate([surface.mesh.vertices[wall], inner])
    carved = np.maximum(hull.distance, _limit_at_walls(hull, walls, free))
    height = hull.grid.origin[1] + step * np.arange(hull.grid.shape[1])
    floor = height < _WALL * step  # the board is behind it
    carved[:, floor] = hull.distance[:, floor]
    return replace(hull, distance=plain_body(carved, step))


def _find_doubtful(surface: FittedSurface) -> Bools:
    """Vertices (V,) of large parts of the surface on which views contradict each other."""
    doubtful = surface.smooth(1 - surface.agreement, _PASSES) > _DOUBT
    index = np.flatnonzero(doubtful)
    _, part = connected_components(surface.neighbors[index][:, index], directed=False)
    large = np.bincount(part, minlength=1) >= _LEAST_PART * len(doubtful)
    doubtful[index] = large[part]
    return np.asarray(doubtful)


def _sweep(number: int, views: Sequence[SmallView], trace: Tracer, doubtful: Bools, hull: DistanceGrid) -> HollowDepths:
    """Best depth of each pixel of one view behind doubtful vertices (V,) of the traced surface."""
    step = hull.grid.step
    view = _coarsen(views[number], step)
    height, width = view.outline.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    ray = back_project(view.camera, x, y) @ view.pose.rotation  # (H, W, 3) world, at depth 1
    met = trace.meet(np.broadcast_to(view.pose.center, (height * width, 3)), ray.reshape(-1, 3))
    searched = np.zeros(height * width, bool)
    searched[met.index] = doubtful[trace.mesh.faces[met.face]].mean(axis=1) > 0.5  # two corners or three
    pixel = np.flatnonzero(searched)
    corner_depths = -view.pose.to_camera(hull.grid.corners())[:, 2]
    planes = np.arange(corner_depths.min(), corner_depths.max(), _PLANES * step)
    score = np.zeros((len(planes), height, width), np.float32)
    for layer, depth in zip(score.reshape(len(planes), -1), planes):
        point = view.pose.center + depth * ray.reshape(-1, 3)[pixel]
        inside = hull.at(point) < 0
        layer[pixel[inside]] = _agreement(point[inside], pixel[inside], view, [*views[:number], *views[number + 1 :]])
    share = np.maximum(cv2.blur(searched.reshape(height, width).astype(np.float32), (_WINDOW, _WINDOW)), 1e-6)
    score = np.stack([cv2.blur(layer, (_WINDOW, _WINDOW)) / share for layer in score])
    good = searched.reshape(height, width) & (score.max(axis=0) > _LEAST_SCORE)
    return HollowDepths(view, np.where(good, planes[score.argmax(axis=0)], np.nan))


def _agreement(point: Floats, pixel: NDArray[np.intp], view: SmallView, others: Sequence[SmallView]) -> Floats:
    """Agreement, 0…1, of other views with pixels (N,) of a view at world points (N, 3)."""
    normal, albedo = view.normal.reshape(-1, 3)[pixel], view.diffuse.reshape(-1, 3)[pixel]
    found = np.zeros((len(others), len(point)), np.float32)
    for row, other in zip(found, others):
        facing = np.flatnonzero(dot(normal, other.towards(point)) > _FACING)
        at, own_albedo = other.pixels(point[facing]), albedo[facing]
        squared_angle = 2 - 2 * dot(unit(sample(other.normal, at)), normal[facing])  # rad², by the chord
        seen = sample(other.diffuse, at)
        mean = np.maximum((seen + own_albedo).sum(axis=-1) / 2, 1e-6)
        relative = np.abs(seen - own_albedo).sum(axis=-1) / mean
        row[facing] = np.exp(-squared_angle / (2 * np.radians(_NORMAL_DEG) ** 2) - relative**2 / (2 * _ALBEDO**2))
    return np.asarray(np.sort(found, axis=0)[-_AGREEING:].mean(axis=0))


def _coarsen(of: SmallView, step: float) -> SmallView:
    """The view with every n-th pixel of its normals and albedo, about one to a grid step [m].

    `outline` gives the size only: its values stay px of the fine grid, and slope and certainty stay on that grid.
    """
    distance = float(np.linalg.norm(of.pose.translation))  # m, of the lens from the board's middle
    every = max(1, round(step * of.camera.focal / distance))
    x, y = of.camera.center
    camera = replace(of.camera, focal=of.camera.focal / every, center=(x / every, y / every))
    normal, diffuse = (np.ascontiguousarray(image[::every, ::every]) for image in (of.normal, of.diffuse))
    return replace(of, camera=camera, outline=of.outline[::every, ::every], normal=normal, diffuse=diffuse)


def _confirm(depths: Sequence[HollowDepths], step: float) -> list[HollowDepths]:
    """The depths that a depth of at least one other view confirms."""
    confirmed = []
    for one in depths:
        rows, columns = np.nonzero(np.isfinite(one.depth))
        ray = back_project(one.view.camera, columns.astype(float), rows.astype(float)) @ one.view.pose.rotation
        point = one.view.pose.center + one.depth[rows, columns, None] * ray
        others = [other for other in depths if other is not one]
        supported = np.any([np.abs(_depth_beyond(other, point)) < _SUPPORT * step for other in others], axis=0)
        depth = one.depth.copy()
        depth[rows[~supported], columns[~supported]] = np.nan
        confirmed.append(replace(one, depth=depth))
    return confirmed


def _depth_beyond(of: HollowDepths, point: Floats) -> Floats:
    """Depth of the view's surface less that of world points (N, 3), m; NaN where it is unknown."""
    pixel = np.round(of.view.pixels(point)).astype(int)
    height, width = of.depth.shape
    inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=-1)
    x, y = np.where(inside[:, None], pixel, 0).T
    own = -(point @ of.view.pose.rotation[2] + of.view.pose.translation[2])
    return np.where(inside, of.depth[y, x] - own, np.nan)


def _mean_distance(hull: DistanceGrid, depths: Sequence[HollowDepths]) -> Floats:
    """Mean of the truncated distances in front of the views' depths, positive in free space, smoothed."""
    index = np.argwhere(hull.distance < 0)
    point = hull.grid.origin + hull.grid.step * index
    reach = _TRUNCATION * hull.grid.step
    total, weight = np.zeros(len(point)), np.zeros(len(point))
    for one in depths:
        beyond = _depth_beyond(one, point)
        known = beyond > -reach  # farther behind the surface, a view sees nothing
        total[known] += np.minimum(beyond[known], reach)
        weight[known] += 1
    sums, counts = (np.zeros(hull.distance.shape, np.float32) for _ in range(2))
    sums[tuple(index.T)], counts[tuple(index.T)] = total - _SOLID * reach, weight + _SOLID
    sums, counts = (ndimage.gaussian_filter(value, _SMOOTHING) for value in (sums, counts))
    return np.asarray(sums / np.maximum(counts, 1e-6))


def _find_walls(surface: FittedSurface, depths: Sequence[HollowDepths], step: float) -> Bools:
    """Vertices (V,) of walls: few vertices around are seen by a view that has a depth behind them."""
    mesh = surface.mesh
    seen = visible(mesh, vertex_normals(mesh.vertices, mesh.faces), [one.view for one in depths], step)
    beyond = np.stack([_depth_beyond(one, mesh.vertices) > _TRUNCATION * step for one in depths])
    return np.asarray(surface.smooth(np.any(seen & beyond, axis=0).astype(float), _PASSES) < _OPEN)


def _limit_at_walls(hull: DistanceGrid, walls: Floats, free: Floats) -> Floats:
    """Free distances, limited so that _WALL steps stay behind wall vertices (N, 3)."""
    index = np.argwhere(free > -hull.grid.step)
    point = hull.grid.origin + hull.grid.step * index
    distance, _ = cKDTree(walls).query(point, distance_upper_bound=4 * _WALL * hull.grid.step)
    limited = free.copy()
    limited[tuple(index.T)] = np.minimum(free[tuple(index.T)], distance - _WALL * hull.grid.step)
    return limited
