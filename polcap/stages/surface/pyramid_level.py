"""One grid of the integration's pyramid: its least-squares equations for the depth, and their solution.

The grid has N pixels and L links between neighbors. The unknown is the scaled log depth z (N,) [px]. Every link has a
depth step by the normals, and a weight. Pixels that choose trust one neighbor more than the other (bilateral
integration), so the surface may be cut between them.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022.
"""

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics.outline import disc_radius
from polcap.stages.surface import occlusion
from polcap.stages.surface.multigrid import Multigrid, PixelGrid, TwoGrid, conjugate_gradients
from polcap.stages.surface.occlusion import OcclusionMap
from polcap.stages.surface.slope_equations import LEAST_FACING, NormalField, block_numbers, slope_terms

REACH = 2  # px around a cut within which pixels choose, also on the next finer grid
GAP = 0.25  # expected depth step behind a contour, over the object's radius
_GAP_WEIGHT = 0.1  # of that expectation, all links together
_DECISION_SOLVES, _FINER_SOLVES = 4, 2  # solutions with choosing pixels, on that grid and on each finer one
_SOFT, _GROWTH = 0.25, 1.2  # first stiffness, over the setting, and its growth: early errors make few cuts
_UNDECIDED_PULL = 0.1  # of the prior's pull during the decision: a prior that strains the normals would cut them
_PRECISE_DEG, _PRECISE_SOLVES = 2.0, 8  # median error of normals below which chords are weighted, and solutions then
_PRECISION = 1e-3  # of each linear solution, relative
_SLOW = 12  # iterations of a linear solution that call for a new hierarchy, which costs as much as 28
_PROXIMITY = 1e-8  # pull towards the last estimate: fixes the offset of each separate part
_LEAST_TRUST = 1e-9  # of both ends in a link: keeps the equations solvable
_BEND = 1 / 12  # variance of a uniform distribution of width 1: a step lies anywhere between its ends' slopes


@dataclass(frozen=True)
class ContourLinks:
    """M pixel links across occluding contours: their depth step is unknown, and a weak prior sets it."""

    link: NDArray[np.intp]  # (M,) numbers of the links
    gap: Floats  # (M,) expected depth behind the contour [px], positive where it grows to the right or down
    step: Floats  # (M,) `gap` plus the slope of the nearer side [px]

    def select(self, at: Any) -> "ContourLinks":
        """The contour links at these indices or where this mask is true."""
        return ContourLinks(self.link[at], self.gap[at], self.step[at])


_NO_CONTOURS = ContourLinks(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0))


class PyramidLevel:
    """Integration on one grid of the pyramid: its equations, and the current solution."""

    facing: Floats  # (N,) coefficient m of the slope equations
    side: tuple[Floats, Floats]  # (N,) each, their right sides n_x and −n_y
    slope: tuple[Floats, Floats]  # (N,) each, ∂z to the right and down by the normals
    step: Floats  # (L,) depth step of each link by the normals
    weight: Floats  # (L,) of that step
    z: Floats  # (N,) scaled log depth [px]
    choosing: Bools  # (N,) pixels that may trust one neighbor more than the other, so that the surface may be cut there
    cuttable: Bools  # (N,) pixels at which the next finer grid may be cut
    contours: ContourLinks  # across occluding contours, without a slope term
    chords: bool  # choosing pixels weight the chord of a link instead of the slopes at its two ends
    solver: Any  # preconditioner of the last matrix, also used for similar matrices

    def __init__(self, field: NormalField, stiffness: float, jump: float) -> None:
        self.field, self.stiffness = field, stiffness
        self.least_step = occlusion.least_step(field.mask, jump)
        self.grid = grid = PixelGrid(field.mask)
        self.facing, right, down = slope_terms(field)
        self.side = (right, down)
        p, q, n = grid.p, grid.q, grid.first_down
        target = np.concatenate([right[p[:n]] + right[q[:n]], down[p[n:]] + down[q[n:]]]) / 2
        facing = (self.facing[p] + self.facing[q]) / 2
        steep = np.maximum(facing, LEAST_FACING)
        self.slope = right / np.maximum(self.facing, LEAST_FACING), down / np.maximum(self.facing, LEAST_FACING)
        bend = self.slope_at(p) - self.slope_at(q)
        # a chord's direction is the mean of its ends' tangents (exact on a circle); its variance is that of the
        # normals' angle plus that of where between the two slopes a bend puts the step
        noise = field.sigma**2 * (1 / field.weight[p] + 1 / field.weight[q]) / 2
        self.step = target / steep
        self.weight = field.sigma**2 / (
            noise * np.maximum(facing**2 + target**2, LEAST_FACING**2) / steep**4 + _BEND * bend**2
        )
        self.z = np.zeros(grid.size)
        self.choosing, self.cuttable = np.zeros(grid.size, dtype=bool), np.ones(grid.size, dtype=bool)
        self.contours = _NO_CONTOURS
        self.precise = field.sigma < np.radians(_PRECISE_DEG)
        self.chords, self.solver = False, None

    def slope_at(self, ends: NDArray[np.intp]) -> Floats:
        """Slope (L,) along each link between pixels, from the normal at one of its ends."""
        first_down = self.grid.first_down
        return np.concatenate([self.slope[0][ends[:first_down]], self.slope[1][ends[first_down:]]])

    def integrate_bilaterally(self, iterations: int, tolerance: float) -> None:
        """Solve z by bilateral integration: every pixel chooses between its neighbors along each axis.

        The stiffness grows from a quarter of the setting to the setting. The iterations end when it is reached and the
        energy changes by a share of less than `tolerance`, or after `iterations`.
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

    def solve(self) -> None:
        """Solve for the depth z, from the current z, with the current contours and choosing pixels."""
        taken = 0
        for _ in range((_PRECISE_SOLVES if self.chords else _DECISION_SOLVES) if self.choosing.any() else 1):
            matrix, right, _ = self.equations(self.stiffness, self.field.pull)
            if self.solver is None or taken > _SLOW:
                self.solver = Multigrid(matrix, self.grid.pixel)
            self.z, taken = conjugate_gradients(matrix, right, self.z, self.solver, _PRECISION, 30)

    def refine(self, coarse: Floats, near_cuts: Bools, solver: Any) -> None:
        """Solve z, starting from the solution `coarse` (n,) of the grid at half the resolution, with its `solver`.

        Only pixels near the cuts of that grid (n,) choose between neighbors.
        """
        block = block_numbers(self.field.mask)
        # inside a 2×2 block z follows the slopes of its pixels
        row, column = self.grid.row % 2 - 0.5, self.grid.column % 2 - 0.5
        tilt = (column * self.side[0] + row * self.side[1]) / np.maximum(self.facing, 0.1)
        self.z = np.asarray(2 * coarse[block] + tilt)  # px are half as wide
        self.chords = self.precise
        self.choosing = self.cuttable = near_cuts[block] & (self.stiffness > 0)
        for _ in range(_FINER_SOLVES if self.choosing.any() else 1):
            matrix, right, _ = self.equations(self.stiffness, self.field.pull)
            self.solver = TwoGrid(matrix, block, solver)
            self.z, _ = conjugate_gradients(matrix, right, self.z, self.solver, _PRECISION, 20)

    def without_cuts(self) -> "PyramidLevel":
        """A copy of this grid solved by plain least squares, without cuts."""
        level = copy(self)
        level._remove_all_cuts()
        return level

    def _remove_all_cuts(self) -> None:
        self.contours, self.choosing = _NO_CONTOURS, np.zeros(self.grid.size, dtype=bool)
        self.z, self.solver = np.zeros_like(self.z), None
        self.solve()

    def close_cuts(self, pixels: Bools) -> None:
        """Remove the surface's cuts at these pixels (N,), and solve z again.

        The pixels no longer choose between neighbors, and their links have slopes again. If no cut is left, z is that
        of plain least squares.
        """
        self.choosing = self.choosing & ~pixels
        self.contours = self.contours.select(~pixels[self.grid.p[self.contours.link]])
        self.solve()
        if not self.occlusions().any():
            self._remove_all_cuts()

    def near_cuts(self) -> Bools:
        """Mask (N,) of the pixels near the cuts of the surface."""
        return self.occlusions().near(REACH)[self.field.mask] & self.cuttable

    def occlusions(self) -> OcclusionMap:
        """Find occlusions: places where z steps by more than the normals explain."""
        right, down = (self.grid.image(slope, 0.0) for slope in self.slope)
        return occlusion.depth_steps(self.grid.image(self.z, 0.0), (right, down), self.field.mask, self.least_step)

    def slope_residuals(self) -> Floats:
        """Squared slope residual of each link (L,), in units of the variance of the median normal."""
        change = self.z[self.grid.q] - self.z[self.grid.p]
        return np.asarray(self.weight * (change - self.step) ** 2 / self.field.sigma**2)

    def equations(self, stiffness: float, pull: float) -> tuple[Any, Floats, float]:
        """Normal equations of the weighted least squares at the current z: matrix (N, N), right side (N,), energy.

        `pull` is the weight of the depth prior in each pixel.
        """
        grid = self.grid
        weight, flux = self.weight.copy(), self.weight * self.step
        change = self.z[grid.q] - self.z[grid.p]
        energy = 0.0
        if self.choosing.any():
            for part, side in zip((slice(None, grid.first_down), slice(grid.first_down, None)), self.side):
                energy += self._weigh_neighbors(part, side, change, stiffness, weight, flux)
        certainty = (self.field.sigma / (GAP * disc_radius(self.field.mask))) ** 2 if self.chords else _GAP_WEIGHT
        weight[self.contours.link] = of_gap = certainty / max(len(self.contours.link), 1)
        flux[self.contours.link] = of_gap * self.contours.step
        diagonal, right = np.full(grid.size, _PROXIMITY), _PROXIMITY * self.z + grid.divergence(flux)
        if self.field.prior is not None:
            diagonal += pull
            right = right + pull * self.field.prior
        return grid.laplacian(weight, diagonal), right, energy

    def _weigh_neighbors(
        self, part: slice, side: Floats, change: Floats, stiffness: float, weight: Floats, flux: Floats
    ) -> float:
        """Write the bilateral weight and flux (L,) of the links between choosing pixels along one axis, in place.

        With m ∂z ahead of a pixel and behind it, the weight of the side ahead is σ(k (behind² − ahead²)), k the
        stiffness and σ the sigmoid (Cao et al.). Returns the energy of these links; 0 for chords, which do not need it.
        """
        facing, grid = self.facing, self.grid
        ends = self.choosing[grid.p[part]].astype(int) + self.choosing[grid.q[part]]  # choosing ends of each link
        chosen, both = np.flatnonzero(ends) + (part.start or 0), ends[ends > 0] == 2
        p, q, step = grid.p[chosen], grid.q[chosen], change[chosen]
        ahead, behind = np.zeros(grid.size), np.zeros(grid.size)  # m ∂z on either side; 0 past the mask
        first, second = facing[p], facing[q]
        ahead[p], behind[q] = first * step, second * step
        forward = _sigmoid(stiffness * (behind[p] ** 2 - ahead[p] ** 2))
        backward = _sigmoid(stiffness * (ahead[q] ** 2 - behind[q] ** 2))
        at = chosen[both]
        if self.chords:  # a chord holds only where both ends belong to one sheet
            weight[at] *= np.maximum(4 * (forward * backward)[both], _LEAST_TRUST)  # 1 if both ends are undecided
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


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30.0, 30.0))))
