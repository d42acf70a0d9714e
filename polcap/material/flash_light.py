"""Place of the flash, its energy in each view and each shot, from the board's paper; its scale from the chart.

The paper around the sample is flat, evenly white and unpolarized. Its radiance in view k is

    S0 = c_k cos θ / d² (1 + s L)

with the distance d to the flash, the angle θ between the page's normal and the flash, and the highlight L of GGX
facets, which is weak and broad on matt paper. A robust fit of all views gives the flash's place next to the lens, the
share s of the highlight and its roughness. The factor c_k is then a mean over the points of view k. Where S1 and S2 of
the paper are not 0, the shots of a view had different energies, and a matrix corrects them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from polcap.chart_values import ColorCalibration
from polcap.image_values import Bools, Floats, Indices, Quality
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_grid import FlashLight
from polcap.optics import board as boards
from polcap.optics import brdf, distortion, frames, mueller
from polcap.optics.board import Board
from polcap.optics.projection import back_project, from_grid
from polcap.stages import stage

_STEP_M = 0.001  # between the points of the paper that are sampled
_MARGIN_PX = 3.0  # between such a point and the nearest ink; demosaicing errs by 2 % nearer to it
_FITTED = 800  # points of a view in the fit, about
LEAST_POINTS = 60  # of the paper, in a view
_FLASH_SIGMA_M = 0.08  # 1σ of the flash's position about the lens, prior
_ROUNDS, _OUTLIER = 3, 4.0  # of the fit; robust standard deviations, beyond which points are left out
_SCATTER = 0.02  # relative 1σ of paper about Lambert's law
_UNUSABLE = np.uint8(Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST | Quality.DARK)
PAPER = 0.8  # albedo of matt paper, for sessions without a chart
_SHARE_SIGMA = 0.1  # 1σ of s about 0, prior; s is F0 over the paper's albedo
_GLOSS = (0.2, 0.4, 0.7)  # roughness of the highlight, with which the search starts
_PLACE, _SHARE, _ROUGHNESS = slice(0, 3), 3, 4  # in a law (5,) of the paper: flash [m], s, roughness of the highlight
_LOW, _HIGH = [-0.5, -0.5, -0.5, 0.0, 0.08], [0.5, 0.5, 0.5, 0.3, 1.0]  # limits of a law
_STEP = [0.01, 0.01, 0.01, 0.01, 0.05]  # scales of the search for a law


@dataclass(frozen=True)
class ChartInView:
    """The chart of the session: color calibration of the view that shows it, and the view's place in the session."""

    view: int
    color: ColorCalibration


@stage(version=3)
def measure(views: tuple[PosedStokes, ...], chart: ChartInView | None, board: Board) -> FlashLight:
    """Flash and light of all views; without a chart the paper's albedo gives the scale.

    Each view must show `LEAST_POINTS` points of the paper or more.
    """
    samples = [sample_paper(view, board) for view in views]
    used = [np.ones(len(one.radiance), bool) for one in samples]
    starts = [np.array([0.0, 0.0, 0.0, 0.02, rough]) for rough in _GLOSS]
    for _ in range(_ROUNDS):
        law = _fit(samples, used, starts)
        starts, errors = [law], [_log_error(one, law) for one in samples]
        errors = [error - float(np.median(error[use])) for error, use in zip(errors, used, strict=True)]
        spread = 1.48 * np.median(np.abs(np.concatenate(errors)))  # robust 1σ
        used = [np.abs(error) < _OUTLIER * spread for error in errors]
    logs = [_log_error(one, law)[use] for one, use in zip(samples, used, strict=True)]
    energy = np.exp([float(log.mean()) for log in logs])  # c_k
    residual = np.concatenate([log - np.log(c) for log, c in zip(logs, energy, strict=True)])
    place = law[_PLACE]
    # the color calibration makes radiance in the chart's place the albedo
    albedo = PAPER if chart is None else float(energy[chart.view] * _chart_irradiance(views[chart.view], chart, place))
    return FlashLight(
        place=place,
        gain=energy / albedo,
        shot_matrix=np.stack([_shot_matrix(*one) for one in zip(views, samples, used, strict=True)]),
        sigma=float(residual.std()),
        paper=albedo,
        shine=max(float(_highlight(one, law).max()) for one in samples),
    )


@dataclass(frozen=True)
class PaperSamples:
    """Points of the paper in one view."""

    point: Floats  # (M, 3) m, camera frame
    normal: Floats  # (3,) of the page, camera frame
    radiance: Floats  # (M,) S0, gray
    ratio: Floats  # (M, 2, 3) S1/S0 and S2/S0 of each channel

    def take(self, index: Indices) -> "PaperSamples":
        """Some of the points."""
        return replace(self, point=self.point[index], radiance=self.radiance[index], ratio=self.ratio[index])


def sample_paper(view: PosedStokes, board: Board) -> PaperSamples:
    """Samples of the paper in a view: pixels of usable quality, away from ink."""
    distance = float(np.linalg.norm(view.pose.translation))
    margin = _MARGIN_PX * distance * view.stokes.view.scale / view.camera.focal_px
    world = _paper_points(board, margin)
    x, y = view.pixels(world)
    height, width = view.stokes.mask.shape
    inside = (x >= 1) & (y >= 1) & (x <= width - 2) & (y <= height - 2)
    column, row = (np.rint(a[inside]).astype(int) for a in (x, y))
    stokes = np.asarray(view.stokes.stokes[:, row, column])  # (3, M, 3)
    good = ((view.stokes.quality[row, column] & _UNUSABLE) == 0) & (stokes[0].min(axis=-1) > 0)
    stokes, world = stokes[:, good], world[inside][good]
    radiance = gray(view.matrix) @ stokes[0].T
    ratio = np.moveaxis(stokes[1:] / stokes[0], 0, 1)
    return PaperSamples(view.pose.to_camera(world), view.pose.rotation[:, 1], radiance, ratio)


def gray(matrix: Floats) -> Floats:
    """Equal weights (3,) of camera channels, with which white is 1; `matrix` converts them to linear Rec.709."""
    return np.full(3, 1 / np.linalg.inv(np.asarray(matrix, np.float64)).sum())


def gray_of_colors(matrix: Floats) -> Floats:
    """Weights (3,) of colors in linear Rec.709 that give the same gray as `gray` gives of camera channels."""
    total = np.linalg.inv(np.asarray(matrix, np.float64)).sum(axis=0)
    return np.asarray(total / total.sum())


def _paper_points(board: Board, margin: float) -> Floats:
    """World points (M, 3) [m] on paper, with paper `margin` [m] around, in the page's middle square, as wide as it."""
    half = board.page_m[0] / 2 - margin
    axis = np.arange(-half, half, _STEP_M)
    x, z = (a.ravel() for a in np.meshgrid(axis, axis))
    clear = np.ones(len(x), bool)
    for turn in np.arange(8) * np.pi / 4:
        clear &= ~boards.is_ink(board, x + margin * np.cos(turn), z + margin * np.sin(turn))
    return np.stack([x, 0 * x, z], axis=-1)[clear]


def _log_error(samples: PaperSamples, law: Floats) -> Floats:
    """ln (M,) of the measured radiance over that of a law (5,) for c_k = 1."""
    light = _irradiance(samples.point, samples.normal, law[_PLACE]) * (1 + _highlight(samples, law))
    return np.asarray(np.log(samples.radiance / light))


def _highlight(samples: PaperSamples, law: Floats) -> Floats:
    """Highlight s L (M,) of a law (5,), relative to the diffuse reflection."""
    to_light, ray = frames.unit(law[_PLACE] - samples.point), frames.unit(-samples.point)
    half = frames.unit(to_light + ray)
    cos_i, cos_o, cos_h = (np.clip(one @ samples.normal, 1e-3, 1.0) for one in (to_light, ray, half))
    alpha = law[_ROUGHNESS] ** 2
    facets = np.pi * brdf.ggx_distribution(cos_h, alpha) * brdf.smith_masking(cos_i, cos_o, alpha)
    return np.asarray(law[_SHARE] * facets / (4 * cos_i * cos_o))


def _irradiance(point: Floats, normal: Floats, place: Floats) -> Floats:
    """cos θ / d² (...,) at points (..., 3) of the camera frame."""
    towards = place - point
    squared = frames.dot(towards, towards)
    return np.asarray(np.maximum(towards @ normal, 1e-6) / squared**1.5)


def _fit(samples: Sequence[PaperSamples], used: Sequence[Bools], starts: Sequence[Floats]) -> Floats:
    """Law (5,) of the paper with the least scatter, searched from several `starts`."""
    some = []
    for one, use in zip(samples, used, strict=True):
        index = np.flatnonzero(use)
        some.append(one.take(index[:: max(1, len(index) // _FITTED)]))

    def residuals(law: Floats) -> Floats:
        errors = [_log_error(one, law) for one in some]
        # each view counts as LEAST_POINTS points
        scatter = [(error - np.median(error)) / _SCATTER / np.sqrt(len(error) / LEAST_POINTS) for error in errors]
        return np.concatenate([*scatter, law[_PLACE] / _FLASH_SIGMA_M, [law[_SHARE] / _SHARE_SIGMA]])

    found = [least_squares(residuals, start, bounds=(_LOW, _HIGH), loss="soft_l1", x_scale=_STEP) for start in starts]
    return np.asarray(min(found, key=lambda one: float(one.cost)).x)


def _chart_irradiance(view: PosedStokes, chart: ChartInView, place: Floats) -> float:
    """cos θ / d² at the chart's white patch, which lies on the board's plane."""
    assert chart.color.place is not None
    patch = chart.color.place.quads[18].mean(axis=0)  # white
    raw = from_grid(patch, view.stokes.view.scale)
    x, y = distortion.undistort(view.camera.lens, *(np.array(a) for a in raw))
    ray, normal = back_project(view.camera.view, x, y), view.pose.rotation[:, 1]
    point = ray * (view.pose.translation @ normal) / (ray @ normal)
    return float(_irradiance(point, normal, place))


def _shot_matrix(view: PosedStokes, samples: PaperSamples, used: Bools) -> Floats:
    """Matrices (3, 3, 3), by channel, that make the paper's S1 and S2 zero."""
    analyzers = mueller.analyzer(np.asarray(view.angle, np.float64))
    from_shots, out = np.linalg.pinv(analyzers), []
    for q, u in np.median(samples.ratio[used], axis=0).T:  # S1/S0 and S2/S0 of a channel
        gain = analyzers @ [1, q, u] * 2  # of each shot, over that under unpolarized light of equal energy
        out.append(from_shots @ (analyzers / gain[:, None]))
    return np.stack(out)
