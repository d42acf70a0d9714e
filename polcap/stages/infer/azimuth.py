"""Choose, for every pixel, which of two opposite azimuths a polarization angle means.

AoLP gives the azimuth of a normal up to half a turn. Neighbouring normals mostly agree, and at the
outline they point outward. Both facts are quadratic in a relaxed sign s in [−1, 1]: a random walk on the
pixel grid whose edges carry the sign with which two neighbours' directions agree, anchored at the rim.
One sparse solve finds the minimum; |s| tells how sure it is.

References
----------
Grady, Random walks for image segmentation, IEEE TPAMI 2006 (the unsigned case).
Hoppe et al., Surface reconstruction from unorganized points, SIGGRAPH 1992 (orientation by agreement).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import outline

_MOST_PIXELS = 90_000  # of the grid the signs are solved on; finer signs follow the coarse direction
_RIM_PX = 3.0  # anchored band inside the outline, on that grid
_BLUR_PX = 3.0  # of the depth, for its slope
_CONVEXITY = 1e-4  # weight of "outward from the outline" everywhere else: decides only what no neighbour does


def resolve(double_angle: Floats, strength: Floats, mask: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Azimuth φ (H, W) rad, and the certainty of its half-turn (H, W) 0…1.

    Parameters
    ----------
    double_angle
        (2, H, W) cos 2φ, sin 2φ of the AoLP.
    strength
        (H, W) sine of the zenith; flat pixels bind their neighbours little.
    mask
        (H, W).
    """
    height, width = mask.shape
    shrink = max(1.0, float(np.sqrt(mask.sum() / _MOST_PIXELS)))
    phi = np.arctan2(double_angle[1], double_angle[0]) / 2
    if shrink == 1.0:
        small_phi, small_strength, small_mask = phi, strength, mask
    else:
        size = (max(8, round(width / shrink)), max(8, round(height / shrink)))
        c, s, weight = (
            cv2.resize((m * strength * mask).astype(np.float32), size, interpolation=cv2.INTER_AREA)
            for m in (double_angle[0], double_angle[1], np.ones_like(phi))
        )
        share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small_mask = share > 0.5
        small_phi, small_strength = np.arctan2(s, c) / 2, weight / np.maximum(share, 1e-6)
    sign = _walk(small_phi, small_strength, small_mask)
    direction = np.stack([sign * np.cos(small_phi), sign * np.sin(small_phi)])
    if shrink > 1.0:
        direction = np.stack([cv2.resize(d.astype(np.float32), (width, height)) for d in direction])
    along = direction[0] * np.cos(phi) + direction[1] * np.sin(phi)
    return phi + np.where(along < 0, np.pi, 0.0), np.minimum(np.abs(along), 1.0)


def _walk(phi: Floats, strength: Floats, mask: NDArray[np.bool_]) -> Floats:
    """The relaxed signs (H, W), 0 outside: argmin Σ w (s_i − σ_ij s_j)² + Σ u (s_i − outward_i)²."""
    from scipy import sparse  # here: importing it costs .3 s of every start
    from scipy.sparse.linalg import spsolve

    height, width = mask.shape
    count = int(mask.sum())
    result = np.zeros(mask.shape)
    if count == 0:
        return result
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(count)
    axis = np.stack([np.cos(phi), np.sin(phi)])
    confidence = strength**2
    rows, columns, values = [], [], []
    diagonal = np.zeros(count)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: height - dy, max(0, -dx) : width - max(0, dx)]
        there = np.s_[dy:, max(0, dx) : width + min(0, dx)]
        both = mask[here] & mask[there]
        agreement = (axis[:, *here] * axis[:, *there]).sum(0)[both]
        weight = np.minimum(confidence[here], confidence[there])[both] * np.abs(agreement) / (dx * dx + dy * dy)
        weight = weight + 1e-7
        i, j = index[here][both], index[there][both]
        coupling = -weight * np.where(agreement < 0, -1.0, 1.0)
        rows += [i, j]
        columns += [j, i]
        values += [coupling, coupling]
        diagonal += np.bincount(i, weight, count) + np.bincount(j, weight, count)
    distance = outline.depth(mask)
    away, _ = outline.outward(distance, _BLUR_PX)
    facing = (axis * away).sum(0)
    anchor = (np.where(distance <= _RIM_PX, confidence, 0) + _CONVEXITY) * np.abs(facing)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = sparse.coo_matrix(entries, shape=(count, count)) + sparse.diags(diagonal + anchor[mask] + 1e-9)
    result[mask] = spsolve(matrix.tocsc(), (anchor * np.sign(facing))[mask])
    return result
