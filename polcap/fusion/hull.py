"""Visual hull: the largest body that all silhouettes allow, as signed distances on a grid.

References
----------
Laurentini, The visual hull concept for silhouette-based image understanding, IEEE PAMI 1994.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polcap.errors import ObjectError
from polcap.fusion.small_views import SmallView
from polcap.image_values import Bools, Floats

_COARSE = 48  # steps of the grid that finds the object's box
_MARGIN = 3  # steps around the object
_NEAR = 3.5  # steps from the surface within which distances are exact; two points lie at most √3 steps apart
_THIN = 2  # steps; handles and tunnels up to twice as thick count as false
_LARGEST_CUT = 0.002  # of the body's volume; a larger thin part with loops is not a handle, but a wall with holes
_BELOW = 2  # steps below the board, down to which the body may reach; `shape` cuts it at the board
_CHANGED = 0.05  # steps between the surface and points that were added to the body or removed
_LOOSE = 0.01  # steps inside the surface: distance given to points that touch others by an edge alone


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic grid of points origin + step · (i, j, k)."""

    origin: Floats  # (3,) m, world frame
    step: float  # m
    shape: tuple[int, int, int]

    def corners(self) -> Floats:
        """The eight corners (8, 3) m of the grid's box."""
        far = self.origin + self.step * (np.array(self.shape) - 1)
        return np.array(list(product(*zip(self.origin, far))))


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances from a surface, negative inside."""

    grid: VoxelGrid
    distance: Floats  # shape of the grid, m, float32

    def at(self, point: Floats) -> Floats:
        """Distances (N,) m at world points (N, 3), linear; edges repeat."""
        index = (point - self.grid.origin) / self.grid.step
        return np.asarray(ndimage.map_coordinates(self.distance, index.T, order=1, mode="nearest"))


def visual_hull(views: Sequence[SmallView], steps: int) -> DistanceGrid:
    """Signed distance from the visual hull: the largest over the views; one body, without specks and false handles.

    The grid has `steps` along the object's longest side.

    Raises ObjectError: the silhouettes have no point in common.
    """
    grid = _object_grid(views, steps)
    return DistanceGrid(grid, plain_body(_largest_distance(views, grid), grid.step))


def _object_grid(views: Sequence[SmallView], steps: int) -> VoxelGrid:
    """Grid over the object's box, from a coarse hull in the space that the views share."""
    middle, reach = _shared_space(views)
    step = 2 * reach / (_COARSE - 1)
    coarse = VoxelGrid(middle - reach, step, (_COARSE,) * 3)
    inside = np.argwhere(_largest_distance(views, coarse) < step)  # also where the object is thinner than a step
    if not len(inside):
        raise ObjectError("the silhouettes of the views have no point in common; check the poses and the masks")
    low, high = (coarse.origin + step * bound for bound in (inside.min(axis=0), inside.max(axis=0)))
    spacing = float((high - low).max()) / steps
    shape = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * _MARGIN
    return VoxelGrid(low - _MARGIN * spacing, spacing, (int(shape[0]), int(shape[1]), int(shape[2])))


def _shared_space(views: Sequence[SmallView]) -> tuple[Floats, float]:
    """Point (3,) nearest to the rays of all masks' middles, and half the side of a cube around the object, m."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)  # of the normal equations
    for view in views:
        height, width = view.outline.shape
        x, y = ((width - 1) / 2 - view.camera.center[0], view.camera.center[1] - (height - 1) / 2)
        ray = np.array([x, y, -view.camera.focal]) @ view.pose.rotation
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)  # projects onto the plane across the ray
        matrix += across
        right += across @ view.pose.center
    middle = np.linalg.lstsq(matrix, right)[0]
    distance = [np.linalg.norm(middle - view.pose.center) for view in views]
    slope = [np.hypot(*view.outline.shape) / 2 / view.camera.focal for view in views]  # of the picture's corners
    return middle, float(np.max(np.multiply(distance, slope)))


def _largest_distance(views: Sequence[SmallView], grid: VoxelGrid) -> Floats:
    """Largest signed distance over the views, float32; away from the surface, that of every second point."""
    index = np.stack(np.meshgrid(*(np.arange(0, side, 2) for side in grid.shape), indexing="ij"), axis=-1)
    distance = _distance_at(views, grid, index.reshape(-1, 3)).reshape(index.shape[:3])
    for axis, side in enumerate(grid.shape):
        distance = distance.repeat(2, axis=axis).take(range(side), axis=axis)
    near = np.argwhere(np.abs(distance) < _NEAR * grid.step)
    distance[tuple(near.T)] = _distance_at(views, grid, near)
    return distance


def _distance_at(views: Sequence[SmallView], grid: VoxelGrid, index: NDArray[np.integer]) -> Floats:
    """Largest signed distance (N,) m at the grid's points with indices (N, 3), from the silhouettes and the board."""
    point = (grid.origin + grid.step * index).astype(np.float32)
    distance = np.float32(-_BELOW * grid.step) - point[:, 1]  # views from above do not bound the object from below
    for view in views:
        np.maximum(distance, view.distance(point), out=distance)
    return distance


def plain_body(distance: Floats, step: float) -> Floats:
    """Signed distances of the largest body, without specks, enclosed holes, and false handles and tunnels."""
    body = ndimage.binary_fill_holes(_largest_part(distance < 0))
    body = _without_false_loops(body)
    body = ndimage.binary_fill_holes(_largest_part(body))
    least = _CHANGED * step
    changed = np.where(body, np.minimum(distance, -least), np.maximum(distance, least))
    # marching cubes would join two cubes that share an edge alone, which `_euler` counts as separate
    changed[_touches_by_an_edge(body)] = -_LOOSE * step
    return changed.astype(np.float32)


def _touches_by_an_edge(body: Bools) -> Bools:
    """Points of a body whose cubes touch by an edge alone: the two other cubes at this edge are outside."""
    touching = np.zeros_like(body)
    for axes in ((0, 1), (0, 2), (1, 2)):
        corners = list(product(range(2), range(2)))
        two = sum(_corner(body, axes, at).astype(np.int8) for at in corners) == 2
        for i, j in corners:
            alone = two & _corner(body, axes, (i, j)) & _corner(body, axes, (1 - i, 1 - j))
            _corner(touching, axes, (i, j))[alone] = True
    return touching


def _corner(array: Bools, axes: tuple[int, int], at: tuple[int, int]) -> Bools:
    """View of an array: one corner, `at` (0 or 1 along each axis), of all squares of neighboring points in two axes."""
    box = [slice(None)] * 3
    for axis, side in zip(axes, at, strict=True):
        box[axis] = slice(side, array.shape[axis] - 1 + side)
    return array[tuple(box)]


def _largest_part(body: Bools) -> Bools:
    """The largest connected part of a body."""
    label, count = ndimage.label(body)
    return body if count < 2 else np.asarray(label == 1 + np.argmax(np.bincount(label.ravel())[1:]))


def _without_false_loops(body: Bools) -> Bools:
    """Body with its thin tunnels filled and thin handles cut, where that leaves fewer loops."""
    for radius in range(1, _THIN + 1):
        ball = ndimage.iterate_structure(ndimage.generate_binary_structure(3, 1), radius)
        closed = ndimage.binary_closing(np.pad(body, radius + 1), ball)[(np.s_[radius + 1 : -radius - 1],) * 3]
        body = _change_parts(body, closed & ~body, True)
    for radius in range(1, _THIN + 1):  # after all tunnels are filled, so that no wall between two of them is cut
        ball = ndimage.iterate_structure(ndimage.generate_binary_structure(3, 1), radius)
        body = _change_parts(body, body & ~ndimage.binary_opening(body, ball), False)
    return body


def _change_parts(body: Bools, change: Bools, value: bool) -> Bools:
    """Set the parts of `change` to `value` that raise the Euler number and leave one body without enclosed holes."""
    label, _ = ndimage.label(change, np.ones((3, 3, 3)))
    largest = np.inf if value else _LARGEST_CUT * np.count_nonzero(body)
    for number, box in enumerate(ndimage.find_objects(label), 1):
        around = tuple(slice(max(side.start - 2, 0), side.stop + 2) for side in box)
        part = label[around] == number
        after = np.where(part, value, body[around])
        if np.count_nonzero(part) <= largest and _euler(after) > _euler(body[around]):
            changed = body.copy()
            changed[around] = after
            if ndimage.label(changed)[1] == 1 and ndimage.label(np.pad(~changed, 1, constant_values=True))[1] == 1:
                body = changed
    return body


def _euler(body: Bools) -> int:
    """Euler number of a solid of cubes that touch by faces: bodies − tunnels + enclosed holes."""
    from skimage.measure import euler_number

    return int(euler_number(body, connectivity=1))
