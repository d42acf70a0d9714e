"""Benchmark of depth from scanned normals: plain least squares, the stage `surface`, bilateral integration.

python tests/benchmarks/bench_scans.py     (POLCAP_DATA/real/scanned_normals)

Prints a row for each object: mean absolute depth error [mm] after the median scale, and CPU seconds. The expected
error of the normals is 1°. `bilateral` is the method of Cao et al. with sparse matrices of SciPy and conjugate
gradients with a diagonal preconditioner.

References
----------
Cao, Santo, Shi, Okura & Matsushita, Bilateral normal integration, ECCV 2022.
"""

from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from polcap.image_values import Floats, View
from polcap.stage_values import SurfaceMaps
from polcap.stages import surface
from polcap.stages.surface.slope_equations import normal_field, slope_terms
from tests.experiments import data, head, plain_maps, row, timed

LEAST_SQUARES, POLCAP = surface.SurfaceSettings(stiffness=0.0), surface.SurfaceSettings()
STIFFNESS = 2.0
ITERATIONS, TOLERANCE = 150, 1e-4


def main() -> None:
    print(head("object", "least squares: mm", "s", "polcap: mm", "s", "bilateral: mm", "s"))
    for folder in sorted((data() / "real/scanned_normals").iterdir()):
        maps, truth = scan(folder)
        works = (partial(integrated, maps, settings) for settings in (LEAST_SQUARES, POLCAP))
        cells: list[object] = []
        for work in (*works, partial(bilateral, maps)):
            depth, seconds = timed(work)
            cells += [mean_error(depth, truth), seconds]
        print(row(folder.name, *cells))


def scan(folder: Path) -> tuple[SurfaceMaps, Floats]:
    """Maps of an object, and its true depth (H, W) [mm]."""
    mask = np.asarray(cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE)) > 0
    normal = np.asarray(cv2.imread(str(folder / "normal_map.png"), cv2.IMREAD_UNCHANGED))[..., ::-1] / 65535 * 2 - 1
    camera = np.loadtxt(folder / "K.txt")
    view = View(float(camera[0, 0]), (float(camera[0, 2]), float(camera[1, 2])), 1.0)
    maps = plain_maps(np.where(mask[..., None], normal, 0).astype(np.float32), mask, view, error_deg=1.0)
    with np.load(folder / "depth_gt.npz") as stored:
        return maps, np.where(mask, stored["depth_gt"].astype(np.float64), np.nan)


def integrated(maps: SurfaceMaps, settings: surface.SurfaceSettings) -> Floats:
    """Depth (H, W) by polcap."""
    return surface.integrate(maps, None, settings).depth


def mean_error(depth: Floats, truth: Floats) -> float:
    """Mean absolute depth error after the median scale [mm]."""
    inside = np.isfinite(truth) & np.isfinite(depth)
    scale = np.median(truth[inside] / depth[inside])
    return float(np.abs(scale * depth - truth)[inside].mean())


def bilateral(maps: SurfaceMaps) -> Floats:
    """Depth (H, W) by bilateral normal integration."""
    field = normal_field(maps, np.radians(89.9), 0.0)
    facing, right, down = slope_terms(field)
    count = len(facing)
    number = np.full(np.add(maps.mask.shape, 2), -1)
    number[1:-1, 1:-1][maps.mask] = np.arange(count)
    row, column = np.nonzero(np.pad(maps.mask, 1))

    def one_sided(rows: int, columns: int) -> sparse.csr_matrix:
        """Matrix (N, N) of facing times the difference towards the neighbor; 0 without a neighbor."""
        other = number[row + rows, column + columns]
        at = np.flatnonzero(other >= 0)
        value = (rows + columns) * facing[at]
        place = (np.concatenate([at, at]), np.concatenate([at, other[at]]))
        return sparse.csr_matrix((np.concatenate([-value, value]), place), (count, count))

    sides = [one_sided(*towards) for towards in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    matrix, target = sparse.vstack(sides).tocsr(), np.concatenate([right, right, down, down])
    weight, z, before = np.full(4 * count, 0.5), np.zeros(count), np.inf
    for _ in range(ITERATIONS):
        weighted = matrix.T @ sparse.diags(weight)
        square = (weighted @ matrix).tocsr()
        inverse = sparse.diags(1 / np.maximum(square.diagonal(), 1e-5))
        z, _ = cg(square, weighted @ target, z, rtol=1e-3, maxiter=5000, M=inverse)
        ahead, behind, below, above = (np.square(side @ z) for side in sides)
        across = 1 / (1 + np.exp(np.clip(STIFFNESS * (ahead - behind), -60, 60)))
        along = 1 / (1 + np.exp(np.clip(STIFFNESS * (below - above), -60, 60)))
        weight = np.concatenate([across, 1 - across, along, 1 - along])
        energy = float(weight @ (matrix @ z - target) ** 2)
        if abs(before - energy) < TOLERANCE * before:
            break
        before = energy
    depth = np.full(maps.mask.shape, np.nan)
    depth[maps.mask] = np.exp((z - np.median(z)) / maps.view.focal)
    return depth


if __name__ == "__main__":
    main()
