"""Integration of normals to scaled log depth z, with cuts where one part of the surface hides another.

Least squares over the slope equations, on a pyramid of grids. On the first grid of at most `_DECISION_PIXELS` pixels,
where noise is small against the bending of the surface, whatever the resolution of the camera:

1. Occluding contours that the normals show are cut.
2. Bilateral integration: each pixel trusts the one of its two neighbors per axis that continues its tangent plane.
3. Contours behind which no gap has opened are restored.
4. Only pixels near the remaining depth steps may choose between neighbors, and z is solved again.
5. Cuts that do not lower the residual around them are removed.
6. Parts that touch are joined.

Normals with a median error below `_PRECISE_DEG` are limited by the size of a pixel, not by noise. Step 4 then weights
a link by the variance of the chord between its ends, times the trust of both ends in this link. An estimated gap
behind a contour counts with its own error, which is as large as the gap. Step 5 is left out: noise makes no cuts.

On each finer grid only pixels near these cuts choose between neighbors. So a finer picture refines the contours and
cannot tear the surface.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022.
"""

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics.outline import disc_radius
from polcap.stages.surface import occlusion
from polcap.stages.surface.multigrid import Multigrid, PixelGrid, TwoGrid, conjugate_gradients
from polcap.stages.surface.occlusion import OcclusionMap, dilate, label_contours
from polcap.stages.surface.slope_equations import Bools, NormalField, block_numbers, halve, slope_terms

_DECISION_PIXELS = 80_000  # at most, of the grid that decides on cuts (docs/benchmarks)
_DECISION_SOLVES, _FINER_SOLVES = 4, 2  # solutions with choosing pixels, on that grid and on each finer one
_SOFT, _GROWTH = 0.25, 1.2  # first stiffness, over the setting, and its growth: early errors make few cuts
_UNDECIDED_PULL = 0.1  # of the prior's pull during the decision: a prior that strains the normals would cut them
_PRECISE_DEG, _PRECISE_SOLVES = 2.0, 8  # median error of normals below which chords are weighted, and solutions then
_REACH = 2  # px around a cut within which pixels choose, also on the next finer grid
_PRECISION = 1e-3  # of each linear solution, relative
_SLOW = 12  # iterations of a linear solution that call for a new hierarchy, which costs as much as 28
_PROXIMITY = 1e-8  # pull towards the last estimate: fixes the offset of each separate part
_LEAST_TRUST = 1e-9  # of a link's ends in it: keeps the equations solvable
_LEAST_FACING = 0.05  # cosine: flatter views give no slope
_BEND = 1 / 12  # variance of a step anywhere between its ends' slopes, over their difference squared

_SURE = 1 / 16  # least weight of a normal that can show an occluding contour: an error of four times the median
_GAP = 0.25  # expected depth step behind a contour, over the object's radius
_GAP_WEIGHT = 0.1  # of that expectation, all links together
_OPEN = 0.3  # least share of the gap that opens where a part is separate

_CUT_ROUNDS = 2  # of removing cuts
_AROUND = 10  # px from a cut within which the residual is compared
_STRAIN, _STRAIN_RATIO = 1.0, 1.4  # excess of the residual that condemns a cut: σ² per link, and a factor; both


def log_depth(field: NormalField, stiffness: float, iterations: int, tolerance: float, jump: float) -> Floats:
    """Integrate a normal field: scaled log depth z of the object's pixels (N,) [px].

    Parameters
    ----------
    field
        Normals, weights and prior of N pixels.
    stiffness
        How exclusively a pixel trusts one neighbor; 0 = plain least squares.
    iterations, tolerance
        Bilateral iterations on the grid that decides: at most so many, or until the energy changes by less.
    jump
        Least depth step of an occlusion, over the object's radius; half of it is one to the integration.
    """
    fields = [field]
    while len(fields[-1].normal) > _DECISION_PIXELS:
        fields.append(halve(fields[-1]))
    level = PyramidLevel(fields.pop(), stiffness, jump / 2)
    level.decide(iterations, tolerance)
    while fields:
        coarse = level.z, level.near_cuts(), level.solver
        level = PyramidLevel(fields.pop(), stiffness, jump / 2)
        level.refine(*coarse)
    return level.z


@dataclass(frozen=True)
class ContourLinks:
    """M pixel links across occluding contours: their depth step is unknown, and a weak prior sets it."""

    link: NDArray[np.intp]  # (M,) numbers of the links
    gap: Floats  # (M,) expected depth behind the contour [px], positive where it grows to the right or down
    step: Floats  # (M,) that and the slope of the nearer side [px]

    def select(self, at: Any) -> "ContourLinks":
        """The contour links at these indices or where this mask is true."""
        return ContourLinks(self.link[at], self.gap[at], self.step[at])


_NO_CONTOURS = ContourLinks(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0))


class PyramidLevel:
    """One grid of the integration's pyramid: its equations, and the state of their solution.

    Attributes
    ----------
    z
        (N,) scaled log depth [px].
    choosing
        (N,) pixels that may trust one neighbor more than the other.
    cuttable
        (N,) pixels at which a finer grid may be cut.
    contours
        Links without slope.
    chords
        Whether choosing pixels weight the chord of a link instead of the slopes at its two ends.
    solver
        Preconditioner of the last matrix, which also serves similar ones.
    """

    def __init__(self, field: NormalField, stiffness: float, jump: float) -> None:
        self.field, self.stiffness = field, stiffness
        self.least_step = occlusion.least_step(field.mask, jump)
        self.grid = grid = PixelGrid(field.mask)
        self.facing, right, down = slope_terms(field)
        self.side = (right, down)
        p, q, turn = grid.p, grid.q, grid.turn
        target = np.concatenate([right[p[:turn]] + right[q[:turn]], down[p[turn:]] + down[q[turn:]]]) / 2
        facing = (self.facing[p] + self.facing[q]) / 2
        steep = np.maximum(facing, _LEAST_FACING)
        self.slope = tuple(side / np.maximum(self.facing, _LEAST_FACING) for side in self.side)
        bend = self._slope_at(p) - self._slope_at(q)
        # a chord's direction is the mean of its ends' tangents (exact on a circle); its variance is that of the
        # normals' angle plus that of where between the two slopes a bend puts the step
        noise = field.sigma**2 * (1 / field.weight[p] + 1 / field.weight[q]) / 2
        self.step = target / steep  # (L,) by the normals
        self.weight = field.sigma**2 / (  # (L,) of that step
            noise * np.maximum(facing**2 + target**2, _LEAST_FACING**2) / steep**4 + _BEND * bend**2
        )
        self.z: Floats = np.zeros(grid.size)
        self.choosing: Bools = np.zeros(grid.size, dtype=bool)
        self.cuttable: Bools = np.ones(grid.size, dtype=bool)
        self.contours = _NO_CONTOURS
        self.precise = field.sigma < np.radians(_PRECISE_DEG)
        self.chords = False
        self.solver: Any = None

    def _slope_at(self, ends: NDArray[np.intp]) -> Floats:
        """Slope (L,) along each link between pixels, from the normal at one of its ends."""
        turn = self.grid.turn
        return np.concatenate([self.slope[0][ends[:turn]], self.slope[1][ends[turn:]]])

    def decide(self, iterations: int, tolerance: float) -> None:
        """Solve z and decide the cuts on the coarsest grid (steps 1–6 of the module)."""
        if self.stiffness > 0:
            self.cut_contours()
        self.integrate_bilaterally(iterations, tolerance)
        self.restore_contours()
        found = self.occlusions()
        self.choosing = ~dilate(found.torn, _REACH)[self.field.mask] & (self.stiffness > 0) & found.any()
        if not self.choosing.any():
            self.z = np.zeros_like(self.z)  # no cuts: plain least squares, to the last bit
        self.chords = self.precise
        self.solve()
        if not self.precise:
            self.remove_useless_cuts()
        self.join_contacts()

    def refine(self, coarse: Floats, near_cuts: Bools, solver: Any) -> None:
        """Solve z from the solution (n,) of the grid at half the resolution; only pixels near its cuts (n,) choose."""
        block = block_numbers(self.field.mask)
        self.z = self._interpolated(coarse, block)
        self.chords = self.precise
        self.choosing = self.cuttable = near_cuts[block] & (self.stiffness > 0)
        for _ in range(_FINER_SOLVES if self.choosing.any() else 1):
            matrix, right, _ = self.equations(self.stiffness, self.field.pull)
            self.solver = TwoGrid(matrix, block, solver)
            self.z, _ = conjugate_gradients(matrix, right, self.z, self.solver, _PRECISION, 20)

    def _interpolated(self, coarse: Floats, block: NDArray[np.intp]) -> Floats:
        """Interpolate z (N,) from 2×2 blocks, each tilted by the slopes of its pixels."""
        steep = np.maximum(self.facing, 0.1)
        row, column = self.grid.row % 2 - 0.5, self.grid.column % 2 - 0.5
        tilt = (column * self.side[0] + row * self.side[1]) / steep
        return np.asarray(2 * coarse[block] + tilt)

    def near_cuts(self) -> Bools:
        """Mask (N,) of the pixels near the cuts of the surface."""
        return self.occlusions().near(_REACH)[self.field.mask] & self.cuttable

    def cut_contours(self) -> None:
        """Cut the surface at the occluding contours that the normals show: links across them lose their slope terms."""
        sure = self.field.weight > _SURE
        lean = [np.where(sure, np.arctan2(side, np.maximum(self.facing, 1e-6)), np.nan) for side in self.side]
        found = occlusion.occluding_contours((self.grid.image(lean[0]), self.grid.image(lean[1])), self.field.mask)
        sign = self.grid.links(*found)
        link = np.flatnonzero(sign)
        gap = _GAP * disc_radius(self.field.mask) * sign[link]
        first, second = (self._slope_at(ends)[link] for ends in (self.grid.p, self.grid.q))
        self.contours = ContourLinks(link, gap, gap + np.where(gap > 0, first, second))

    def integrate_bilaterally(self, iterations: int, tolerance: float) -> None:
        """Bilateral integration: solve z with all pixels choosing between neighbors.

        The stiffness grows from `_SOFT` times the setting.
        """
        self.choosing = np.full(self.grid.size, True)
        before, taken, solver = np.inf, 0, None
        for count in range(iterations if self.stiffness > 0 else 0):
            stiffness = self.stiffness * min(1.0, _SOFT * _GROWTH**count)
            matrix, right, energy = self.equations(stiffness, _UNDECIDED_PULL * self.field.pull)
            if stiffness == self.stiffness and abs(before - energy) <= tolerance * energy:
                break
            before = energy
            if solver is None or taken > _SLOW:
                solver = Multigrid(matrix, self.grid.pixel)
            self.z, taken = conjugate_gradients(matrix, right, self.z, solver, _PRECISION, 30)

    def restore_contours(self) -> None:
        """Restore the slope terms across occluding contours where no depth step has opened."""
        link, gap = self.contours.link, self.contours.gap
        p, q = self.grid.p[link], self.grid.q[link]
        opened = (self.z[q] - self.z[p] - self.contours.step + gap) / gap
        at = np.zeros(self.grid.size, dtype=bool)
        at[p] = True
        contour = label_contours(self.grid.image(at, outside=False))[self.field.mask][p]
        separate = [number for number in np.unique(contour) if np.median(opened[contour == number]) > _OPEN]
        self.contours = self.contours.select(np.isin(contour, separate))

    def solve(self) -> None:
        """Solve z, with those pixels choosing that may, from the current z and solver."""
        taken = 0
        for _ in range((_PRECISE_SOLVES if self.chords else _DECISION_SOLVES) if self.choosing.any() else 1):
            matrix, right, _ = self.equations(self.stiffness, self.field.pull)
            if self.solver is None or taken > _SLOW:
                self.solver = Multigrid(matrix, self.grid.pixel)
            self.z, taken = conjugate_gradients(matrix, right, self.z, self.solver, _PRECISION, 30)

    def remove_useless_cuts(self) -> None:
        """Remove cuts around which z fits the slopes worse than on a surface without cuts.

        A true occlusion relieves the surface around it: slopes no longer have to bridge its step.
        """
        uncut: PyramidLevel | None = None
        for _ in range(_CUT_ROUNDS):
            found = self.occlusions()
            if not found.any() or not self.choosing.any():
                return
            uncut = uncut or self.without_cuts()
            useless = self._useless_cuts(found, uncut)
            if not useless.any():
                return
            self._close(useless)
            if not self.occlusions().any():
                self._become(uncut)
                return

    def _useless_cuts(self, found: OcclusionMap, uncut: "PyramidLevel") -> Bools:
        """Mask (N,) of pixels near cuts where the slope residuals are larger than without any cut."""
        mask, p = self.field.mask, self.grid.p
        cut = self.grid.links(found.right, found.down)
        contour = label_contours(found.near(0))
        count = np.bincount(contour[mask][p], cut, minlength=int(contour.max()) + 1)
        useless = np.zeros(mask.shape, dtype=bool)
        strains = (uncut.strain(), self.strain())
        for number in np.flatnonzero(count[1:]) + 1:
            at = contour == number
            around = dilate(at, _AROUND)[mask][p] & ~dilate(at, 1)[mask][p]
            without, with_cut = (strain[around & ~cut].sum() / count[number] for strain in strains)
            if with_cut > max(without + _STRAIN, _STRAIN_RATIO * without):
                useless |= dilate(at, _REACH)
        return np.asarray(useless[mask])

    def strain(self) -> Floats:
        """Squared slope residual of each link (L,), in units of the variance of the median normal."""
        change = self.z[self.grid.q] - self.z[self.grid.p]
        return np.asarray(self.weight * (change - self.step) ** 2 / self.field.sigma**2)

    def join_contacts(self) -> None:
        """Remove cuts between parts of the surface that touch."""
        found = self.occlusions()
        if not found.any() or not self.choosing.any():
            return
        grid, separate = self.grid, self.grid.links(found.right, found.down)
        separate[self.contours.link] = True
        step, ends = self.z[grid.q] - self.z[grid.p], (self._slope_at(grid.p), self._slope_at(grid.q))
        excess = step - np.clip(step, np.minimum(*ends), np.maximum(*ends))
        touch = occlusion.contact_links(grid, separate, excess, disc_radius(self.field.mask))
        if not touch.any():
            return
        at = np.zeros(grid.size, dtype=bool)
        at[grid.p[touch]] = at[grid.q[touch]] = True
        self._close(dilate(grid.image(at, outside=False), _REACH)[self.field.mask])
        if not self.occlusions().any():
            self._become(self.without_cuts())

    def _close(self, pixels: Bools) -> None:
        """Remove the surface's cuts at these pixels (N,), and solve z again.

        The pixels no longer choose between neighbors, and their links have slopes again.

        They no longer choose, their links have slopes again. z is solved again.
        """
        self.choosing = self.choosing & ~pixels
        self.contours = self.contours.select(~pixels[self.grid.p[self.contours.link]])
        self.solve()

    def without_cuts(self) -> "PyramidLevel":
        """A copy of this grid solved by plain least squares, without cuts."""
        level = copy(self)
        level.contours, level.choosing = _NO_CONTOURS, np.zeros(self.grid.size, dtype=bool)
        level.z, level.solver = np.zeros_like(self.z), None
        level.solve()
        return level

    def _become(self, other: "PyramidLevel") -> None:
        self.z, self.choosing = other.z, other.choosing
        self.contours, self.solver = other.contours, other.solver

    def occlusions(self) -> OcclusionMap:
        """Find occlusions: places where z steps by more than the normals explain."""
        right, down = (self.grid.image(slope, 0.0) for slope in self.slope)
        return occlusion.depth_steps(self.grid.image(self.z, 0.0), (right, down), self.field.mask, self.least_step)

    def equations(self, stiffness: float, pull: float) -> tuple[Any, Floats, float]:
        """Normal equations of the weighted least squares at the current z: matrix (N, N), right side (N,), energy."""
        grid = self.grid
        weight, flux = self.weight.copy(), self.weight * self.step
        change = self.z[grid.q] - self.z[grid.p]
        energy = 0.0
        if self.choosing.any():
            for part, side in zip((slice(None, grid.turn), slice(grid.turn, None)), self.side):
                energy += self._weigh_neighbors(part, side, change, stiffness, weight, flux)
        certainty = (self.field.sigma / (_GAP * disc_radius(self.field.mask))) ** 2 if self.chords else _GAP_WEIGHT
        weight[self.contours.link] = little = certainty / max(len(self.contours.link), 1)
        flux[self.contours.link] = little * self.contours.step
        diagonal, right = np.full(grid.size, _PROXIMITY), _PROXIMITY * self.z + grid.divergence(flux)
        if self.field.prior is not None:
            diagonal += pull
            right = right + pull * self.field.prior
        return grid.laplacian(weight, diagonal), right, energy

    def _weigh_neighbors(
        self, part: slice, side: Floats, change: Floats, stiffness: float, weight: Floats, flux: Floats
    ) -> float:
        """Write the bilateral weight and flux (L,) of links between choosing pixels of one axis.

        Returns their energy.

        With m ∂z on either side of a pixel, the weight of the side ahead is σ(k (behind² − ahead²)), k the stiffness
        and σ the sigmoid (Cao et al.). Of chords, the energy is not computed.
        """
        facing, grid = self.facing, self.grid
        chosen, both = self._choosing_links(part)
        p, q, step = grid.p[chosen], grid.q[chosen], change[chosen]
        ahead, behind = np.zeros(grid.size), np.zeros(grid.size)  # m ∂z on either side; 0 past the mask
        first, second = facing[p], facing[q]
        ahead[p], behind[q] = first * step, second * step
        forward, backward = (
            _sigmoid(stiffness * (a[e] ** 2 - b[e] ** 2)) for a, b, e in ((behind, ahead, p), (ahead, behind, q))
        )
        at = chosen[both]
        if self.chords:  # a chord holds only where both ends belong to one sheet
            weight[at] *= np.maximum(4 * (forward * backward)[both], _LEAST_TRUST)
            flux[at] = weight[at] * self.step[at]
            return 0.0
        forward *= self.field.weight[p]
        backward *= self.field.weight[q]
        energy = float(forward @ (ahead - side)[p] ** 2 + backward @ (behind - side)[q] ** 2)
        forward *= first
        backward *= second
        weight[at] = (forward * first + backward * second)[both]
        flux[at] = (forward * side[p] + backward * side[q])[both]
        return energy

    def _choosing_links(self, part: slice) -> tuple[NDArray[np.intp], Bools]:
        """Links of one axis with an end that chooses, and which have both ends choosing.

        None where all pixels choose.
        """
        p, q = self.choosing[self.grid.p[part]], self.choosing[self.grid.q[part]]
        chosen = np.flatnonzero(p | q)
        return chosen + (part.start or 0), (p & q)[chosen]


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30.0, 30.0))))
