"""Integration of normals to scaled log depth z, with cuts where one part of the surface hides another.

The slope equations are solved by least squares on a pyramid of grids. The coarsest grid has at most `_DECISION_PIXELS`
pixels at any resolution of the camera; there noise is small compared with the bending of the surface. It decides where
the surface is cut:

1. Cut the surface at the occluding contours that the normals show.
2. Bilateral integration: along each axis a pixel trusts the one of its two neighbors that continues its tangent plane.
3. Restore contours at which no depth step has opened.
4. Let only pixels near the remaining depth steps choose between neighbors, and solve z again.
5. Remove cuts that do not lower the residual around them.
6. Remove cuts between parts that touch.

Normals with a median error below 2° are limited by the size of a pixel, not by noise. For these, step 4 weights a link
by the variance of the chord between its ends, and step 5 is left out, because there is no noise that makes cuts.

On each finer grid only pixels near these cuts choose between neighbors. So a finer picture refines the contours and
cannot tear the surface.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022.
"""

import numpy as np

from polcap.image_values import Bools, Floats
from polcap.optics.morphology import dilate
from polcap.optics.outline import disc_radius
from polcap.stages.surface import occlusion
from polcap.stages.surface.occlusion import OcclusionMap, label_contours
from polcap.stages.surface.pyramid_level import GAP, REACH, ContourLinks, PyramidLevel
from polcap.stages.surface.slope_equations import NormalField, halve

_DECISION_PIXELS = 80_000  # most pixels of the grid that decides on cuts (docs/benchmarks/surface.md)
_LEAST_WEIGHT = 1 / 16  # least weight of a normal that can show an occluding contour: an error of four times the median
_OPEN = 0.3  # least share of the gap that opens where a part is separate
_CUT_ROUNDS = 2  # of removing cuts
_AROUND = 10  # px from a cut within which the residual is compared
_WORSE, _WORSE_RATIO = 1.0, 1.4  # by this much more residual a cut is removed: σ² per link, and a factor; both


def log_depth(field: NormalField, stiffness: float, iterations: int, tolerance: float, jump: float) -> Floats:
    """Integrate normals to the scaled log depth z (N,) [px] of the object's pixels.

    `stiffness` is how exclusively a pixel trusts one neighbor; 0 is plain least squares. Bilateral iterations on the
    coarsest grid end after `iterations`, or when the relative change of the energy is below `tolerance`. `jump` is the
    least depth step that cuts the mesh, over the object's radius; the integration cuts at half of it.
    """
    fields = [field]
    while len(fields[-1].normal) > _DECISION_PIXELS:
        fields.append(halve(fields[-1]))
    level = PyramidLevel(fields.pop(), stiffness, jump / 2)
    decide(level, iterations, tolerance)
    while fields:
        coarse = level.z, level.near_cuts(), level.solver
        level = PyramidLevel(fields.pop(), stiffness, jump / 2)
        level.refine(*coarse)
    return level.z


def decide(level: PyramidLevel, iterations: int, tolerance: float) -> None:
    """Decide on the coarsest grid where the surface is cut, and solve its z: steps 1 to 6 of this module's docstring.

    `iterations` and `tolerance` end step 2, as for `log_depth`.
    """
    if level.stiffness > 0:
        cut_contours(level)  # 1
    level.integrate_bilaterally(iterations, tolerance)  # 2
    restore_contours(level)  # 3
    found = level.occlusions()  # 4
    level.choosing = ~dilate(found.torn, REACH)[level.field.mask] & (level.stiffness > 0) & found.any()
    if not level.choosing.any():
        level.z = np.zeros_like(level.z)  # no cuts: plain least squares, to the last bit
    level.chords = level.precise
    level.solve()
    if not level.precise:
        remove_useless_cuts(level)  # 5
    join_contacts(level)  # 6


def cut_contours(level: PyramidLevel) -> None:
    """Cut the surface at the occluding contours that the normals show: remove the slope terms of links across them."""
    reliable = level.field.weight > _LEAST_WEIGHT
    lean = [np.where(reliable, np.arctan2(side, np.maximum(level.facing, 1e-6)), np.nan) for side in level.side]
    found = occlusion.occluding_contours((level.grid.image(lean[0]), level.grid.image(lean[1])), level.field.mask)
    sign = level.grid.links(*found)
    link = np.flatnonzero(sign)
    gap = GAP * disc_radius(level.field.mask) * sign[link]
    first, second = (level.slope_at(ends)[link] for ends in (level.grid.p, level.grid.q))
    level.contours = ContourLinks(link, gap, gap + np.where(gap > 0, first, second))


def restore_contours(level: PyramidLevel) -> None:
    """Restore the slope terms across occluding contours where no depth step has opened."""
    link, gap = level.contours.link, level.contours.gap
    p, q = level.grid.p[link], level.grid.q[link]
    opened = (level.z[q] - level.z[p] - level.contours.step + gap) / gap
    at = np.zeros(level.grid.size, dtype=bool)
    at[p] = True
    contour = label_contours(level.grid.image(at, outside=False))[level.field.mask][p]
    separate = [number for number in np.unique(contour) if np.median(opened[contour == number]) > _OPEN]
    level.contours = level.contours.select(np.isin(contour, separate))


def remove_useless_cuts(level: PyramidLevel) -> None:
    """Remove cuts around which z fits the slopes worse than on a surface without cuts.

    A true occlusion relieves the surface around it: slopes no longer have to bridge its step.
    """
    uncut: PyramidLevel | None = None
    for _ in range(_CUT_ROUNDS):
        found = level.occlusions()
        if not found.any() or not level.choosing.any():
            return
        uncut = uncut or level.without_cuts()
        useless = _useless_cuts(level, found, uncut)
        if not useless.any():
            return
        level.close_cuts(useless)


def _useless_cuts(level: PyramidLevel, found: OcclusionMap, uncut: PyramidLevel) -> Bools:
    """Mask (N,) of pixels near cuts around which the slope residuals are larger than without any cut."""
    mask, p = level.field.mask, level.grid.p
    cut = level.grid.links(found.right, found.down)
    contour = label_contours(found.near(0))
    count = np.bincount(contour[mask][p], cut, minlength=int(contour.max()) + 1)
    useless = np.zeros(mask.shape, dtype=bool)
    residuals = (uncut.slope_residuals(), level.slope_residuals())
    for number in np.flatnonzero(count[1:]) + 1:
        at = contour == number
        around = dilate(at, _AROUND)[mask][p] & ~dilate(at, 1)[mask][p]
        without, with_cut = (of[around & ~cut].sum() / count[number] for of in residuals)
        if with_cut > max(without + _WORSE, _WORSE_RATIO * without):
            useless |= dilate(at, REACH)
    return np.asarray(useless[mask])


def join_contacts(level: PyramidLevel) -> None:
    """Remove cuts between parts that touch: many links across the cut have the same small depth step (`occlusion`)."""
    found = level.occlusions()
    if not found.any() or not level.choosing.any():
        return
    grid, separate = level.grid, level.grid.links(found.right, found.down)
    separate[level.contours.link] = True
    step, slopes = level.z[grid.q] - level.z[grid.p], (level.slope_at(grid.p), level.slope_at(grid.q))
    excess = step - np.clip(step, np.minimum(*slopes), np.maximum(*slopes))  # beyond the slopes at both ends
    touch = occlusion.contact_links(grid, separate, excess, disc_radius(level.field.mask))
    if not touch.any():
        return
    at = np.zeros(grid.size, dtype=bool)
    at[grid.p[touch]] = at[grid.q[touch]] = True
    level.close_cuts(dilate(grid.image(at, outside=False), REACH)[level.field.mask])
