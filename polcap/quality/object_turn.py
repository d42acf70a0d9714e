"""Turn of the object between shots, from the motion of its visible detail.

A rigid turn moves a point of the surface across the picture by its angle times the point's depth, and a roll moves it
about the object's middle. The polarizer moves nothing. It changes brightness with the relief, which imitates motion,
but not with this pattern; and it changes colors less than brightness. So both are fitted: brightness and colors. The
polarization that the maps explain is taken out of the brightness first.

References
----------
Longuet-Higgins and Prazdny, The interpretation of a moving retinal image, Proc. R. Soc. B 1980 (displacements).
Holland and Welsch, Robust regression, 1977 (Cauchy weights). White, Econometrica 1980 (error from the residuals).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.image_values import Bools, Floats, MaskedImage, Quality
from polcap.optics import outline, registration
from polcap.optics.morphology import erode
from polcap.optics.reduction import ObjectReduction
from polcap.optics.resize import block_means, block_step
from polcap.optics.robust import MAD_TO_SIGMA
from polcap.optics.warp import warp
from polcap.quality import rerendering
from polcap.stage_values import Alignment, AngleStack, ObjectMask, SurfaceMaps
from polcap.stages.align.detail import detail, fine_detail
from polcap.stages.cues import NOMINAL_IOR

_MOST_PIXELS = 0.8e6  # a larger picture is averaged down first
_DETAIL_PX, _COLOR_PX, _BLUR_PX = (
    4.0,
    8.0,
    0.7,
)  # 1σ: coarser detail of brightness, of colors is left out; blur of colors
_INWARD_PX = 2  # of the mask that are left out: the outline does not turn with the surface
_LEAST_SHOT = 0.05  # of half the light: no shot of a dielectric is darker, except in mirrors
_FLOOR = 0.01  # of the 99th percentile of the light, added before the logarithm
_LEAST_PIXELS = 1000  # of the reduced object
_PRIOR = np.array([1.0, 1.0, 0.03, 0.03, 0.03, 0.03])  # 1σ of shift [px], zoom [1], roll, tilts [rad]
_CAUCHY = 2.0  # robust standard deviations of the residuals: scale of the weights
_STEPS = 5  # of new weights
_FALSE_SHIFT_PX = 0.06  # 1σ of a shift that polarization imitates (docs/benchmarks/gates.md)
_CELL = 12  # px: residuals of different cells are independent


@dataclass(frozen=True)
class ObjectTurn:
    """Turn of the object from the first shot to each other one (K,), and the shift of its surface by this turn.

    Errors are 1σ. They include a shift that polarization imitates: the flatter the object, the larger a turn it makes.
    """

    degrees: Floats
    sigma: Floats  # degrees
    shift: Floats  # root mean square over the object, relative to the object's radius
    shift_sigma: Floats


def measure(radiance: AngleStack, alignment: Alignment, object_: ObjectMask, maps: SurfaceMaps | None) -> ObjectTurn:
    """Turn of the object in each shot, in degrees, about any axis; 0 where there is too little detail.

    Without `maps`, or without a depth in them, the object is taken as a ball inflated from its outline, and no
    polarization is taken out.
    """
    found = ObjectTurn(*np.zeros((4, len(radiance.angle))))
    step = block_step(object_.mask.size, _MOST_PIXELS)
    relief = _relief(maps, object_, step)
    clipped = np.any(radiance.quality & int(Quality.CLIPPED) > 0, axis=0)
    inside = erode(relief > 0, _INWARD_PX) & (block_means(clipped, step) == 0)
    if radiance.offset_px is not None or inside.sum() < _LEAST_PIXELS:  # shots cut from one mosaic, or a tiny object
        return found
    field, cell = _displacements(relief, inside)
    power = np.einsum("nij,nik->jk", field[..., 3:], field[..., 3:]) / len(field)  # (3, 3) px² per rad²
    radius = outline.disc_radius(relief > 0)
    polarized = _polarization(maps, radiance.angle, object_.mask.shape, step)
    reference = _signals(radiance.shot(0), step)
    for k in range(1, len(radiance.angle)):
        camera = registration.scaled(alignment.transform[k], 1 / step)
        moved = [warp(signal, camera) for signal in _signals(radiance.shot(k), step)]
        moved[0] = moved[0] - (polarized[k] - polarized[0])
        motion, covariance = _fit(reference, moved, field, inside, cell)
        turn, doubt = motion[3:], covariance[3:, 3:]
        angle, shift = np.linalg.norm(turn), np.sqrt(turn @ power @ turn)  # rad, px
        found.degrees[k] = np.degrees(angle)
        found.sigma[k] = np.degrees(np.hypot(np.sqrt(np.trace(doubt)), _FALSE_SHIFT_PX * angle / max(shift, 1e-9)))
        found.shift[k] = shift / radius
        found.shift_sigma[k] = np.hypot(np.sqrt(np.trace(power @ doubt)), _FALSE_SHIFT_PX) / radius
    return found


def _relief(maps: SurfaceMaps | None, object_: ObjectMask, step: int) -> Floats:
    """Height of the surface towards the camera, (h, w) px of the reduced picture, 1 at the deepest; 0 outside."""
    if maps is None or maps.depth_prior is None:
        depth = outline.depth(object_.mask)
        height = np.sqrt(np.maximum((2 * depth.max() - depth) * depth, 0))
    else:
        height = np.zeros(object_.mask.shape, np.float32)
        (x, y), (tall, wide) = (round(at) for at in maps.view.origin), maps.mask.shape
        prior = -outline.disc_radius(maps.mask) * maps.depth_prior
        height[y : y + tall, x : x + wide] = np.where(maps.mask, prior - prior[maps.mask].min(), 0)
    inside = block_means(object_.mask, step) > 0.99
    return np.where(inside, block_means(height, step) / step + 1, 0)


def _polarization(maps: SurfaceMaps | None, angle: Floats, shape: tuple[int, ...], step: int) -> Floats:
    """Fine detail (K, h, w) of the logarithm of the shots' brightness that polarization causes, by the maps."""
    found = np.zeros((len(angle), *(side // step for side in shape)), np.float32)
    if maps is None or maps.depth_prior is None:
        return found
    (x, y), (tall, wide) = (round(at) for at in maps.view.origin), maps.mask.shape
    small = ObjectReduction(maps.mask, -(-max(tall, wide) // step)).maps(maps)
    for k, shot in enumerate(rerendering.under_flash(small, angle, NOMINAL_IOR)[1]):
        log = np.zeros(shape, np.float32)
        log[y : y + tall, x : x + wide] = cv2.resize(np.log(np.maximum(shot, _LEAST_SHOT)), (wide, tall)) * maps.mask
        found[k] = fine_detail(block_means(log, step), _DETAIL_PX)
    return found


def _displacements(relief: Floats, inside: Bools) -> tuple[Floats, Floats]:
    """Motion field of a small motion of the object on the N pixels `inside`, and the cell (N,) of each pixel.

    The field (N, 2, 6) is the derivative of a pixel's place x, y [px] by two shifts [px], zoom [1], roll and two tilts
    [rad]; a tilt moves a pixel in proportion to its height in `relief` (h, w) [px]. Cells are squares of _CELL px.
    """
    y, x = np.nonzero(inside)
    height = relief[inside] - relief[inside].mean()
    cell = y // _CELL * (inside.shape[1] // _CELL + 1) + x // _CELL
    x, y = x - x.mean(), y - y.mean()
    one, zero = np.ones_like(x), np.zeros_like(x)
    across, down = [one, zero, x, -y, height, zero], [zero, one, y, x, zero, height]
    return np.stack([np.stack(across, -1), np.stack(down, -1)], axis=1), cell


def _signals(shot: MaskedImage, step: int) -> list[Floats]:
    """Fine detail (h, w) of a shot's brightness and of its two colors, as logarithms."""
    light = np.maximum(block_means(shot.value, step), 0)
    level = light + _FLOOR * np.percentile(light[::5, ::5], 99)
    log = np.asarray(cv2.GaussianBlur(np.log(level), (0, 0), _BLUR_PX))
    colors = [log[..., channel] - log[..., 1] for channel in (0, 2)]
    fine = [color - cv2.GaussianBlur(color, (0, 0), _COLOR_PX) for color in colors]
    return [detail(shot, _DETAIL_PX, step)[0].picture, *fine]


def _fit(
    reference: list[Floats], moved: list[Floats], field: Floats, inside: Bools, cell: Floats
) -> tuple[Floats, Floats]:
    """Motion (6,) between signals by robust least squares on their differences, and its covariance (6, 6)."""
    design, change = [], []
    for first, other in zip(reference, moved):
        slope = np.array(np.gradient((first + other) / 2))[::-1, inside].T  # (N, 2), x before y
        difference = (first - other)[inside]
        design.append((slope[:, None] @ field)[:, 0])
        change.append(difference - np.median(difference))
    signals, pixels = len(change), len(cell)
    a, b = np.concatenate(design).astype(np.float64), np.concatenate(change)
    residual = b
    for _ in range(_STEPS):
        scale = MAD_TO_SIGMA * np.median(np.abs(residual.reshape(signals, pixels)), axis=1) + 1e-9
        scale = np.repeat(scale, pixels)
        weighted = a.T / (scale**2 + (residual / _CAUCHY) ** 2)
        inverse = np.linalg.inv(weighted @ a + np.diag(_PRIOR**-2))
        motion = inverse @ weighted @ b
        residual = b - a @ motion
    score = weighted * residual
    of_cell = np.stack([np.bincount(np.tile(cell, signals), row) for row in score])  # (6, cells)
    return np.asarray(motion), np.asarray(inverse @ of_cell @ of_cell.T @ inverse)
