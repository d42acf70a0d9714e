"""The edges where a mesh ends: measured, and smoothed from the pixels' stairs to the curve they stand for."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats

_SPECK = 0.002  # of the mesh's triangles: smaller pieces do not count
_ROUNDS = 4  # of averaging along the boundary; about two grid steps either side
_DEPTH_ROUNDS = 64  # the same of its depth, 1σ of six steps: at a limb the stairs of the outline are ten times as deep
_FARTHEST = 0.75  # grid steps that a vertex may move in the picture
_LEAST_AREA = 0.1  # of a triangle after the move, over before: else its corners stay


@dataclass(frozen=True)
class Figures:
    """What tells a torn mesh from a whole one."""

    pieces: int  # that hold more than a speck
    cuts: float  # length of the boundary inside the mask, both sides, over that along its outline
    cut_px: float  # length of the cuts inside the mask, one side [px]
    raggedness: float  # length of the boundary over that of itself smoothed, less 1


def edges(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Edges (B, 2) of one triangle only, in that triangle's direction."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    key = low * (int(faces.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    same = key[order[1:]] == key[order[:-1]]
    alone = np.ones(len(key), dtype=bool)
    alone[order[1:]] &= ~same
    alone[order[:-1]] &= ~same
    return np.asarray(ends[alone])


def measure(place: NDArray[np.int64], faces: NDArray[np.int32], mask: NDArray[np.bool_], step: int) -> Figures:
    """Pieces, cuts and raggedness of a mesh before its boundary is smoothed.

    Parameters
    ----------
    place
        (V, 2) x, y px of the vertices.
    faces
        (F, 3).
    mask
        (H, W) of the object.
    step
        The vertices' grid has every so many px.
    """
    rim = edges(faces)
    size = np.ones((4 * step + 1, 4 * step + 1), np.uint8)
    inner = cv2.erode(np.pad(mask.astype(np.uint8), 1), size, borderValue=0)[1:-1, 1:-1] > 0
    inside = inner[place[:, 1], place[:, 0]][rim].any(axis=1)
    position = place.astype(np.float64)
    length = np.linalg.norm(position[rim[:, 0]] - position[rim[:, 1]], axis=-1)
    smooth = _averaged(position, rim, 3 * _ROUNDS)
    shorter = np.linalg.norm(smooth[rim[:, 0]] - smooth[rim[:, 1]], axis=-1).sum()
    return Figures(
        pieces=_pieces(faces, len(place)),
        cuts=float(length[inside].sum() / max(length[~inside].sum(), 1e-9)),
        cut_px=float(length[inside].sum() / 2),
        raggedness=float(length.sum() / max(shorter, 1e-9) - 1),
    )


def smoothed(place: Floats, log: Floats, faces: NDArray[np.int32], step: int) -> tuple[Floats, Floats]:
    """Vertices with those on the boundary averaged along it, their depth over a longer way than their place.

    Parameters
    ----------
    place
        (V, 2) x, y px.
    log
        (V,) scaled log depth.
    faces
        (F, 3).
    step
        The vertices' grid has every so many px.

    Returns
    -------
    place, log : Floats
        (V, 2) and (V,).
    """
    rim = edges(faces)
    move = _averaged(place, rim, _ROUNDS) - place
    far = np.linalg.norm(move, axis=-1, keepdims=True)
    after = place + move * np.minimum(1, _FARTHEST * step / np.maximum(far, 1e-9))
    was, now = area(place, faces), area(after, faces)
    for _ in range(3):  # a triangle that would turn over keeps its corners; so may its neighbours then have to
        bad = np.unique(faces[now < _LEAST_AREA * was])
        if not len(bad):
            break
        after = after.copy()
        after[bad] = place[bad]
        now = area(after, faces)
    return after, _averaged(log[:, None], rim, _DEPTH_ROUNDS)[:, 0]


def _averaged(values: Floats, rim: NDArray[np.int64], rounds: int) -> Floats:
    """Values (V, C) with each vertex on the boundary drawn half-way to the mean of its two neighbours there.

    A vertex where the boundary touches itself stays.
    """
    from scipy import sparse  # here: importing it costs .3 s of every start

    ends = np.concatenate([rim, rim[:, ::-1]])
    degree = np.bincount(ends[:, 0], minlength=len(values))
    used = np.flatnonzero(degree)
    number = np.full(len(values), -1)
    number[used] = np.arange(len(used))
    row, column = number[ends[:, 0]], number[ends[:, 1]]
    mean = sparse.csr_matrix((1 / degree[ends[:, 0]], (row, column)), (len(used), len(used)))
    moving = degree[used] == 2
    out = values.copy()
    on = values[used]
    for _ in range(rounds):
        on = np.where(moving[:, None], (on + mean @ on) / 2, on)
    out[used] = on
    return out


def _pieces(faces: NDArray[np.int32], count: int) -> int:
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = sparse.coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, piece = connected_components(links, directed=False)
    share = np.bincount(piece[faces[:, 0]]) / len(faces)
    return int((share > _SPECK).sum())


def area(place: Floats, faces: NDArray[np.int32]) -> Floats:
    """Twice the area (F,) of faces (F, 3) in the picture, y down, positive counter-clockwise seen from the camera."""
    one, two = (place[faces[:, k], :2] - place[faces[:, 0], :2] for k in (1, 2))
    return np.asarray(one[:, 1] * two[:, 0] - one[:, 0] * two[:, 1])
