"""Triangle mesh of a depth map: cut at occlusions, smooth along the boundary, with or without a back."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Faces, Floats
from polcap.mesh_values import ReliefMesh
from polcap.optics.morphology import erode
from polcap.stages.surface.multigrid import connected_parts
from polcap.stages.surface.occlusion import depth_steps, least_step
from polcap.stages.surface.slope_equations import LEAST_FACING, NormalField, slope_terms

Back = Literal["open", "skirt", "closed"]

_SPECK = 0.002  # of the mesh's triangles: smaller pieces do not count
_ROUNDS = 4  # of averaging along the boundary; about two grid steps either side
_DEPTH_ROUNDS = 64  # the same for depth, 1σ of six steps: at an edge-on surface, steps of depth are ten times as high
_FARTHEST = 0.75  # grid steps that a vertex may move in the picture
_LEAST_AREA = 0.1  # least area of a triangle after the move, over that before; otherwise its corners do not move
_BEHIND = 0.02  # distance of the back behind the deepest vertex, over the greatest extent


def unbroken_links(z: Floats, field: NormalField, jump: float) -> tuple[Bools, Bools]:
    """Links to the right (H, W−1) and down (H−1, W) inside the mask that cross no occlusion of z (H, W)."""
    mask = field.mask
    facing, *sides = slope_terms(field)
    slope = np.zeros((2, *mask.shape))
    slope[:, mask] = sides / np.maximum(facing, LEAST_FACING)
    found = depth_steps(z, (slope[0], slope[1]), mask, least_step(mask, jump))
    return mask[:, :-1] & mask[:, 1:] & ~found.right, mask[:-1] & mask[1:] & ~found.down


def grid_triangles(z: Floats, links: tuple[Bools, Bools], step: int) -> tuple[NDArray[np.int64], Faces]:
    """Triangulate a depth z (H, W) on a grid of every `step` px: pixels x, y (V, 2) of the vertices, faces (F, 3).

    `links` are those to the right and down that cross no occlusion. Faces are counter-clockwise as the camera sees
    them. A grid square with four unbroken sides is divided along the diagonal with the smaller depth difference. A
    square with two adjacent unbroken sides gives one triangle.
    """
    across, along = _unbroken_runs(links[0], step, 1)[::step], _unbroken_runs(links[1], step, 0)[:, ::step]
    height = z[::step, ::step]
    number = np.arange(height.size).reshape(height.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # counter-clockwise
    left, right, top, bottom = along[:, :-1], along[:, 1:], across[:-1], across[1:]
    with_falling = (left & bottom, right & top)  # the diagonal a–c
    with_rising = (left & top, bottom & right)
    # triangles that the diagonal a–c allows, less those of b–d
    surplus = np.add(*(t.astype(int) for t in with_falling)) - np.add(*(t.astype(int) for t in with_rising))
    flatter = np.abs(height[:-1, :-1] - height[1:, 1:]) <= np.abs(height[1:, :-1] - height[:-1, 1:])
    fall = (surplus > 0) | ((surplus == 0) & flatter)
    triangles = (
        (with_falling[0] & fall, (a, b, c)),
        (with_falling[1] & fall, (a, c, d)),
        (with_rising[0] & ~fall, (a, b, d)),
        (with_rising[1] & ~fall, (b, c, d)),
    )
    corners = np.concatenate([np.stack([v[chosen] for v in of], axis=-1) for chosen, of in triangles])
    used, renumbered = np.unique(corners, return_inverse=True)
    row, column = np.divmod(used, height.shape[1])
    return np.stack([column * step, row * step], axis=-1), renumbered.reshape(-1, 3).astype(np.int32)


def _unbroken_runs(links: Bools, step: int, axis: int) -> Bools:
    """Combine each `step` links along an axis to one grid side: true if none of them crosses an occlusion."""
    if step == 1:
        return links
    end = links.shape[axis] // step * step
    runs = np.moveaxis(links, axis, -1)[..., :end]
    unbroken = np.asarray(runs.reshape(*runs.shape[:-1], -1, step).all(axis=-1))
    return np.moveaxis(unbroken, -1, axis)


@dataclass(frozen=True)
class BoundaryFigures:
    """Measures of how torn a mesh is: pieces, cuts and raggedness of its boundary."""

    pieces: int  # without specks
    cuts: float  # length of the boundary inside the mask, both sides, over that along its outline
    cut_px: float  # length of the cuts inside the mask, one side [px]
    raggedness: float  # length of the boundary over that of itself smoothed, less 1


def measure_boundary(place: NDArray[np.int64], faces: Faces, mask: Bools, step: int) -> BoundaryFigures:
    """Measure how torn a mesh is, before smoothing: its pieces, the cuts inside the mask, the ragged boundary.

    `place` (V, 2) are the vertices' pixels x, y in the mask; `step` is their distance in px.
    """
    edge = boundary_edges(faces)
    inner = erode(mask, 2 * step, from_border=True)
    inside = inner[place[:, 1], place[:, 0]][edge].any(axis=1)
    position = place.astype(np.float64)
    length = np.linalg.norm(position[edge[:, 0]] - position[edge[:, 1]], axis=-1)
    smooth = _average_along(position, edge, 3 * _ROUNDS)
    shorter = np.linalg.norm(smooth[edge[:, 0]] - smooth[edge[:, 1]], axis=-1).sum()
    return BoundaryFigures(
        pieces=_count_pieces(faces, len(place)),
        cuts=float(length[inside].sum() / max(length[~inside].sum(), 1e-9)),
        cut_px=float(length[inside].sum() / 2),
        raggedness=float(length.sum() / max(shorter, 1e-9) - 1),
    )


def _count_pieces(faces: Faces, count: int) -> int:
    """Number of connected pieces of a mesh, without specks."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    piece = connected_parts(edges[:, 0], edges[:, 1], count)
    share = np.bincount(piece[faces[:, 0]]) / len(faces)
    return int((share > _SPECK).sum())


def smooth_boundary(place: Floats, z: Floats, faces: Faces, step: int) -> tuple[Floats, Floats]:
    """Smooth the stairs of pixels along the mesh's boundary: vertices x, y (V, 2) px, and scaled log depth z (V,).

    Depth is smoothed more strongly. Returns the new positions and depths.
    """
    edge = boundary_edges(faces)
    move = _average_along(place, edge, _ROUNDS) - place
    distance = np.linalg.norm(move, axis=-1, keepdims=True)
    after = place + move * np.minimum(1, _FARTHEST * step / np.maximum(distance, 1e-9))
    area_before, area_after = face_areas(place, faces), face_areas(after, faces)
    for _ in range(3):  # a triangle that would turn over keeps its corners; then a neighbor may turn over
        bad = np.unique(faces[area_after < _LEAST_AREA * area_before])
        if not len(bad):
            break
        after = after.copy()
        after[bad] = place[bad]
        area_after = face_areas(after, faces)
    return after, _average_along(z[:, None], edge, _DEPTH_ROUNDS)[:, 0]


def boundary_edges(faces: Faces) -> NDArray[np.int64]:
    """Boundary edges (B, 2) of a mesh: those of one triangle only, in the direction of that triangle."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    _, edge, count = np.unique(low * (int(faces.max()) + 1) + high, return_inverse=True, return_counts=True)
    return np.asarray(ends[count[edge] == 1])


def _average_along(values: Floats, edge: NDArray[np.int64], rounds: int) -> Floats:
    """Smooth values (V, C) along the boundary: each round moves a vertex half-way to the mean of its two neighbors.

    Vertices where the boundary touches itself do not move.
    """
    from scipy import sparse  # here: importing it costs .3 s of every start

    ends = np.concatenate([edge, edge[:, ::-1]])
    degree = np.bincount(ends[:, 0], minlength=len(values))
    used = np.flatnonzero(degree)
    number = np.full(len(values), -1)
    number[used] = np.arange(len(used))
    row, column = number[ends[:, 0]], number[ends[:, 1]]
    mean = sparse.csr_matrix((1 / degree[ends[:, 0]], (row, column)), (len(used), len(used)))
    moving = degree[used] == 2
    out = values.copy()
    smooth = values[used]
    for _ in range(rounds):
        smooth = np.where(moving[:, None], (smooth + mean @ smooth) / 2, smooth)
    out[used] = smooth
    return out


def face_areas(place: Floats, faces: Faces) -> Floats:
    """Twice the area (F,) of faces in the picture, y down; positive where counter-clockwise as the camera sees it."""
    one, two = (place[faces[:, k], :2] - place[faces[:, 0], :2] for k in (1, 2))
    return np.asarray(one[:, 1] * two[:, 0] - one[:, 0] * two[:, 1])


def add_back(front: ReliefMesh, back: Back) -> ReliefMesh:
    """Add a back to a mesh: walls straight back to a plane ("skirt"), or walls and that plane ("closed").

    The added vertices repeat the texture of those in front of them; nothing of the back was photographed.
    """
    if back == "open":
        return front
    count, faces = len(front.vertices), front.faces
    behind = front.vertices.copy()
    behind[:, 2] = front.vertices[:, 2].min() - _BEHIND * np.ptp(front.vertices, axis=0).max()
    start, end = boundary_edges(faces).T
    wall = np.concatenate([np.stack([end, start, start + count], -1), np.stack([end, start + count, end + count], -1)])
    added = [wall] if back == "skirt" else [wall, faces[:, ::-1] + count]
    normals = np.broadcast_to([0.0, 0.0, -1.0], front.normals.shape) if back == "closed" else front.normals
    tangents = np.broadcast_to([1.0, 0.0, 0.0, 1.0], front.tangents.shape)
    used, renumbered = np.unique(np.concatenate([faces, *added]), return_inverse=True)
    backs = {"vertices": behind, "normals": normals, "uv": front.uv, "tangents": tangents}
    both = {name: np.concatenate([getattr(front, name), value])[used] for name, value in backs.items()}
    return replace(front, **both, faces=renumbered.reshape(-1, 3).astype(np.int32))


def to_float32(mesh: ReliefMesh) -> ReliefMesh:
    """Convert a mesh to float32.

    Vertices are multiples of 2⁻²³ of the greatest coordinate, so that moving them and back is exact.
    """
    grid = 2.0 ** (np.ceil(np.log2(np.abs(mesh.vertices).max())) - 23)
    return replace(
        mesh,
        vertices=(np.rint(mesh.vertices / grid) * grid).astype(np.float32),
        normals=mesh.normals.astype(np.float32),
        uv=mesh.uv.astype(np.float32),
        tangents=mesh.tangents.astype(np.float32),
    )
