"""Normals of the object's pixels -> scaled log depth z, by least squares with jumps where the surface hides itself.

Which pixels lie at a jump is decided on a grid of at most `_DECIDED` pixels, by bilateral integration: there noise
is small against a pixel's own bend, and how much of it there is does not depend on the camera. On finer grids only
the pixels near those jumps may choose between their neighbours; all others keep both. So a finer picture refines the
contour and cannot tear the surface.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022: each pixel trusts whichever of its two
neighbours per axis continues its own tangent plane.
"""

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.surface.contacts import contacts
from polcap.stages.surface.multigrid import Multigrid, Nested, conjugate_gradients
from polcap.stages.surface.occlusion import Jumps, jumps, least_step, radius, widened
from polcap.stages.surface.pixel_grid import PixelGrid
from polcap.stages.surface.rims import contours, rims
from polcap.stages.surface.slope_equations import Problem, equations, halved, parents

_DECIDED = 80_000  # pixels, at most, of the grid on which jumps are decided
_SOFT, _ANNEAL = 0.25, 1.2  # stiffness at first, and its growth per iteration: few early errors are kept as jumps
_REFINED = 2  # solutions on each finer grid with jumps
_MENDED = 4  # solutions on the grid that decides, after tears were found
_UNDECIDED = 0.1  # of the prior's pull while jumps are sought: where it strains the normals it tears them
_REACH = 2  # px around a jump within which pixels choose their neighbours on the next finer grid
_TIRED = 12  # iterations of a linear solution that call for a new multigrid hierarchy, which costs as much as 28
_BESIDE = 10  # px from a contour of jumps within which it is asked what it is worth
_STRAIN = 1.0  # σ² per link of a contour by which the surface beside it may fit its normals worse than without cuts
_STRAINED = 1.4  # the same as a factor; both have to be passed
_SEWN = 2  # rounds of sewing what is worth nothing
_GAP = 0.25  # depth behind a limb, over the object's radius, where nothing else tells it
_OPEN = 0.3  # share of that gap which opens where a part is free indeed
_SURE = 1 / 16  # weight of a normal under which it tells of no limb: an error four times the median
_HOVER = 0.1  # weight of that, of all limbs together
_ACCURACY = 1e-3  # of each linear solution, relative
_PROXIMITY = 1e-8  # pulls towards the last estimate: fixes what the normals leave free (one offset per piece)
_FLATTEST = 0.05  # cosine under which a normal tells no slope
_TURNED = 1 / 12  # variance of a step that lies anywhere between its ends' slopes, over their difference squared


def log_depth(of: Problem, stiffness: float, iterations: int, tolerance: float, jump: float) -> Floats:
    """z of the object's pixels (N,).

    Parameters
    ----------
    of
        Normals, weights and prior of N pixels.
    stiffness
        How firmly jumps are kept; 0 = plain least squares.
    iterations, tolerance
        Of the reweighting on the grid that decides: at most so many, or the energy's change.
    jump
        Least depth step of a jump over the object's radius.
    """
    z, _, _ = _solved(of, stiffness, iterations, tolerance, jump)
    return z


def _solved(
    of: Problem, stiffness: float, iterations: int, tolerance: float, jump: float
) -> tuple[Floats, NDArray[np.bool_], Any]:
    """z (N,), the pixels near its jumps (H, W), and a preconditioner for matrices of this level."""
    level = _Level(of)
    if level.grid.size <= _DECIDED:
        if stiffness > 0:
            level.leave_limbs()
        z = level.decided(stiffness, iterations, tolerance)
        level.close_limbs(z)
        decided = level.jumps(z, jump / 2)
        free = ~widened(decided.torn, _REACH)[of.mask] & (stiffness > 0) & decided.any()
        if not free.any():
            z = np.zeros_like(z)  # nothing of what was tried is left: plain least squares, to the last bit
        z, solver = level.mended(z, free, stiffness)
        z, solver = level.sewn(z, solver, free, stiffness, jump / 2)
        z, solver = level.joined(z, solver, free, stiffness, jump / 2)
        return z, level.jumps(z, jump / 2).near(_REACH), solver
    coarse, parent = halved(of), parents(of.mask)
    start, at_jumps, solver = _solved(coarse, stiffness, iterations, tolerance, jump)
    z = level.finer(start, parent)
    free = at_jumps[coarse.mask][parent] & (stiffness > 0)
    z, nested = level.refined(z, free, stiffness, parent, solver)
    found = level.jumps(z, jump / 2).near(_REACH)
    return z, found & level.grid.image(free, outside=False), nested


class _Level:
    """The equations of one pyramid level."""

    def __init__(self, of: Problem) -> None:
        self.of = of
        self.grid = grid = PixelGrid(of.mask)
        self.facing, right, down = equations(of)
        self.side = (right, down)
        p, q, turn = grid.p, grid.q, grid.turn
        target = np.concatenate([right[p[:turn]] + right[q[:turn]], down[p[turn:]] + down[q[turn:]]]) / 2
        facing = (self.facing[p] + self.facing[q]) / 2
        steep = np.maximum(facing, _FLATTEST)
        self.slope = tuple(side / np.maximum(self.facing, _FLATTEST) for side in self.side)
        turned = self._along(p) - self._along(q)
        # a chord's direction is the mean of its ends' tangents (exact on a circle); its variance is that of the
        # normals' angle plus that of where between the two slopes a bend puts the step
        noise = of.sigma**2 * (1 / of.weight[p] + 1 / of.weight[q]) / 2
        self.step = target / steep
        self.chord = of.sigma**2 / (
            noise * np.maximum(facing**2 + target**2, _FLATTEST**2) / steep**4 + _TURNED * turned**2
        )
        self.limb = np.zeros(0, dtype=np.intp)  # links that leave a limb
        self.gap = self.leap = np.zeros(0)  # usual depth behind it, positive to the right or down; that and its slope

    def leave_limbs(self) -> None:
        """From now on, links between a limb and what it hides tell no slope, and pull a little towards a usual gap."""
        sure = self.of.weight > _SURE
        lean = [np.where(sure, np.arctan2(side, np.maximum(self.facing, 1e-6)), np.nan) for side in self.side]
        found = rims((self.grid.image(lean[0]), self.grid.image(lean[1])), self.of.mask)
        mask = self.of.mask
        sign = np.concatenate([found.right[mask[:, :-1] & mask[:, 1:]], found.down[mask[:-1] & mask[1:]]])
        self.limb = np.flatnonzero(sign)
        self.gap = _GAP * radius(mask) * sign[self.limb]
        first, second = (self._along(ends)[self.limb] for ends in (self.grid.p, self.grid.q))
        self.leap = self.gap + np.where(self.gap > 0, first, second)

    def close_limbs(self, z: Floats) -> None:
        """Limbs behind which z opens no gap, because the surface holds together around them, are none."""
        p, q = self.grid.p[self.limb], self.grid.q[self.limb]
        open_ = (z[q] - z[p] - self.leap + self.gap) / self.gap
        at = np.zeros(self.grid.size, dtype=bool)
        at[p] = True
        contour = contours(self.grid.image(at, outside=False))[self.of.mask][p]
        stays = [number for number in np.unique(contour) if np.median(open_[contour == number]) > _OPEN]
        kept = np.isin(contour, stays)
        self.limb, self.gap, self.leap = self.limb[kept], self.gap[kept], self.leap[kept]

    def _along(self, ends: Any) -> Floats:
        """The slopes (L,) along the links at one end of each."""
        return np.concatenate([slope[part] for slope, part in zip(self.slope, self._halves(ends))])

    def _halves(self, links: Any) -> tuple[Any, Any]:
        """What belongs to links to the right, and to links down."""
        return links[: self.grid.turn], links[self.grid.turn :]

    def decided(self, stiffness: float, iterations: int, tolerance: float) -> Floats:
        """Bilateral integration of all pixels, its stiffness growing from `_SOFT`, with a tenth of the prior's pull."""
        z: Floats = np.zeros(self.grid.size)
        before, taken, solver = np.inf, _TIRED + 1, None
        free = np.full(self.grid.size, True)
        for count in range(iterations if stiffness > 0 else 0):
            firm = stiffness * min(1.0, _SOFT * _ANNEAL**count)
            matrix, right, energy = self.linear(z, free, firm, _UNDECIDED * self.of.pull)
            if firm == stiffness and abs(before - energy) <= tolerance * energy:
                break
            before = energy
            if solver is None or taken > _TIRED:  # until then, an older matrix's multigrid still serves
                solver = Multigrid(matrix, self.grid.pixel)
            z, taken = conjugate_gradients(matrix, right, z, solver, _ACCURACY, 30)
        return z

    def mended(
        self, z: Floats, free: NDArray[np.bool_], stiffness: float, solver: Multigrid | None = None
    ) -> tuple[Floats, Multigrid]:
        """From the decision, or a solution and its solver: fewer pixels may choose, all of the prior's pull."""
        taken = 0
        for _ in range(_MENDED if free.any() else 1):
            matrix, right, _ = self.linear(z, free, stiffness, self.of.pull)
            if solver is None or taken > _TIRED:
                solver = Multigrid(matrix, self.grid.pixel)
            z, taken = conjugate_gradients(matrix, right, z, solver, _ACCURACY, 30)
        assert solver is not None
        return z, solver

    def sewn(
        self, z: Floats, solver: Multigrid, free: NDArray[np.bool_], stiffness: float, least: float
    ) -> tuple[Floats, Multigrid]:
        """From z and its solver: contours of jumps that do not pay are closed, their pixels taken out of `free`.

        A true jump relieves the surface about it, for slopes that no longer have to bridge it fit their normals. One
        beside which they fit worse than on a surface without cuts is none.
        """
        whole: tuple[Floats, Multigrid] | None = None
        for _ in range(_SEWN):
            found = self.jumps(z, least)
            if not found.any() or not free.any():
                break
            if whole is None:
                whole = self._without_limbs().mended(np.zeros_like(z), np.zeros_like(free), stiffness)
            close = self._worthless(found, self._strain(whole[0]), self._strain(z))
            if not close.any():
                break
            z, solver = self._closed(z, solver, free, close, stiffness)
            if not self.jumps(z, least).any():
                free[:] = False
                return whole  # plain least squares, to the last bit
        return z, solver

    def joined(
        self, z: Floats, solver: Multigrid, free: NDArray[np.bool_], stiffness: float, least: float
    ) -> tuple[Floats, Multigrid]:
        """From z and its solver: parts that stand free are joined where they touch, the pixels taken out of `free`."""
        found = self.jumps(z, least)
        if not found.any() or not free.any():
            return z, solver
        grid, apart = self.grid, self._jumping(found)
        apart[self.limb] = True
        step, ends = z[grid.q] - z[grid.p], (self._along(grid.p), self._along(grid.q))
        touch = contacts(grid, apart, step - np.clip(step, np.minimum(*ends), np.maximum(*ends)), radius(self.of.mask))
        if not touch.any():
            return z, solver
        at = np.zeros(grid.size, dtype=bool)
        at[grid.p[touch]] = at[grid.q[touch]] = True
        close = widened(grid.image(at, outside=False), _REACH)[self.of.mask]
        z, solver = self._closed(z, solver, free, close, stiffness)
        if not self.jumps(z, least).any():
            free[:] = False  # plain least squares, to the last bit
            return self._without_limbs().mended(np.zeros_like(z), free, stiffness)
        return z, solver

    def _closed(
        self, z: Floats, solver: Multigrid, free: NDArray[np.bool_], close: NDArray[np.bool_], stiffness: float
    ) -> tuple[Floats, Multigrid]:
        """From z and its solver: pixels to close (N,) lose choice and limb."""
        free &= ~close
        stays = ~close[self.grid.p[self.limb]]
        self.limb, self.gap, self.leap = self.limb[stays], self.gap[stays], self.leap[stays]
        return self.mended(z, free, stiffness, solver)

    def _jumping(self, found: Jumps) -> NDArray[np.bool_]:
        """Links (L,) at jumps."""
        mask = self.of.mask
        return np.concatenate([found.right[mask[:, :-1] & mask[:, 1:]], found.down[mask[:-1] & mask[1:]]])

    def _without_limbs(self) -> "_Level":
        level = copy(self)
        level.limb, level.gap, level.leap = np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0)
        return level

    def _strain(self, z: Floats) -> Floats:
        """How badly z fits the slope of each link (L,), in variances of the median normal."""
        return np.asarray(self.chord * (z[self.grid.q] - z[self.grid.p] - self.step) ** 2 / self.of.sigma**2)

    def _worthless(self, found: Jumps, whole: Floats, cut: Floats) -> NDArray[np.bool_]:
        """Pixels (N,) about contours of jumps beside which links are strained more (L,) than with no cut at all."""
        mask, p = self.of.mask, self.grid.p
        jumping = self._jumping(found)
        contour = contours(found.near(0))
        links = np.bincount(contour[mask][p], jumping, minlength=int(contour.max()) + 1)
        close = np.zeros(mask.shape, dtype=bool)
        for number in np.flatnonzero(links[1:]) + 1:
            at = contour == number
            beside = widened(at, _BESIDE)[mask][p] & ~widened(at, 1)[mask][p]
            without, with_it = (strain[beside & ~jumping].sum() / links[number] for strain in (whole, cut))
            if with_it > max(without + _STRAIN, _STRAINED * without):
                close |= widened(at, _REACH)
        return np.asarray(close[mask])

    def refined(
        self, z: Floats, free: NDArray[np.bool_], stiffness: float, parent: Any, coarse: Any
    ) -> tuple[Floats, "Nested"]:
        """From the solution at half the resolution; only `free` pixels choose between neighbours."""
        solver = None
        for _ in range(_REFINED if free.any() else 1):
            matrix, right, _ = self.linear(z, free, stiffness, self.of.pull)
            solver = Nested(matrix, parent, coarse)
            z, _ = conjugate_gradients(matrix, right, z, solver, _ACCURACY, 20)
        assert solver is not None
        return z, solver

    def linear(self, z: Floats, free: NDArray[np.bool_], stiffness: float, pull: float) -> tuple[Any, Floats, float]:
        """Matrix and right side of the weighted least squares about z, and z's energy."""
        grid, facing = self.grid, self.facing
        link, flux = self.chord.copy(), self.chord * self.step
        change = z[grid.q] - z[grid.p]
        energy = 0.0
        if free.any():
            for part, side in zip((slice(None, grid.turn), slice(grid.turn, None)), self.side):
                chosen, both = self._choosing(free, part)
                p, q, step = grid.p[chosen], grid.q[chosen], change[chosen]
                ahead, behind = np.zeros(grid.size), np.zeros(grid.size)  # m ∂z on either side; 0 past the mask
                first, second = facing[p], facing[q]
                ahead[p], behind[q] = first * step, second * step
                forward, backward = (
                    _sigmoid(stiffness * (a[e] ** 2 - b[e] ** 2))
                    for a, b, e in ((behind, ahead, p), (ahead, behind, q))
                )
                forward *= self.of.weight[p]
                backward *= self.of.weight[q]
                energy += float(forward @ (ahead - side)[p] ** 2 + backward @ (behind - side)[q] ** 2)
                forward *= first
                backward *= second
                at = chosen if both is None else chosen[both]
                link[at] = _where(forward * first + backward * second, both)
                flux[at] = _where(forward * side[p] + backward * side[q], both)
        link[self.limb] = weight = _HOVER / max(len(self.limb), 1)
        flux[self.limb] = weight * self.leap
        diagonal, right = np.full(grid.size, _PROXIMITY), _PROXIMITY * z + grid.divergence(flux)
        if self.of.prior is not None:
            diagonal += pull
            right = right + pull * self.of.prior
        return grid.laplacian(link, diagonal), right, energy

    def _choosing(self, free: NDArray[np.bool_], part: slice) -> tuple[Any, NDArray[np.bool_] | None]:
        """The links of a part with an end among `free` pixels (N,), and which of them have both; None: all of them."""
        if free.all():
            return part, None
        p, q = free[self.grid.p[part]], free[self.grid.q[part]]
        chosen = np.flatnonzero(p | q)
        return chosen + (part.start or 0), (p & q)[chosen]

    def finer(self, coarse: Floats, parent: NDArray[np.intp]) -> Floats:
        """z from that of half the resolution: each block tilted by its pixels' own slopes."""
        steep = np.maximum(self.facing, 0.1)
        row, column = self.grid.row % 2 - 0.5, self.grid.column % 2 - 0.5
        tilt = (column * self.side[0] + row * self.side[1]) / steep
        return np.asarray(2 * coarse[parent] + tilt)

    def jumps(self, z: Floats, least: float) -> Jumps:
        right, down = (self.grid.image(slope, 0.0) for slope in self.slope)
        return jumps(self.grid.image(z, 0.0), (right, down), self.of.mask, least_step(self.of.mask, least))


def _where(value: Floats, these: NDArray[np.bool_] | None) -> Floats:
    return value if these is None else value[these]


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30.0, 30.0))))
