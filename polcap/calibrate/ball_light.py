"""Light on a ball: the ball's edge to a tenth of a pixel, the flash's place and the zero of the polarizer's ring.

A mask ends where the object is dark, and a flash above the lens leaves a crescent of the ball's edge dark. So S0 of a
ball under one flash is rendered, and the ball's and the flash's place are fitted to it. Diffuse light may change with
the zenith in any smooth way, so that no law of it decides the ball's size. Scratches and mirrored lamps are outliers.
A print on the ball changes its light too: then the mask decides.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

from polcap.calibrate.ball_outline import Ball
from polcap.image_values import Bools, Floats, View
from polcap.optics import frames, fresnel, outline, robust, shade
from polcap.optics.resize import area_mean

MOST_MISFIT = 0.02  # of S0 about the fit to a ball of one color
_LONGEST = 112  # px of the picture to which the ball is fitted
_SAMPLES = 2  # per pixel side
_BLUR = 0.4  # px, 1σ of lens and resampling
_IOR = 1.5
_GRAZING = 0.1  # cosine, as in `optics/body.py`
_LEAST_SPREAD = 0.01  # of the residuals, relative to the ball's bright parts
_AROUND = 0.1  # width of the backdrop around the ball that is fitted [radii]
_ROUNDS = 2  # of the fit, each with new weights
# fitted numbers: the ball's move right, up and growth [radii]; the flash right, up [distances]; roughness
_START = (0.0, 0.0, 0.0, 0.0, 0.05, 0.35)
_LEAST = (-0.1, -0.1, -0.1, -1.5, -1.5, 0.08)
_MOST = (0.1, 0.1, 0.1, 1.5, 1.5, 1.0)


@dataclass(frozen=True)
class BallLight:
    """Places of a ball and of the flash, fitted to S0."""

    ball: Ball
    flash: Floats  # (2,) right of the lens and above it, in distances of the ball
    misfit: float  # 1σ of S0 about the fit, bright parts = 1; prints have more than `MOST_MISFIT`


@dataclass(frozen=True)
class _Picture:
    """S0 to fit, and the first guess of the ball."""

    light: Floats  # (H, W) bright parts of the ball = 1
    used: Bools  # (H, W)
    guess: Ball
    view: View


@dataclass(frozen=True)
class RingReading:
    """Turn of the measured AoLP against the azimuths of a ball's normals."""

    offset: float  # rad, true minus used polarizer angle
    sigma: float  # rad, 1σ
    contrast: float  # median DoLP over that of a smooth ball of index 1.5, at zeniths of 30° to 70°


def fit(light: Floats, guess: Ball, view: View) -> BallLight:
    """Fit the places of ball and flash to S0 (H, W) of the crop of `view`, from the ball that the mask shows."""
    small, grid = _reduced(light.astype(np.float64), view)
    y, x = np.mgrid[: small.shape[0], : small.shape[1]].astype(np.float64)
    distance = guess.outside(grid, x, y)
    picture = _Picture(
        light=small / np.percentile(small[distance < 0], 90),
        used=distance < max(_AROUND * guess.radius_px(grid), 2.0),  # px
        guess=guess,
        view=grid,
    )
    value, weight = np.array(_START), np.where(picture.used, 1.0, 0.0)
    for _ in range(_ROUNDS):
        weighted = partial(_weighted_residual, picture, weight)
        value = least_squares(weighted, value, bounds=(_LEAST, _MOST), x_scale=0.05, max_nfev=8).x
        residual = _residual(picture, weight, value)
        spread = max(robust.spread(residual[picture.used]), _LEAST_SPREAD)
        weight = np.where(picture.used, np.sqrt(robust.biweight(residual, spread)), 0.0)
    return BallLight(_moved(guess, value), value[3:5], robust.spread(residual[distance < 0]))


def read_ring(stokes: Floats, ball: Ball, view: View, sound: Bools) -> RingReading:
    """Compare the AoLP of a ball with its azimuths, for S0, S1, S2 (3, H, W) and the pixels (H, W) to use.

    Diffuse reflection is polarized along the azimuth. The light that a surface mirrors under a flash at the lens has
    hardly any polarization.
    """
    height, width = sound.shape
    rays = frames.rays(view, height, width).astype(np.float64)
    normal, inside = ball.normals(view, (height, width))
    local = frames.to_ray_frame(normal, rays)
    zenith = np.degrees(np.arccos(np.clip(local[..., 2], -1, 1)))
    use = sound & inside & (zenith > 20) & (zenith < 75)  # degrees
    s0, s1, s2 = (part[use] for part in stokes)
    aolp = frames.axis_on_ray(np.arctan2(s2, s1) / 2, rays[use])
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-9)
    azimuth = np.arctan2(local[use][:, 1], local[use][:, 0])
    weight = np.minimum(dolp, outline.DOLP_CAP)
    turned = weight * np.exp(2j * (aolp - azimuth))
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * outline.SECTORS).astype(int) % outline.SECTORS
    real, imaginary, total = (np.bincount(sector, part, outline.SECTORS) for part in (turned.real, turned.imag, weight))
    mean, sigma = outline.mean_and_sigma(real + 1j * imaginary, total.astype(np.float64))
    middle = (zenith[use] > 30) & (zenith[use] < 70)  # as `RingReading.contrast` states
    plus, minus = fresnel.transmission(np.cos(np.radians(zenith[use][middle])), _IOR)
    contrast = float(np.median(dolp[middle] * plus / minus)) if middle.any() else float("nan")
    return RingReading(-float(np.angle(mean) / 2), sigma, contrast)


def _reduced(light: Floats, view: View) -> tuple[Floats, View]:
    """An image (H, W) reduced to at most `_LONGEST` px a side, and its camera."""
    factor = min(1.0, _LONGEST / max(light.shape))
    height, width = (max(1, round(side * factor)) for side in light.shape)
    x, y = ((edge + 0.5) * factor - 0.5 for edge in view.center)
    return area_mean(light, (height, width)), View(view.focal * factor, (x, y), view.scale / factor)


def _weighted_residual(picture: _Picture, weight: Floats, value: Floats) -> Floats:
    """`_residual` times the weight (H, W), for the pixels (N,) to fit."""
    return (_residual(picture, weight, value) * weight)[picture.used]


def _residual(picture: _Picture, weight: Floats, value: Floats) -> Floats:
    """S0 (H, W) minus its best fit for the numbers `value` (6,), in the order of `_START`.

    Backdrop, mirrored light and the dependence of diffuse light on the zenith enter linearly.
    """
    column = np.stack(_columns(picture, value))
    used, used_weight = picture.used, weight[picture.used]
    amount = np.linalg.lstsq((column[:, used] * used_weight).T, picture.light[used] * used_weight, rcond=None)[0]
    return np.asarray(picture.light - np.einsum("khw,k->hw", column, amount))


def _columns(picture: _Picture, value: Floats) -> list[Floats]:
    """Pictures (H, W) whose sum is S0: mirrored light, backdrop, diffuse light by several laws of the zenith."""
    (height, width), view = picture.light.shape, picture.view
    ball, flash, roughness = _moved(picture.guess, value), np.append(value[3:5], 0.0), float(value[5])
    offset = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    x, y = np.meshgrid(*((np.arange(n)[:, None] + offset).ravel() for n in (width, height)))
    rays = frames.rays_at(view, x, y)
    point, normal = ball.points(rays)
    to_light = flash - point
    squared = frames.dot(to_light, to_light)
    local = frames.to_ray_frame(normal, rays)
    light = frames.to_ray_frame(to_light / np.sqrt(squared)[..., None], rays)
    body, gloss = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    parts = shade.stokes(local, body, gloss, roughness, _IOR, light, 1 / squared)[0]
    seen = np.clip(0.5 - ball.outside(view, x, y) * _SAMPLES, 0, 1)  # share of each sample that the ball covers
    sine2 = 1 - np.clip(local[..., 2], 0, 1) ** 2
    diffuse, mirrored = parts[..., 0] * seen, parts[..., 1] * seen
    incidence = np.clip(frames.dot(local, light), 0, 1)
    # rough surfaces look flatter than Lambert's, so they send more light near the outline (`body.flattening`)
    rim = seen / squared * incidence * sine2
    steep = rim * sine2 / np.clip(np.maximum(incidence, local[..., 2]), _GRAZING, 1)
    columns = [mirrored, 1 - seen, diffuse, diffuse * sine2, diffuse * sine2**2, rim, steep]
    return [area_mean(gaussian_filter(part, _BLUR * _SAMPLES), (height, width)) for part in columns]


def _moved(guess: Ball, value: Floats) -> Ball:
    """The first guess after a move right and up and a growth, all in its radii."""
    radius = guess.radius
    across = np.array([value[0], value[1], 0.0]) * radius
    direction = guess.direction + across - guess.direction * (across @ guess.direction)
    return Ball(direction / np.linalg.norm(direction), guess.angular_radius * (1 + float(value[2])))
