"""The 180° ambiguity of the azimuth: to which side of the view ray each normal leans, and the doubt of this.

Polarization determines the plane through a normal n and the view ray r, not the side: n and n′ = 2 (n·r) r − n give the
same Stokes parameters; n′ is the half-turn of n. The network sometimes predicts the half-turn of a whole region, most
often on black gloss. The inversion does not determine the side at all. For both, the sides minimize one energy over the
whole object: every cell of a coarse grid keeps n or turns it to n′. With t the part of n across the ray, of length
sin θ, the energy is the sum of

    outline      share of object ahead of t less that behind it: a closed surface leans towards its outline. It is 0
                 where t runs along the outline (a neck that the mask cuts)
    inside       −0.015 t·o, o the direction away from the object's inside: decides where nothing else does
    network      −0.16 L for turning, L the log odds that the network erred in this cell: where its positions disagree,
                 where it says the opposite of smaller pictures, in which it sees more of the object at once, and
                 where it expects a large error
    planes      part of L: the light of the flash decreases across a plane towards t (`planar_faces`)
    neighbors   ∓2 min(sin θ, sin θ′)² cos Δ |cos Δ| for equal and unequal choices, Δ the angle between t and t′

Half of the neighbor terms favor unequal choices, so the minimum is found by quadratic pseudo-Boolean optimization:
one minimum cut with two nodes for each cell. The cells that it leaves open keep their normals.

The inversion has no network term, and its outline counts three times as much. Turned cells of the network make
connected regions. The sum of weak terms over a large region is no strong evidence, so each region is judged as a whole,
by its mean L. All laws of odds were fitted to path-traced captures with known normals.

References
----------
Kolmogorov, Rother, Minimizing nonsubmodular functions with graph cuts, IEEE TPAMI 2007.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import outline
from polcap.optics.resize import area_mean, weighted_area_mean
from polcap.stages.infer.shape import planar_faces

_OUTLINE, _INVERSION_OUTLINE, _INSIDE, _NETWORK = 1.0, 3.0, 0.015, 0.16  # weights of the terms; the neighbors' is 1
_AHEAD = 1.5  # cells from a cell to the places ahead and behind
_BLUR = 3.0  # cells, 1σ, of the depth inside the mask
_INTEGER = 1000  # capacities per unit of energy: SciPy's maximum flow takes integers
# ln odds that the network's side of a cell is wrong: constant, share of its positions that disagree, correlation with
# smaller pictures (both with the cells around), ln of its error in degrees; tests/benchmarks/fit_half_turns.py
_WRONG = (-6.56, 4.51, -1.45, 1.67)
_NEAR = 2.0  # cells, 1σ of the means of the second and third term
_REGION = (0.46, 0.68)  # ln odds that a region is turned: constant, mean ln odds of its cells; same benchmark
# ln odds that a cell of the inversion is on the wrong side: constant, energy of turning it alone, ln of the share of
# links around it that contradict each other, mean lean away from the inside around it; same benchmark
_CELL = (2.94, -0.176, 1.04, -2.31)
_AROUND = 8.0  # cells, 1σ of the means of the third and fourth term


@dataclass(frozen=True)
class NetworkDoubt:
    """Uncertainty of the normals as the network predicts it."""

    sigma: Floats  # (H, W) expected error, degrees
    opposed: Floats  # (H, W) share of its positions in which the normal leans to the other side
    overview: Floats  # (2, H, W) lean of the normals that it predicts from smaller pictures, see `Grid`


@dataclass(frozen=True)
class HalfTurns:
    """Decision between each normal and its half-turn (azimuth + 180°), with the probability that it is wrong."""

    turned: Bools  # (H, W) the half-turn of the normal is the better one
    doubt: Floats  # (H, W) probability that the chosen side is wrong


@dataclass(frozen=True)
class Grid:
    """Normal map averaged to a coarse grid of cells."""

    mask: Bools  # (h, w)
    lean: Floats  # (2, h, w) across the ray, x right, y up, length sin θ


def resolve(
    normal: Floats, mask: Bools, network: NetworkDoubt | None = None, flash: planar_faces.FlashPicture | None = None
) -> HalfTurns:
    """Decide for each normal (H, W, 3), ray frames, in a mask (H, W) whether to turn its azimuth by 180°.

    `network` is the uncertainty of the network that predicted the normals; None for normals of the inversion, which
    have arbitrary sides. `flash` adds evidence for planes to that of the network.
    """
    grid = coarse(normal, mask)
    if not grid.mask.any():
        return HalfTurns(np.zeros(mask.shape, bool), np.zeros(mask.shape, np.float32))
    if network is None:
        turned, terms = sides(grid)
        x, y = (_enlarged(part, mask.shape) for part in np.where(turned, -1, 1) * grid.lean)
        doubt = _logistic(terms @ np.array(_CELL))
        return HalfTurns(x * normal[..., 0] + y * normal[..., 1] < 0, _enlarged(doubt, mask.shape))
    cell_odds = wrong_terms(grid, network, mask) @ np.array(_WRONG)
    if flash is not None:
        cell_odds = cell_odds + planar_faces.light_odds(grid.lean, grid.mask, flash, mask)
    region, odds = proposals(grid, cell_odds)
    probability = _logistic(_REGION[0] + _REGION[1] * odds)
    probability[0] = 0  # cells that the cut does not turn: the network's error covers them
    doubt = np.minimum(probability, 1 - probability)[region]
    return HalfTurns(_enlarged((probability > 0.5)[region], mask.shape) > 0.5, _enlarged(doubt, mask.shape))


def error_with_doubt(error: Floats, doubt: Floats, cos_zenith: Floats) -> Floats:
    """Expected normal error (H, W), degrees: twice the zenith with the probability `doubt`, otherwise `error`."""
    return np.asarray((1 - doubt) * error + doubt * 2 * np.degrees(np.arccos(np.clip(cos_zenith, 0, 1))))


def coarse(normal: Floats, mask: Bools) -> Grid:
    """Average normals (H, W, 3) over the cells of a coarse grid.

    Azimuths are averaged as axes, by double angles, so normals on opposite sides do not cancel. The cell's side is that
    of the mean normal.
    """
    shape = planar_faces.grid_shape(mask.shape)
    x, y = normal[..., 0] * mask, normal[..., 1] * mask
    parts = (mask, x, y, x * x - y * y, 2 * x * y, np.hypot(x, y), np.maximum(normal[..., 2] * mask, 0))
    share, x, y, cos2, sin2, sine, cosine = (area_mean(part.astype(np.float32), shape) for part in parts)
    inside = share > 0.5
    azimuth = np.arctan2(sin2, cos2) / 2
    axis = np.stack([np.cos(azimuth), np.sin(azimuth)])
    sign = np.where(axis[0] * x + axis[1] * y < 0, -1, 1)
    return Grid(inside, axis * sign * sine / np.maximum(np.hypot(sine, cosine), 1e-6) * inside)


def sides(grid: Grid) -> tuple[Bools, Floats]:
    """Cells (h, w) in which the normals of the inversion turn by 180° in azimuth, by the minimum cut.

    Also returns the evidence (h, w, 4) that the chosen side is wrong: the terms of the odds `_CELL`.
    """
    outwards = _outwards(grid)
    cost = (_INVERSION_OUTLINE * _outline_evidence(grid) + _INSIDE * outwards)[grid.mask]
    first, second, alike = _links(grid)
    turned = _cut(grid.mask, cost, first, second, alike)
    sign = np.where(turned, -1, 1)
    side = sign[grid.mask]
    agreement = alike * side[first] * side[second]  # negative: the two cells contradict each other

    def sum_at_cells(of_link: Floats) -> Floats:
        out = np.zeros(grid.mask.shape)
        out[grid.mask] = sum(np.bincount(ends, of_link, len(side)) for ends in (first, second))
        return out

    def mean_around(image: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), _AROUND)) + 1e-9

    energy = sum_at_cells(agreement)
    energy[grid.mask] += side * cost
    contradiction = mean_around(sum_at_cells(np.maximum(-agreement, 0))) / mean_around(sum_at_cells(np.abs(agreement)))
    lean = mean_around(sign * outwards * grid.mask) / mean_around(grid.mask.astype(float))
    return turned, np.stack([np.ones(turned.shape), energy, np.log(contradiction + 0.01), lean], axis=-1)


def wrong_terms(grid: Grid, network: NetworkDoubt, mask: Bools) -> Floats:
    """Evidence (h, w, 4) that the network's normals lean to the wrong side: the terms of the odds `_WRONG`.

    The terms are 1; the share of the network's positions that disagree, near a cell; the agreement −1…1 with the lean
    in smaller pictures; and ln of the expected error in degrees, of 1° at least. `network` and `mask` have the size of
    the picture.
    """
    images = (network.sigma, network.opposed, *network.overview)
    sigma, opposed, *overview = (weighted_area_mean(image, mask, grid.mask.shape) for image in images)

    def blurred(image: Floats) -> Floats:
        """Blur an image that is 0 outside the mask; the quotient of two such images is a quotient of means inside."""
        return np.asarray(cv2.GaussianBlur((image * grid.mask).astype(np.float32), (0, 0), _NEAR))

    lengths = np.hypot(*grid.lean) * np.hypot(*overview)
    agreement = blurred((grid.lean * overview).sum(axis=0)) / (blurred(lengths) + 1e-3)
    disagree = blurred(opposed) / (blurred(np.ones(grid.mask.shape)) + 1e-6)
    return np.stack([np.ones(agreement.shape), disagree, agreement, np.log(np.maximum(sigma, 1))], axis=-1)


def proposals(grid: Grid, odds: Floats) -> tuple[NDArray[np.int32], Floats]:
    """Regions of the network's normals that the minimum cut turns by 180° in azimuth.

    `odds` (h, w) are the ln odds that a cell is wrong. Returns the number (h, w) of each cell's region, 0 for cells
    that do not turn, and the mean ln odds (R,) of each region.
    """
    cost = _OUTLINE * _outline_evidence(grid) + _INSIDE * _outwards(grid) - _NETWORK * odds
    turned = _cut(grid.mask, cost[grid.mask], *_links(grid))
    count, region = cv2.connectedComponents(turned.astype(np.uint8), connectivity=4)
    cells = np.maximum(np.bincount(region.ravel(), minlength=count), 1)
    return region.astype(np.int32), np.bincount(region.ravel(), odds.ravel(), count) / cells


def _logistic(odds: Floats) -> Floats:
    """Probability from a logarithm of odds (logistic function)."""
    return np.asarray(1 / (1 + np.exp(-odds)))


def _enlarged(cells: Floats | Bools, shape: tuple[int, ...]) -> Floats:
    return np.asarray(cv2.resize(cells.astype(np.float32), (shape[1], shape[0])))


def _outline_evidence(grid: Grid) -> Floats:
    """Evidence (h, w) that normals point out of the object: sin θ (object share behind t − share ahead of it).

    The picture's edge gives no evidence, because the object may continue beyond it.
    """
    y, x = np.indices(grid.mask.shape, np.float32)
    sine = np.hypot(*grid.lean)
    step = _AHEAD * grid.lean / np.maximum(sine, 1e-6)
    inside = grid.mask.astype(np.float32)
    behind, ahead = (
        cv2.remap(
            inside, (x + k * step[0]).astype(np.float32), (y - k * step[1]).astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for k in (-1, 1)
    )  # fmt: skip
    return np.asarray(sine * (behind - ahead))


def _outwards(grid: Grid) -> Floats:
    """Component −1…1 (h, w) of the normals away from the object's inside."""
    away, _ = outline.outward(outline.depth(grid.mask), _BLUR)
    return np.asarray((grid.lean * away).sum(axis=0))


def _links(grid: Grid) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Pairs of neighboring cells, as indices (M,) and (M,), and the similarity (M,) of their azimuths, −2…2.

    The similarity is 0 if one of the cells faces the camera, or for azimuths at a right angle.
    """
    number = np.full(grid.mask.shape, -1)
    number[grid.mask] = np.arange(int(grid.mask.sum()))
    first, second, alike = [], [], []
    sine = np.hypot(*grid.lean)
    x, y = grid.lean / np.maximum(sine, 1e-6)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = grid.mask[one] & grid.mask[other]
        first.append(number[one][both])
        second.append(number[other][both])
        cosine = x[one] * x[other] + y[one] * y[other]
        alike.append((2 * np.minimum(sine[one], sine[other]) ** 2 * cosine * np.abs(cosine))[both])
    return np.concatenate(first), np.concatenate(second), np.concatenate(alike)


def _cut(mask: Bools, cost: Floats, first: NDArray[np.intp], second: NDArray[np.intp], alike: Floats) -> Bools:
    """Minimize Σ cost · x + Σ alike · (x ≠ x′) over x = 0 or 1 of each cell; returns the cells (h, w) with x = 1.

    `cost` (N,) belongs to the mask's cells, `alike` (M,) to the links between its cells `first` and `second` (M,).
    Cells that the cut leaves open have x = 0. The graph has two nodes for each cell, `cell` and `count + cell`. The
    first is on the source's side if x is 0, the second if x is 1.
    """
    from scipy import sparse  # here: importing it costs .3 s of every start
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = int(mask.sum())
    source, sink, cell = 2 * count, 2 * count + 1, np.arange(count)
    single, pair = np.rint(_INTEGER * cost).astype(int), np.rint(_INTEGER * alike).astype(int)
    costly, costless = cell + count * (single < 0), cell + count * (single >= 0)  # nodes
    same, other = second + count * (pair < 0), second + count * (pair >= 0)
    pairs = (first, same), (same, first), (first + count, other), (other, first + count)
    edges = [
        (np.full(count, source), costly, single),
        (costless, np.full(count, sink), single),
        *((one, two, pair) for one, two in pairs),
    ]
    start, end, capacity = (np.concatenate(column).astype(np.int32) for column in zip(*edges))
    graph = sparse.csr_array((np.abs(capacity), (start, end)), shape=(2 * count + 2, 2 * count + 2))
    residual = sparse.csr_array(graph - maximum_flow(graph, source, sink).flow)
    residual.eliminate_zeros()
    reached = np.zeros(2 * count + 2, dtype=bool)
    reached[breadth_first_order(residual, source, return_predecessors=False)] = True
    turned = np.zeros(mask.shape, dtype=bool)
    turned[mask] = ~reached[:count] & reached[count : 2 * count]
    return turned
