"""Stage 7: inputs of the estimators from the Stokes parameters: radiance, DoLP, AoLP, network channels.

Training calls `channels` and its helpers too. So these use the array API only, with the namespace of their arguments:
no cv2, no torch. Pixel axes are (..., H, W).
"""

from typing import Any

import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.image_values import Quality
from polcap.optics import frames, fresnel
from polcap.optics.namespace import array_namespace
from polcap.stage_values import Cues, OtherOrder, StokesImage
from polcap.stages import stage
from polcap.stages.cues import scale

NOMINAL_IOR = 1.5
CHANNELS = (
    "log_r", "log_g", "log_b",  # ln(S0 + 0.02)
    "s1", "s2",  # 10 S1/S0, 10 S2/S0
    "zenith_x", "zenith_y",  # θ(DoLP, n = 1.5) (cos 2φ, sin 2φ) [rad]
    "cos_2phi", "sin_2phi",  # normalized Stokes map
    "noise",  # zenith angle that noise alone would give [rad]
    "mask", "clipped", "ray_x", "ray_y",
)  # fmt: skip

FLOOR = 0.02  # added to a radiance before its logarithm, in the channels and in their inverse


@stage(version=9, keep=False)
def compute(stokes: StokesImage, color: ColorCalibration, other_orders: tuple[OtherOrder, ...] = ()) -> Cues:
    """Compute all cues (radiance, DoLP, AoLP, diffuse color…) of a crop (H, W) from its Stokes parameters.

    The color matrix is applied to S0 only. DoLP and AoLP are computed from the sums of the camera channels. The visible
    surface of the object is nearer to the flash than the chart, and gets more light: `scale` corrects for it. A capture
    without a chart has no absolute scale: its 99th percentile of radiance becomes 0.8.
    """
    ratio, sigma, dolp, normalized = polarization(stokes.stokes, stokes.covariance)
    radiance = np.asarray(stokes.stokes[0] @ color.matrix.T, dtype=np.float32)
    factor = scale.factor(stokes, color) if scale.is_known(color) else 1.0
    if color.source in ("camera", "none") and stokes.mask.any():
        factor = 0.8 / max(float(np.percentile(radiance[stokes.mask], 99)), 1e-9)
    radiance = radiance * np.float32(factor)
    body, body_known = None, None
    if stokes.body is not None:
        body = np.asarray(stokes.body.value @ color.matrix.T, dtype=np.float32) * np.float32(factor)
        unknown = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST
        body_known = stokes.mask & ((stokes.body.quality & np.uint8(unknown)) == 0)
    height, width = stokes.mask.shape
    return Cues(
        radiance=radiance,
        ratio=ratio,
        ratio_sigma=sigma,
        dolp=dolp,
        normalized_stokes=normalized,
        diffuse_color=least_intensity_color(stokes.stokes, color.matrix),
        rays=frames.rays(stokes.view, height, width),
        mask=stokes.mask,
        quality=stokes.quality,
        view=stokes.view,
        scale_sigma=scale.sigma(stokes, color),
        body=body,
        body_known=body_known,
        other_orders=other_orders,
        detail=stokes.detail,
    )


def polarization(stokes: Any, covariance: Any) -> tuple[Any, Any, Any, Any]:
    """Compute S1/S0 and S2/S0 (2, ...), their 1σ (...), the DoLP (...), and the normalized Stokes map (2, ...).

    stokes (3, ..., 3) and covariance (6, ..., 3) are in camera channels, which are summed. Noise increases the DoLP,
    E[ρ̂²] = ρ² + 2σ². So the result is √(ρ̂² − σ²), which has the least bias where ρ > σ (Wardle & Kronberg, ApJ 1974).
    """
    xp = array_namespace(stokes)
    total = frames.total(stokes)  # (3, ...)
    s0 = xp.where(total[0] > 1e-6, total[0], 1e-6 * xp.ones_like(total[0]))
    ratio = total[1:] / s0
    variance = frames.total(covariance[3] + covariance[5]) / 2
    sigma = variance**0.5 / s0
    squared = ratio[0] ** 2 + ratio[1] ** 2
    dolp = xp.clip(squared - sigma * sigma, 0.0, 1.0) ** 0.5
    return ratio, sigma, dolp, ratio / (squared + 1e-12) ** 0.5


def least_intensity_color(stokes: Any, matrix: Any) -> Any:
    """Color (..., 3) of the light at the polarizer angle of least intensity, ½(S0 − √(S1² + S2²)).

    Polarized highlights are darkest there, so this is the color of diffuse reflection. Unit length; 0 where dark.
    """
    xp = array_namespace(stokes)
    least = (stokes[0] - (stokes[1] ** 2 + stokes[2] ** 2) ** 0.5) / 2
    color = xp.clip(least @ matrix.T, 0.0, None)
    length = frames.dot(color, color)[..., None] ** 0.5
    return xp.where(length > 1e-4, color / (length + 1e-12), 0.0 * color)


def zenith(dolp: Any) -> Any:
    """Zenith angle (...) [rad] of a surface of refractive index 1.5, from the DoLP (...) of its diffuse reflection."""
    xp = array_namespace(dolp)
    return xp.acos(xp.clip(fresnel.cos_zenith_from_dolp(dolp, NOMINAL_IOR), 0.0, 1.0))


def channels(cues: Any) -> Any:
    """Network input channels (..., N, H, W) float32 by the formulas of CHANNELS, without outliers; 0 outside the mask.

    `cues` has the fields of `Cues`; in training these are torch tensors, with a leading batch axis
    on each pixel map ((B, H, W), (B, H, W, 3), (2, B, H, W)).
    """
    xp = array_namespace(cues.radiance)
    ones = xp.ones_like(cues.dolp)
    clipped = (cues.quality & int(Quality.CLIPPED)) > 0
    log = xp.log(xp.clip(cues.radiance, 0.0, 50.0) + FLOOR)
    angle = zenith(cues.dolp)
    maps = [
        log[..., 0], log[..., 1], log[..., 2],
        xp.clip(10 * cues.ratio[0], -5.0, 5.0), xp.clip(10 * cues.ratio[1], -5.0, 5.0),
        angle * cues.normalized_stokes[0], angle * cues.normalized_stokes[1],
        cues.normalized_stokes[0], cues.normalized_stokes[1],
        zenith(xp.clip(cues.ratio_sigma, 0.0, 0.2)),
        ones, clipped * ones, cues.rays[..., 0], cues.rays[..., 1],
    ]  # fmt: skip
    return xp.stack([cues.mask * m for m in maps], axis=-3)
