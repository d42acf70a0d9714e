"""Where one part of the surface hides another: depth steps that no normal explains, behind a rim that leans away.

A link's ends have slopes s_p and s_q. Where the surface is one sheet between them its depth step lies between the
two, whatever bend it makes; a step beyond is a jump. Noise makes such steps too, but short and low ones: a contour
of jumps counts where it is long and reaches twice the least step, and then all of it counts. Normals that fit no
surface are torn apart along long contours, too, but across pixels that face the camera: what hides something turns
away from it first.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats

Bools = NDArray[np.bool_]

_LEAST_LENGTH = 0.1  # of a contour of jumps, over the object's radius
_PEAK = 2.0  # the highest step of a contour, over the least
_LEAST_PX = 2.0  # a step under this is no jump at any size
_RIM_PX = 2  # how far from a jump its rim may lie, in pixels of a blurred normal
_LEAST_LEAN = 0.5  # rad, of a rim, the mean about a jump
_ALONG_PX = 4.0  # 1σ of that mean


@dataclass(frozen=True)
class Jumps:
    """Links to the right (H, W−1) and down (H−1, W) at which the depth jumps, and pixels (H, W) at which it is torn."""

    right: Bools
    down: Bools
    torn: Bools  # steps as high and long, with no rim: the normals there fit no surface

    def any(self) -> bool:
        """Whether the depth jumps anywhere."""
        return bool(self.right.any() or self.down.any())

    def near(self, reach: int) -> Bools:
        """Pixels (H, W) within `reach` px of a jump."""
        at = np.zeros(self.torn.shape, dtype=bool)
        at[:, :-1] |= self.right
        at[:, 1:] |= self.right
        at[:-1] |= self.down
        at[1:] |= self.down
        return widened(at, reach)


def widened(at: Bools, reach: int) -> Bools:
    """Pixels (H, W) within `reach` px of those."""
    return np.asarray(cv2.dilate(at.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0)


def least_step(mask: Bools, share: float) -> float:
    """The depth step [px] from which on a link may be a jump: a share of the radius √(N/π) of a mask (H, W)."""
    return max(_LEAST_PX, share * radius(mask))


def radius(mask: Bools) -> float:
    """Radius of the disc with as many pixels as a mask (H, W), px."""
    return float(np.sqrt(mask.sum() / np.pi))


def jumps(z: Floats, slope: tuple[Floats, Floats], mask: Bools, least: float) -> Jumps:
    """Where the depth jumps.

    Parameters
    ----------
    z
        (H, W) scaled log depth [px]; anything outside the mask.
    slope
        ∂z to the right and down that the normals tell, (H, W) each.
    mask
        (H, W).
    least
        The step beyond both ends' slopes that makes a jump [px].
    """
    beyond = tuple(_excess(z, of, mask, axis) for axis, of in zip((1, 0), slope))
    highest = np.zeros(mask.shape, dtype=np.float32)  # of a pixel's links
    for axis, excess in zip((1, 0), beyond):
        for side in _sides(axis):
            np.maximum(highest[side], np.abs(excess), out=highest[side])
    count, label = cv2.connectedComponents((highest > least).astype(np.uint8), connectivity=8)
    if count < 2:
        nothing = np.zeros(mask.shape, dtype=bool)
        return Jumps(nothing[:, 1:], nothing[1:], nothing)
    on = label > 0
    peak = np.zeros(count, dtype=np.float32)
    np.maximum.at(peak, label[on], highest[on])
    clear = (np.bincount(label[on], minlength=count) >= max(_LEAST_LENGTH * radius(mask), 3)) & (peak > _PEAK * least)
    on &= clear[label]
    rim = _lean(on, beyond, slope, least) > _LEAST_LEAN
    right, down = ((np.abs(excess) > least) & (on & rim)[_sides(axis)[0]] for axis, excess in zip((1, 0), beyond))
    return Jumps(right, down, on & ~rim)


def _sides(axis: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Where links along the last axis (1) or the first (0) begin and end."""
    every, but_last, but_first = slice(None), slice(None, -1), slice(1, None)
    return ((every, but_last), (every, but_first)) if axis else ((but_last, every), (but_first, every))


def _excess(z: Floats, slope: Floats, mask: Bools, axis: int) -> Floats:
    """How far a link's step lies beyond its ends' slopes [px], with its sign; 0 off the mask."""
    first, second = _sides(axis)
    step = z[second] - z[first]
    low, high = np.minimum(slope[first], slope[second]), np.maximum(slope[first], slope[second])
    return np.where(mask[first] & mask[second], step - np.clip(step, low, high), 0).astype(np.float32)


def _lean(on: Bools, beyond: tuple[Floats, ...], slope: tuple[Floats, Floats], least: float) -> Floats:
    """How far the nearer side of the jumps about each pixel leans away towards the farther, (H, W) [rad]."""
    total, links = np.zeros(on.shape, dtype=np.float32), np.full(on.shape, 1e-6, dtype=np.float32)
    for axis, excess, of in zip((1, 0), beyond, slope):
        first, second = _sides(axis)
        size = (1, _RIM_PX + 1) if axis else (_RIM_PX + 1, 1)
        begin = (_RIM_PX, 0) if axis else (0, _RIM_PX)
        backward = cv2.dilate(of.astype(np.float32), np.ones(size, np.uint8), anchor=begin)
        forward = cv2.dilate(-of.astype(np.float32), np.ones(size, np.uint8), anchor=(0, 0))
        at = (np.abs(excess) > least) & on[first]
        total[first][at] += np.arctan(np.where(excess[at] > 0, backward[first][at], forward[second][at]))
        links[first] += at
    total, links = (cv2.GaussianBlur(values, (0, 0), _ALONG_PX) for values in (total, links))
    return np.asarray(total / np.maximum(links, 1e-9))
