"""Normals of one surface: their slopes are the derivatives of one depth (integrability).

A pixel at the distance ρ from the camera, on the ray through (a, b) of the image plane at distance 1, has the slopes
g = (∂ ln ρ/∂a, ∂ ln ρ/∂b), which its normal determines. Slopes from estimated normals are the gradient of no function.
Polarization shows the azimuth of a normal better than its zenith angle. So the ln ρ that fits best is that of weighted
least squares, with a small error of each slope across its own direction and a larger one along it. A cell at a depth
step belongs to no common surface. There the curl of the slopes or the residual of the fit is large, so the cell counts
little and its normals stay as they are.

References
----------
Frankot and Chellappa, A method for enforcing integrability in shape from shading algorithms, IEEE PAMI 1988.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.resize import area_mean, weighted_area_mean

# docs/benchmarks/surface.md
_LONGEST = 200  # cells of the grid's longer side
_ALONG, _ACROSS = 0.8, 0.4  # 1σ of zenith angle and azimuth (as an arc), over the expected error of the normal
_OUTLIER, _CURL = 2.5, 1.0  # σ: Cauchy's scales of the residuals, and of the curl
_PASSES = 4  # of the reweighted least squares
_TWIST = 0.05  # weight of the second mixed difference, which no slope of a cell determines
_ERROR_DEG = (0.1, 6.0)  # range of the expected error that counts; more is a wrong side or an unknown law of regions
_LEAST_COSINE = 0.05
_DAMPING = 1e-9  # of the mean diagonal element
_SYMMETRIC: dict[str, Any] = {  # SuperLU needs half the time for a symmetric matrix without pivoting
    "permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True},
}  # fmt: skip


def make_integrable(normal: Floats, error: Floats, mask: Bools, rays: Floats) -> Floats:
    """Replace the coarse part of unit normals (H, W, 3) by that of one surface, except at depth steps.

    `error` (H, W) is their expected error [degrees]; `mask` (H, W) is the object's; `rays` (H, W, 3) are the view rays.
    """
    shrink = max(1.0, max(mask.shape) / _LONGEST)
    shape = tuple(max(8, round(side / shrink)) for side in mask.shape)
    inside = area_mean(mask, shape) > 0.5
    if not inside.any():
        return normal * mask[..., None]
    coarse = frames.unit(weighted_area_mean(normal, mask, shape))
    sigma = np.radians(weighted_area_mean(np.clip(error, *_ERROR_DEG), mask, shape))[inside]
    towards = frames.unit(area_mean(rays, shape))
    found, fit_weight = _fit_surface(coarse, sigma, inside, towards)
    change = np.zeros(coarse.shape, np.float32)
    weight = np.zeros(shape, np.float32)
    change[inside], weight[inside] = found - coarse[inside], fit_weight
    change *= cv2.erode(weight, np.ones((3, 3), np.uint8))[..., None] ** 2  # a cell counts as its least neighbor
    return frames.unit(normal + cv2.resize(change, mask.shape[::-1])) * mask[..., None]


def _fit_surface(normal: Floats, sigma: Floats, inside: Bools, rays: Floats) -> tuple[Floats, Floats]:
    """Normals (N, 3) of the best surface in the cells `inside` (h, w), and their weights (N,) in the fit.

    `sigma` (N,) is the expected error [rad].
    """
    from scipy import sparse  # here: importing it costs .2 s of every start
    from scipy.sparse.linalg import splu

    along_a, along_b = np.gradient(rays, axis=1)[inside], -np.gradient(rays, axis=0)[inside]  # changes per cell
    cell = np.sqrt(frames.dot(along_a, along_a)).mean()  # width of a cell, rad
    towards, n = rays[inside], normal[inside]
    cosine = np.maximum(frames.dot(n, towards), _LEAST_COSINE)
    slope = -np.stack([frames.dot(n, along_a), frames.dot(n, along_b)]) / cosine  # per cell, (2, N)
    steepness, direction = np.hypot(*slope), np.arctan2(slope[1], slope[0])
    corner = _corners(inside)  # (4, N)
    rows, size = np.arange(len(n)), corner.max() + 1

    def difference(*weights: Floats | float) -> sparse.csr_matrix:
        """Matrix (N, corners) of a weighted sum over each cell's four corners."""
        values = np.concatenate([np.broadcast_to(w, len(n)) for w in weights])
        return sparse.csr_matrix((values, (np.tile(rows, 4), corner.ravel())), (len(n), size))

    def derivative(angle: Floats | float) -> sparse.csr_matrix:
        """Matrix (N, corners) of the derivative in the direction `angle` (N,) rad from a towards b."""
        a, b = np.cos(angle), np.sin(angle)
        return difference((b - a) / 2, (b + a) / 2, (-b - a) / 2, (a - b) / 2)

    across, along = derivative(direction + np.pi / 2), derivative(direction)
    # of slopes tan θ: the zenith's error by d tan θ/dθ, an arc across by tan θ/sin θ
    sigma_across, sigma_along = _ACROSS * sigma / cosine * cell, _ALONG * sigma / cosine**2 * cell
    equations = sparse.vstack(
        [
            sparse.diags(1 / sigma_across) @ across,
            sparse.diags(1 / sigma_along) @ along,
            sparse.diags(_TWIST / sigma_along) @ difference(1.0, -1.0, -1.0, 1.0),
        ]
    ).tocsr()
    right = np.concatenate([np.zeros(len(n)), steepness / sigma_along, np.zeros(len(n))])
    curl_weight = _weigh_curl(slope, sigma_along, inside)
    weight = curl_weight
    for _ in range(_PASSES):
        weighted = equations.T @ sparse.diags(np.tile(weight, 3))
        matrix = (weighted @ equations).tocsc()
        damping = _DAMPING * float(matrix.diagonal().mean())  # each separate part has a free distance
        damped = matrix + damping * sparse.identity(size, format="csc")
        log_distance = splu(damped, **_SYMMETRIC).solve(weighted @ right)
        residual = (equations @ log_distance - right).reshape(3, -1)[:2]
        weight = curl_weight / (1 + (residual**2).sum(axis=0) / _OUTLIER**2)
    g_a, g_b = derivative(0.0) @ log_distance, derivative(np.pi / 2) @ log_distance
    # the surface's tangents along a and b, over ρ: the derivatives of −e^(ln ρ) rays
    found = np.cross(g_a[:, None] * towards + along_a, g_b[:, None] * towards + along_b)
    return frames.unit(found * np.sign(frames.dot(found, towards))[:, None]), weight


def _weigh_curl(slope: Floats, sigma: Floats, inside: Bools) -> Floats:
    """Weights 1/(1 + (c/_CURL)²) (N,) of cells: c is the largest curl of slopes (2, N) at a corner, over `sigma`."""
    a, b, error = (np.zeros(inside.shape) for _ in range(3))
    a[inside], b[inside], error[inside] = *slope, sigma
    two = np.ones((2, 2), np.uint8)
    curl = np.zeros((inside.shape[0] + 1, inside.shape[1] + 1))
    complete = cv2.erode(inside.astype(np.uint8), two, borderValue=0)[1:, 1:] > 0  # all four cells around a corner
    twice = np.diff(b, axis=1)[:-1] + np.diff(b, axis=1)[1:] + np.diff(a, axis=0)[:, :-1] + np.diff(a, axis=0)[:, 1:]
    largest_error = cv2.dilate(error, two)[1:, 1:]
    curl[1:-1, 1:-1][complete] = (twice / 2 / np.maximum(largest_error, 1e-9))[complete]
    return np.asarray(1 / (1 + (cv2.dilate(abs(curl), two)[1:, 1:][inside] / _CURL) ** 2))


def _corners(inside: Bools) -> NDArray[np.intp]:
    """Numbers (4, N) of the corners of each cell `inside` (h, w): upper left, upper right, lower left, lower right."""
    height, width = inside.shape
    used = np.zeros((height + 1, width + 1), bool)
    parts = [np.s_[y : y + height, x : x + width] for y in (0, 1) for x in (0, 1)]
    for part in parts:
        used[part] |= inside
    number = np.cumsum(used).reshape(used.shape) - 1
    return np.stack([number[part][inside] for part in parts])
