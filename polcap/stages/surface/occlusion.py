"""Occlusions: where one part of the surface hides another, found in the normals or in the integrated depth.

Three tests, on the links between neighboring pixels:

`occluding_contours` uses the normals alone. At an occluding contour the nearer surface is seen edge-on, and the farther
surface is tilted much less. The depth step there is unknown; without a cut, least squares would join both surfaces.

`depth_steps` uses an integrated depth. On one smooth surface the step of a link lies between the slopes at its ends. A
step outside this range counts as an occlusion if two conditions hold. Its contour is long and high: noise makes short
and low ones. The nearer side is tilted away: contradictory normals also make long contours, but across pixels that face
the camera.

`contact_links` finds where two separated parts touch. In the crease between two touching balls the normals are tilted
as at an occluding contour, so the integration separates the balls, by the same step all along the crease. Along a true
occluding contour the step varies.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics.morphology import dilate
from polcap.optics.outline import disc_radius
from polcap.stages.surface.multigrid import PixelGrid, connected_parts

# lengths in shares of the object's radius
_LEAST_LENGTH = 0.1  # of a contour, of both kinds
_SMOOTHING_PX = 4.0  # 1σ of means along a contour

_REACH = 3  # px from a link within which the nearer side's steepest and the farther side's flattest normal lie
_CANDIDATE_LEAN = np.radians(65.0)  # of the nearer side at a link
_CANDIDATE_KINK = np.radians(25.0)  # nearer side's lean less the farther side's
_CONTOUR_LEAN = np.radians(75.0)  # of the nearer side, mean along the contour

_LEAST_STEP_PX = 2.0  # smaller depth steps are no occlusions, however small the object is
_PEAK = 2.0  # highest step of a contour, over the least step
_RIM_PX = 2  # px from a link within which the nearer side's lean is greatest, for normals are blurred
_RIM_LEAN = 0.5  # rad, of the nearer side, mean along the contour

_PART = 0.002  # of the object's pixels: smaller parts are specks
_LEAST_PERCENTILE = 10.0  # of the steps along a border: counts as the smallest step
_EQUAL = 0.04  # range of the steps along a contact
_CONTACT_LENGTH = 0.43  # of a contact


def occluding_contours(lean: tuple[Floats, Floats], mask: Bools) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Find the links that cross an occluding contour, by the normals alone.

    Returns images of the links to the right (H, W−1) and down (H−1, W): +1 where the first pixel is the nearer one, −1
    where the second is, 0 without a contour. `lean` are the angles at which the surface falls away to the right and
    down, (H, W) each [rad]; NaN outside the mask.
    """
    candidates = [_contour_candidates(of, mask, axis, sign) for axis, of in zip((1, 0), lean) for sign in (1, -1)]
    total, count = np.zeros(mask.shape, np.float32), np.full(mask.shape, 1e-6, np.float32)
    for axis, (at, steepest) in zip((1, 1, 0, 0), candidates):
        first, _ = _ends(axis)
        total[first] += np.where(at, steepest, 0)
        count[first] += at
    mean = cv2.GaussianBlur(total, (0, 0), _SMOOTHING_PX) / cv2.GaussianBlur(count, (0, 0), _SMOOTHING_PX)
    edge_on = (mean > _CONTOUR_LEAN) & (count > 0.5)
    label = label_contours(edge_on)
    length = np.bincount(label[edge_on], minlength=int(label.max()) + 1)
    edge_on &= (length >= max(_LEAST_LENGTH * disc_radius(mask), 4))[label]
    links = [at.astype(np.int8) for at, _ in candidates]
    right, down = (links[0] - links[1]) * edge_on[:, :-1], (links[2] - links[3]) * edge_on[:-1]
    return right, down


def _contour_candidates(lean: Floats, mask: Bools, axis: int, sign: int) -> tuple[Bools, Floats]:
    """Links along an axis that may cross an occluding contour, because the nearer pixel is nearly edge-on.

    The nearer pixel is the first of the link (sign 1) or the second (−1). Also returns the angle [rad] at which the
    surface falls away there.
    """
    away = sign * lean
    inside = np.isfinite(away)
    size = (1, _REACH) if axis else (_REACH, 1)
    last = (_REACH - 1, 0) if axis else (0, _REACH - 1)
    back, ahead = (last, (0, 0)) if sign > 0 else ((0, 0), last)
    box = np.ones(size, np.uint8)
    # ±9 outside the mask: beyond any angle
    steepest = cv2.dilate(np.where(inside, away, -9).astype(np.float32), box, anchor=back, borderValue=-9)
    flattest = cv2.erode(np.where(inside, away, 9).astype(np.float32), box, anchor=ahead, borderValue=9)
    one, two = _ends(axis)
    nearer, farther = (one, two) if sign > 0 else (two, one)
    kink = steepest[nearer] - flattest[farther]
    # of neighboring links that cross the same contour, the one where the normals turn most
    turn = away[nearer] - away[farther]
    most = cv2.dilate(np.nan_to_num(turn, nan=-9).astype(np.float32), np.ones((1, 5) if axis else (5, 1), np.uint8))
    at = mask[one] & mask[two] & (steepest[nearer] > _CANDIDATE_LEAN) & (kink > _CANDIDATE_KINK) & (turn >= most - 1e-6)
    return at, steepest[nearer]


@dataclass(frozen=True)
class OcclusionMap:
    """Links across which one part of the surface hides another, and pixels where the normals fit no surface."""

    right: Bools  # (H, W−1) links to the right
    down: Bools  # (H−1, W) links down
    torn: Bools  # (H, W) a long, high step without an edge-on side: the normals fit no surface there

    def any(self) -> bool:
        """Whether the surface has any occlusion."""
        return bool(self.right.any() or self.down.any())

    def near(self, reach: int) -> Bools:
        """Mask (H, W) of pixels within `reach` px of an occlusion."""
        at = np.zeros(self.torn.shape, dtype=bool)
        at[:, :-1] |= self.right
        at[:, 1:] |= self.right
        at[:-1] |= self.down
        at[1:] |= self.down
        return dilate(at, reach)


def least_step(mask: Bools, share: float) -> float:
    """Least depth step of an occlusion [px]: `share` of the radius of a disc with the area of the mask (H, W).

    It is at least 2 px.
    """
    return max(_LEAST_STEP_PX, share * disc_radius(mask))


def depth_steps(z: Floats, slope: tuple[Floats, Floats], mask: Bools, least: float) -> OcclusionMap:
    """Find the occlusions of an integrated depth.

    z (H, W) is the scaled log depth [px], with any value outside the mask (H, W); `slope` is ∂z to the right and down
    by the normals, (H, W) each; `least` is the least step beyond the slopes at both ends of a link [px].
    """
    beyond = tuple(_excess(z, of, mask, axis) for axis, of in zip((1, 0), slope))
    highest = np.zeros(mask.shape, dtype=np.float32)  # of a pixel's links
    for axis, excess in zip((1, 0), beyond):
        for end in _ends(axis):
            np.maximum(highest[end], np.abs(excess), out=highest[end])
    count, label = cv2.connectedComponents((highest > least).astype(np.uint8), connectivity=8)
    if count < 2:
        nothing = np.zeros(mask.shape, dtype=bool)
        return OcclusionMap(nothing[:, 1:], nothing[1:], nothing)
    high = label > 0
    peak = np.zeros(count, dtype=np.float32)
    np.maximum.at(peak, label[high], highest[high])
    long = np.bincount(label[high], minlength=count) >= max(_LEAST_LENGTH * disc_radius(mask), 3)
    high &= (long & (peak > _PEAK * least))[label]
    rim = _nearer_lean(high, beyond, slope, least) > _RIM_LEAN
    right, down = ((np.abs(excess) > least) & (high & rim)[_ends(axis)[0]] for axis, excess in zip((1, 0), beyond))
    return OcclusionMap(right, down, high & ~rim)


def _excess(z: Floats, slope: Floats, mask: Bools, axis: int) -> Floats:
    """Depth step of each link beyond the range of the slopes at its two ends [px]; 0 outside the mask."""
    first, second = _ends(axis)
    step = z[second] - z[first]
    low, high = np.minimum(slope[first], slope[second]), np.maximum(slope[first], slope[second])
    return np.where(mask[first] & mask[second], step - np.clip(step, low, high), 0).astype(np.float32)


def _nearer_lean(high: Bools, beyond: tuple[Floats, ...], slope: tuple[Floats, Floats], least: float) -> Floats:
    """Slope angle (H, W) [rad] at which the nearer side of depth steps falls towards the farther side, local mean."""
    total, links = np.zeros(high.shape, dtype=np.float32), np.full(high.shape, 1e-6, dtype=np.float32)
    for axis, excess, of in zip((1, 0), beyond, slope):
        first, second = _ends(axis)
        size = (1, _RIM_PX + 1) if axis else (_RIM_PX + 1, 1)
        begin = (_RIM_PX, 0) if axis else (0, _RIM_PX)
        backward = cv2.dilate(of.astype(np.float32), np.ones(size, np.uint8), anchor=begin)
        forward = cv2.dilate(-of.astype(np.float32), np.ones(size, np.uint8), anchor=(0, 0))
        at = (np.abs(excess) > least) & high[first]
        total[first][at] += np.arctan(np.where(excess[at] > 0, backward[first][at], forward[second][at]))
        links[first] += at
    total, links = (cv2.GaussianBlur(values, (0, 0), _SMOOTHING_PX) for values in (total, links))
    return np.asarray(total / np.maximum(links, 1e-9))


def contact_links(grid: PixelGrid, separate: Bools, excess: Floats, radius: float) -> Bools:
    """Find links (L,) across which two separated parts of the surface touch.

    Of the L links of the grid, `separate` (L,) are across an occlusion, and `excess` (L,) is the depth step beyond the
    slopes at both ends [px], positive where the depth grows to the right or down; `radius` is the object's [px].
    """
    part = _parts(grid, ~separate)
    first, second = part[grid.p], part[grid.q]
    border = np.flatnonzero(separate & (first != second) & (first >= 0) & (second >= 0))
    touch = np.zeros(len(separate), dtype=bool)
    first, second = first[border], second[border]
    step = excess[border] * np.where(first < second, 1, -1)  # from the part of lower number to the other
    pair = np.minimum(first, second) * (int(part.max()) + 1) + np.maximum(first, second)
    for number in np.unique(pair):
        at = np.flatnonzero(pair == number)
        height = step[at] * np.sign(np.median(step[at]))
        middle, count = _most_equal(height, _EQUAL * radius)
        if count > _CONTACT_LENGTH * radius:
            touch[border[at[np.abs(height - middle) < _EQUAL * radius]]] = True
    return touch


def _parts(grid: PixelGrid, together: Bools) -> NDArray[np.int64]:
    """Number (N,) of each pixel's connected part; −1 for specks."""
    part = connected_parts(grid.p[together], grid.q[together], grid.size)
    return np.where(np.bincount(part)[part] > _PART * grid.size, part, -1)


def _most_equal(step: Floats, width: float) -> tuple[float, int]:
    """Most frequent of the small steps (B,): center of the window of this width that holds most, and their number."""
    low = np.sort(step)
    count = np.searchsorted(low, low + width, side="right") - np.arange(len(low))
    count[low > np.percentile(low, _LEAST_PERCENTILE) + width] = 0
    most = int(np.argmax(count))
    return float(low[most] + width / 2), int(count[most])


def label_contours(at: Bools) -> NDArray[np.int32]:
    """Number (H, W) of the contour on which each marked pixel (H, W) lies; gaps of two pixels are closed."""
    near = dilate(at, 1).view(np.uint8)
    return np.asarray(cv2.connectedComponents(near, connectivity=8)[1], dtype=np.int32)


def _ends(axis: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the first and second pixel of all links along the last axis (1) or the first (0) of an image."""
    every, but_last, but_first = slice(None), slice(None, -1), slice(1, None)
    return ((every, but_last), (every, but_first)) if axis else ((but_last, every), (but_first, every))
