"""A depth map -> triangles over its pixels, apart where the surface jumps, with frames for textures."""

import numpy as np
from numpy.typing import NDArray

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, SurfaceMaps
from polcap.optics.frames import cross, dot
from polcap.stages.surface import boundary
from polcap.stages.surface.backing import Back, closed
from polcap.stages.surface.occlusion import Bools, jumps, least_step
from polcap.stages.surface.slope_equations import equations, problem

_FLATTEST = 0.05  # cosine under which a normal tells no slope


def triangulate(
    depth: Floats, maps: SurfaceMaps, metric: bool, steepest: float, jump: float, most: int, back: Back
) -> Mesh:
    """The mesh of a depth map: one vertex per pixel of a regular grid in the mask.

    Parameters
    ----------
    depth
        (H, W), in metres or relative.
    maps
        Mask, view and expected errors of the same crop.
    metric
        Whether the depth is in metres.
    steepest
        Lean at which normals are capped [rad].
    jump
        Least depth step of a jump over the object's radius.
    most
        Vertices, at most; the grid is as wide as that asks for.
    back
        What stands behind the seen side.

    Raises
    ------
    ObjectError
        No triangle fits into the mask.
    """
    height, width = maps.mask.shape
    mask = np.asarray(maps.mask & np.isfinite(depth), dtype=bool)
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / most))))
    column, row = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    z = maps.view.focal * np.log(np.where(mask, depth, 1.0))
    corners = _faces(z, _links_that_hold(z, mask, maps, steepest, jump), step)
    if len(corners) == 0:
        raise ObjectError("the mask holds no two neighbouring rows and columns; mark the object with --mask")
    used, renamed = np.unique(corners, return_inverse=True)
    faces: NDArray[np.int32] = renamed.reshape(-1, 3).astype(np.int32)
    pixel = np.stack([column.ravel()[used], row.ravel()[used]], axis=-1)
    figures = boundary.measure(pixel, faces, mask, step)
    place, log = boundary.smoothed(pixel.astype(np.float64), z[pixel[:, 1], pixel[:, 0]], faces, step)
    x, y = maps.view.center
    ray = np.stack([place[:, 0] - x, y - place[:, 1], np.full(len(place), -maps.view.focal)], axis=-1)
    vertices: Floats = ray / maps.view.focal * np.exp(log / maps.view.focal)[:, None]
    uv: Floats = (place + 0.5) / [width, height]
    normals, tangents = frames(vertices, uv, faces)
    if back != "open":
        vertices, normals, uv, tangents, faces = closed(vertices, normals, uv, tangents, faces, back)
    return Mesh(
        vertices=on_grid(vertices).astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        faces=faces.astype(np.int32),
        depth=np.where(mask, depth, np.nan).astype(np.float32),
        metric=metric,
        pieces=figures.pieces,
        cuts=figures.cuts,
        cut_px=figures.cut_px,
        raggedness=figures.raggedness,
    )


def on_grid(vertices: Floats) -> Floats:
    """Vertices (V, 3) to 2⁻²³ of the greatest coordinate, so that float32 holds them exactly from their middle, too."""
    grid = 2.0 ** (np.ceil(np.log2(np.abs(vertices).max())) - 23)
    return np.asarray(np.rint(vertices / grid) * grid)


def _links_that_hold(z: Floats, mask: Bools, maps: SurfaceMaps, steepest: float, jump: float) -> tuple[Bools, Bools]:
    """Links to the right and down with both ends on one sheet."""
    of = problem(maps, steepest, 0.0)
    facing, *sides = equations(of)
    slopes = []
    for side in sides:
        slope = np.zeros(mask.shape)
        slope[of.mask] = side / np.maximum(facing, _FLATTEST)
        slopes.append(slope)
    found = jumps(z, (slopes[0], slopes[1]), mask, least_step(mask, jump))
    return mask[:, :-1] & mask[:, 1:] & ~found.right, mask[:-1] & mask[1:] & ~found.down


def _faces(z: Floats, holds: tuple[Bools, Bools], step: int) -> NDArray[np.int64]:
    """Vertex numbers (row-major on the grid of every `step` px) of the triangles, counter-clockwise from the camera."""
    across, along = _whole(holds[0], step, 1)[::step], _whole(holds[1], step, 0)[:, ::step]
    height = z[::step, ::step]
    number = np.arange(height.size).reshape(height.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # counter-clockwise
    left, right, top, bottom = along[:, :-1], along[:, 1:], across[:-1], across[1:]
    with_falling = (left & bottom, right & top)  # the diagonal a–c
    with_rising = (left & top, bottom & right)
    gain = np.add(*(t.astype(int) for t in with_falling)) - np.add(*(t.astype(int) for t in with_rising))
    flatter = np.abs(height[:-1, :-1] - height[1:, 1:]) <= np.abs(height[1:, :-1] - height[:-1, 1:])
    fall = (gain > 0) | ((gain == 0) & flatter)
    triangles = (
        (with_falling[0] & fall, (a, b, c)),
        (with_falling[1] & fall, (a, c, d)),
        (with_rising[0] & ~fall, (a, b, d)),
        (with_rising[1] & ~fall, (b, c, d)),
    )
    return np.concatenate([np.stack([v[chosen] for v in corners], axis=-1) for chosen, corners in triangles])


def _whole(holds: Bools, step: int, axis: int) -> Bools:
    """Which runs of `step` links, between the grid's lines, hold all along."""
    if step == 1:
        return holds
    whole = holds.shape[axis] // step * step
    runs = np.moveaxis(holds, axis, -1)[..., :whole]
    together = np.asarray(runs.reshape(*runs.shape[:-1], -1, step).all(axis=-1))
    return np.moveaxis(together, -1, axis)


def frames(vertices: Floats, uv: Floats, faces: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Unit normals (V, 3) and tangents (V, 4), means over the triangles around, weighted by area.

    A tangent is ∂P/∂u made square to the normal; w = 1 because v runs down the picture while
    the texture's +Y, which glTF's bitangent w (n × t) stands for, runs up.
    """
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    (u1, v1), (u2, v2) = ((uv[faces[:, k]] - uv[faces[:, 0]]).T for k in (1, 2))
    area = cross(one, two)
    along = (one * v2[:, None] - two * v1[:, None]) * np.sign(u1 * v2 - u2 * v1)[:, None]
    normals = _unit(_gathered(area, faces, len(vertices)))
    tangents = _gathered(along, faces, len(vertices))
    tangents = _unit(tangents - normals * dot(normals, tangents)[:, None])
    return normals, np.concatenate([tangents, np.ones((len(vertices), 1))], axis=-1)


def _gathered(values: Floats, faces: NDArray[np.int32], count: int) -> Floats:
    """Sums over the triangles around each vertex, (V, 3) of (F, 3)."""
    corner = faces.ravel()
    return np.stack([np.bincount(corner, np.repeat(values[:, k], 3), count) for k in range(3)], axis=-1)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.maximum(np.sqrt(dot(vector, vector)), 1e-30)[..., None])
