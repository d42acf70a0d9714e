"""Stage 9: integrate normals to depth, and cut the depth map into a mesh.

A pixel (i, j) at distance d along the optical axis sits at d·(a, b, −1), a = (i − cx)/f,
b = −(j − cy)/f. Its normal n is square to the surface, so with z = f ln d and
m = n_z − a n_x − b n_y the slopes obey m ∂z/∂i = n_x and m ∂z/∂j = −n_y: linear in z, and
scaled so that one unit of z is about one pixel of depth.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022: each pixel trusts
whichever of its two neighbours per axis continues its own tangent plane.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy import sparse

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, SurfaceMaps, View
from polcap.stages import stage
from polcap.stages.surface.multigrid import Multigrid, conjugate_gradients

_DIRECT = 60_000  # pixels; larger objects start from their solution at half the resolution
_ANNEAL = 1.15  # growth of the stiffness per iteration, from a quarter of it: few early errors are kept as jumps
_OFF_PLANE = 0.5  # sine between an edge and its ends' tangent planes: beyond, a depth step is a jump
_TIRED = 9  # iterations of a linear solution that call for a new multigrid hierarchy
_ACCURACY = 1e-3  # of each linear solution, relative
_PROXIMITY = 1e-8  # pulls towards the last estimate: fixes what the normals leave free (one offset per piece)


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stiffness: Annotated[
        float,
        Meta(ge=0.0, le=20.0, description="how firmly depth jumps are kept; 0 = plain least squares [1]"),
    ] = 2.0
    iterations: Annotated[int, Meta(ge=1, le=200, description="reweightings per pyramid level, at most")] = 40
    tolerance: Annotated[
        float, Meta(ge=1e-8, le=0.1, description="relative change of the energy that ends a level [1]")
    ] = 1e-3
    steepest_deg: Annotated[
        float,
        Meta(ge=45.0, le=89.0, description="normals leaning farther from the camera are capped [degrees]"),
    ] = 84.0
    prior_weight: Annotated[
        float,
        Meta(ge=0.0, le=1.0, description="pull towards the coarse depth; acts over 1/√weight px [1/px²]"),
    ] = 1e-4
    jump_px: Annotated[
        float, Meta(ge=0.5, le=100.0, description="depth step that may cut the mesh [px of this grid]")
    ] = 3.0
    max_vertices: Annotated[
        int,
        Meta(ge=1000, le=10_000_000, description="the mesh is thinned to a regular grid under this count"),
    ] = 250_000


@stage(version=1)
def integrate(maps: SurfaceMaps, distance_m: float | None, settings: Settings) -> Mesh:
    """The visible surface of the object, from its normals.

    `distance_m` is the distance of the object along the optical axis [m], which becomes the median
    depth; without it the median depth is 1.

    Raises
    ------
    ObjectError
        Fewer than 16 pixels in the mask, or not one of them has a neighbour.
    """
    count = int(maps.mask.sum())
    if count < 16:
        raise ObjectError(f"the mask holds {count} pixels, under 16; mark the object with --mask")
    z = _log_depth(_problem(maps, settings), settings)
    depth = np.full(maps.mask.shape, np.nan)
    depth[maps.mask] = np.exp((z - np.median(z)) / maps.view.focal)
    depth *= 1.0 if distance_m is None else distance_m
    return triangulate(depth, maps, distance_m is not None, settings)


@dataclass(frozen=True)
class _Problem:
    """Normals of one pyramid level, on its N pixels."""

    mask: NDArray[np.bool_]  # (H, W)
    view: View
    normal: Floats  # (N, 3)
    weight: Floats  # (N,)
    prior: Floats | None  # (N,) z of the prior
    pull: float  # weight of the prior


def _problem(maps: SurfaceMaps, settings: Settings) -> _Problem:
    normal = np.nan_to_num(maps.normal[maps.mask].astype(np.float64))  # 0 is no normal: neighbours bridge it
    sigma = np.maximum(np.nan_to_num(maps.confidence[maps.mask].astype(np.float64), nan=90.0, posinf=90.0), 1.0)
    prior = None
    if maps.depth_prior is not None and settings.prior_weight > 0:
        radius = np.sqrt(maps.mask.sum() / np.pi) / maps.view.focal  # the prior's unit over the distance
        prior = maps.view.focal * np.log(np.maximum(1 + radius * maps.depth_prior[maps.mask], 0.05))
    return _Problem(
        mask=np.asarray(maps.mask, dtype=bool),
        view=maps.view,
        normal=_capped(normal, maps.mask, maps.view, settings),
        weight=np.clip((np.median(sigma) / sigma) ** 2, 0.02, 50.0),
        prior=None if prior is None else prior.astype(np.float64),
        pull=settings.prior_weight,
    )


def _capped(normal: Floats, mask: NDArray[np.bool_], view: View, settings: Settings) -> Floats:
    """Normals turned towards the camera until they lean no more than `steepest_deg`."""
    x, y = _slopes_of_rays(mask, view)
    ray = np.stack([-x, -y, np.ones_like(x)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    facing = np.sum(normal * ray, axis=-1, keepdims=True)
    across = normal - facing * ray
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    limit = np.radians(settings.steepest_deg)
    capped = np.cos(limit) * ray + np.sin(limit) * across / np.maximum(length, 1e-12)
    return np.asarray(np.where(facing < np.cos(limit) * np.hypot(facing, length), capped, normal))


def _slopes_of_rays(mask: NDArray[np.bool_], view: View) -> tuple[Floats, Floats]:
    """a, b of the object's pixels: (N,) each."""
    row, column = np.nonzero(mask)
    return (column - view.center[0]) / view.focal, -(row - view.center[1]) / view.focal


def _log_depth(problem: _Problem, settings: Settings) -> Floats:
    """z of the object's pixels (N,): solved on half the resolution first, then refined."""
    if len(problem.normal) > _DIRECT:
        start = _finer(_log_depth(_halved(problem), settings), problem)
        return _reweighted(problem, start, settings, soften=1.0)
    return _reweighted(problem, np.zeros(len(problem.normal)), settings, soften=0.25)


def _halved(problem: _Problem) -> _Problem:
    """The same on blocks of 2×2 pixels: weighted means of what lies in the mask."""
    height, width = (size + size % 2 for size in problem.mask.shape)

    def blocks(values: Floats) -> Floats:
        full = np.zeros((height, width, *values.shape[1:]))
        full[: problem.mask.shape[0], : problem.mask.shape[1]][problem.mask] = values
        return np.asarray(full.reshape(height // 2, 2, width // 2, 2, -1).sum(axis=(1, 3)))

    count = blocks(np.ones(len(problem.normal)))[..., 0]
    mask = count > 0
    weight = blocks(problem.weight)[..., 0][mask]
    normal = blocks(problem.normal * problem.weight[:, None])[mask]
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    prior = None if problem.prior is None else blocks(problem.prior)[..., 0][mask] / count[mask] / 2
    x, y = problem.view.center
    view = View(problem.view.focal / 2, ((x - 0.5) / 2, (y - 0.5) / 2), problem.view.scale * 2)
    return _Problem(mask, view, normal, weight / count[mask], prior, 4 * problem.pull)


def _finer(coarse: Floats, problem: _Problem) -> Floats:
    """z of a level from that of half the resolution: each block tilted by its pixels' own slopes."""
    row, column = np.nonzero(problem.mask)
    parent = np.zeros(tuple((size + 1) // 2 for size in problem.mask.shape), dtype=bool)
    parent[row // 2, column // 2] = True
    number = np.cumsum(parent).reshape(parent.shape) - 1
    facing, right, down = _equations(problem)
    steep = np.maximum(facing, 0.1)
    tilt = (column % 2 - 0.5) * right / steep + (row % 2 - 0.5) * down / steep
    return np.asarray(2 * coarse[number[row // 2, column // 2]] + tilt)


def _equations(problem: _Problem) -> tuple[Floats, Floats, Floats]:
    """m, and the right sides of the slopes to the right and down: (N,) each."""
    x, y = _slopes_of_rays(problem.mask, problem.view)
    n = problem.normal
    return n[:, 2] - x * n[:, 0] - y * n[:, 1], n[:, 0], -n[:, 1]


def _reweighted(problem: _Problem, z: Floats, settings: Settings, soften: float) -> Floats:
    """Least squares over each pixel's two one-sided slopes per axis, reweighted until they settle.

    The stiffness starts at `soften` times its value and grows, so that early errors are not kept as jumps.
    """
    facing, right, down = _equations(problem)
    grid = _Grid(problem.mask)
    before, taken = np.inf, _TIRED + 1
    for step in range(settings.iterations):
        stiffness = settings.stiffness * min(1.0, soften * _ANNEAL**step)
        diagonal = np.full(len(z), _PROXIMITY)
        b = _PROXIMITY * z
        if problem.prior is not None:
            diagonal += problem.pull
            b = b + problem.pull * problem.prior
        energy, link = 0.0, []
        for (p, q), slope in ((grid.right, right), (grid.down, down)):
            ahead, behind = np.zeros(len(z)), np.zeros(len(z))  # m ∂z on either side; 0 past the mask
            ahead[p] = facing[p] * (z[q] - z[p])
            behind[q] = facing[q] * (z[q] - z[p])
            share = _sigmoid(stiffness * (behind**2 - ahead**2))
            forward, backward = (problem.weight * share)[p], (problem.weight * (1 - share))[q]
            energy += float(forward @ (ahead - slope)[p] ** 2 + backward @ (behind - slope)[q] ** 2)
            link.append(forward * facing[p] ** 2 + backward * facing[q] ** 2)
            flux = forward * facing[p] * slope[p] + backward * facing[q] * slope[q]
            b = b + np.bincount(q, flux, len(z)) - np.bincount(p, flux, len(z))
        if stiffness == settings.stiffness and abs(before - energy) <= settings.tolerance * energy:
            break
        before = energy
        matrix = grid.laplacian(np.concatenate(link), diagonal)
        if taken > _TIRED:  # until then, an older matrix's multigrid still serves
            multigrid = Multigrid(matrix, grid.pixel)
        z, taken = conjugate_gradients(matrix, b, z, multigrid, _ACCURACY, 30)
    return z


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30.0, 30.0))))


class _Grid:
    """The object's pixels as a graph."""

    def __init__(self, mask: NDArray[np.bool_]) -> None:
        number = np.full(mask.shape, -1, dtype=np.int64)
        number[mask] = np.arange(int(mask.sum()))
        self.pixel = np.stack(np.nonzero(mask), axis=-1)  # (N, 2) row, column
        self.right = self._links(number[:, :-1], number[:, 1:])
        self.down = self._links(number[:-1], number[1:])
        size = len(self.pixel)
        self.p, self.q = (np.concatenate(ends) for ends in zip(self.right, self.down))
        row, column = (np.concatenate([*ends, np.arange(size)]) for ends in ((self.p, self.q), (self.q, self.p)))
        self.pattern = sparse.coo_matrix((np.arange(1.0, len(row) + 1), (row, column)), (size, size)).tocsr()
        self.order = self.pattern.data.astype(np.int64) - 1  # which link or pixel each stored value belongs to

    @staticmethod
    def _links(first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Any, Any]:
        both = (first >= 0) & (second >= 0)
        return first[both], second[both]

    def laplacian(self, link: Floats, diagonal: Floats) -> Any:
        """Matrix (N, N) of the links' weights, right ones first, plus a diagonal (N,)."""
        total = diagonal + np.bincount(self.p, link, len(diagonal)) + np.bincount(self.q, link, len(diagonal))
        values = np.concatenate([-link, -link, total])[self.order]
        return sparse.csr_matrix((values, self.pattern.indices, self.pattern.indptr), self.pattern.shape)


def triangulate(depth: Floats, maps: SurfaceMaps, metric: bool, settings: Settings) -> Mesh:
    """The mesh of a depth map (H, W): for an export from stored maps, without integrating again.

    One vertex per pixel of a regular grid in the mask; triangles where the surface holds together.

    Raises
    ------
    ObjectError
        No triangle fits into the mask.
    """
    height, width = maps.mask.shape
    step = max(1, int(np.ceil(np.sqrt(maps.mask.sum() / settings.max_vertices))))
    rows, columns = np.arange(0, height, step), np.arange(0, width, step)
    column, row = np.meshgrid(columns, rows)
    inside = maps.mask[row, column]
    x, y = maps.view.center
    ray = np.stack([(column - x), -(row - y), np.full(row.shape, -maps.view.focal)], axis=-1) / maps.view.focal
    points = ray * np.where(inside, depth[row, column], 1.0)[..., None]
    grid = _faces(points, np.asarray(maps.normal[row, column], dtype=np.float64), inside, step, maps.view, settings)
    if len(grid) == 0:
        raise ObjectError("the mask holds no two neighbouring rows and columns; mark the object with --mask")
    used, renamed = np.unique(grid, return_inverse=True)
    faces = renamed.reshape(-1, 3).astype(np.int32)
    vertices = points.reshape(-1, 3)[used]
    uv = np.stack([(column + 0.5) / width, (row + 0.5) / height], axis=-1).reshape(-1, 2)[used]
    normals, tangents = _frames(vertices, uv, faces)
    return Mesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        faces=faces,
        depth=depth.astype(np.float32),
        metric=metric,
    )


def _faces(
    points: Floats, normal: Floats, inside: NDArray[np.bool_], step: int, view: View, settings: Settings
) -> NDArray[np.int64]:
    """Vertex numbers (row-major on the grid) of the triangles, counter-clockwise seen from the camera."""
    number = np.arange(inside.size).reshape(inside.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # counter-clockwise
    point, direction, kept = points.reshape(-1, 3), normal.reshape(-1, 3), inside.ravel()
    log = view.focal * np.log(-point[:, 2])
    steepest = max(settings.jump_px, np.sqrt(2) * np.tan(np.radians(settings.steepest_deg)))  # px, on a diagonal

    def holds(p: NDArray[np.int64], q: NDArray[np.int64]) -> NDArray[np.bool_]:
        edge = point[q] - point[p]
        edge = edge / np.maximum(np.linalg.norm(edge, axis=-1, keepdims=True), 1e-30)
        off = np.maximum(*(np.abs(np.sum(direction[end] * edge, axis=-1)) for end in (p, q)))
        climb = np.abs(log[q] - log[p]) / step
        jump = (climb > settings.jump_px) & (off > _OFF_PLANE) | (climb > steepest)
        return np.asarray(kept[p] & kept[q] & ~jump)

    left, bottom, right, top, falling, rising = (
        holds(p, q) for p, q in ((a, b), (b, c), (c, d), (d, a), (a, c), (b, d))
    )
    with_falling = (left & bottom & falling, right & top & falling)
    with_rising = (left & top & rising, bottom & right & rising)
    gain = np.add(*(t.astype(int) for t in with_falling)) - np.add(*(t.astype(int) for t in with_rising))
    flatter = np.abs(log[a] - log[c]) <= np.abs(log[b] - log[d])
    fall = (gain > 0) | ((gain == 0) & flatter)
    triangles = (
        (with_falling[0] & fall, (a, b, c)),
        (with_falling[1] & fall, (a, c, d)),
        (with_rising[0] & ~fall, (a, b, d)),
        (with_rising[1] & ~fall, (b, c, d)),
    )
    return np.concatenate([np.stack([v[chosen] for v in corners], axis=-1) for chosen, corners in triangles])


def _frames(vertices: Floats, uv: Floats, faces: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Unit normals (V, 3) and tangents (V, 4), means over the triangles around, weighted by area.

    A tangent is ∂P/∂u made square to the normal; w = 1 because v runs down the picture while
    the texture's +Y, which glTF's bitangent w (n × t) stands for, runs up.
    """
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    (u1, v1), (u2, v2) = ((uv[faces[:, k]] - uv[faces[:, 0]]).T for k in (1, 2))
    area = np.cross(one, two)
    along = (one * v2[:, None] - two * v1[:, None]) * np.sign(u1 * v2 - u2 * v1)[:, None]

    def gathered(values: Floats) -> Floats:
        corner = faces.ravel()
        sums = [np.bincount(corner, np.repeat(values[:, k], 3), len(vertices)) for k in range(3)]
        return np.stack(sums, axis=-1)

    normals = _unit(gathered(area))
    tangents = gathered(along)
    tangents = _unit(tangents - normals * np.sum(normals * tangents, axis=-1, keepdims=True))
    return normals, np.concatenate([tangents, np.ones((len(vertices), 1))], axis=-1)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-30))
