"""Radiance of one material in all views by half-angle: samples, the flash's place, and mean profiles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from polcap.fusion.values import IOR
from polcap.image_values import Bools, Floats
from polcap.optics import frames, shade

ALPHAS = np.geomspace(0.01, 1.0, 49)  # GGX α of the lobes that are tried
# the numbers below: docs/benchmarks/fusion-choices.md, "Textures and gloss"
_BIN_DEG, _LARGEST_DEG = 3.0, 60.0  # half-angles; beyond, errors of the normals change the mean radiance
_LEAST_IN_BIN, _LEAST_BINS = 10, 8  # samples of a bin, bins of a profile
_OUTLIERS = 0.02  # share of the darkest and of the brightest samples of a bin, which are left out
_RELATIVE = 0.03  # error of a bin's mean radiance, with `_PER_TANGENT`
_PER_TANGENT = 0.05  # this error per tangent of the zenith angle: radiance goes with the cosine
_FLASH_BIN_DEG, _FLASH_SCATTER = 2.0, 0.2  # of the half-angle; relative scatter from which samples count less
_FARTHEST_FLASH = 0.15  # m from the lens


@dataclass(frozen=True)
class LobeSamples:
    """Radiance of points of one material in all views, and its gloss in the maps."""

    radiance: Floats  # (P,) luminance of S0 over the light that the point receives
    albedo: Floats  # (P,) luminance of the baked albedo
    normal: Floats  # (P, 3) baked, in the frame of the ray
    point: Floats  # (P, 3) m, camera frame
    weight: Floats  # (P,)
    f0: float
    alpha: float

    def take(self, index: NDArray[np.intp] | slice) -> "LobeSamples":
        """Some of the samples."""
        arrays = (self.radiance, self.albedo, self.normal, self.point, self.weight)
        radiance, albedo, normal, point, weight = (one[index] for one in arrays)
        return LobeSamples(radiance, albedo, normal, point, weight, self.f0, self.alpha)

    def to_light(self, flash: Floats) -> Floats:
        """Unit vectors (P, 3) to a flash at (3,) [m, camera frame], in the frames of the rays."""
        return np.asarray(frames.to_ray_frame(frames.unit(flash - self.point), frames.unit(-self.point)))

    def half_angle_deg(self, to_light: Floats) -> Floats:
        """Angle (P,) between normal and half vector."""
        half = frames.unit(to_light + np.array([0.0, 0.0, 1.0]))
        return frames.angle_deg(half, self.normal)

    def diffuse(self, to_light: Floats) -> Floats:
        """Radiance (P,) of diffuse reflection."""
        return self.albedo * self._shade(to_light, 1.0, 0.0, 0.5)  # roughness has no effect

    def specular(self, to_light: Floats, alpha: float) -> Floats:
        """Radiance (P,) of specular reflection for F0 = 1."""
        return self._shade(to_light, 0.0, 1.0, np.sqrt(alpha))

    def _shade(self, to_light: Floats, albedo: float, f0: float, roughness: float) -> Floats:
        """S0 (P,) of a gray material under unit light."""
        one = np.ones(len(to_light))
        material = albedo * one[:, None], f0 * one[:, None], roughness * one, IOR * one
        return np.asarray(shade.stokes(self.normal, *material, to_light, one)[0][:, 0])


@dataclass(frozen=True)
class LobeProfile:
    """Mean radiance of one material in B bins of the half-angle, and the terms of its law for A lobes."""

    radiance: Floats  # (B,)
    error: Floats  # (B,) expected
    diffuse: Floats  # (B, 2) for g = 1 and for c = 1 in the law of `material_fit`
    specular: Floats  # (A, B) for F0 = 1 and each of `ALPHAS`
    f0: float  # of the maps
    alpha: float  # of the maps
    weight: float


def flash_place(samples: Sequence[LobeSamples]) -> Floats:
    """Place (3,) of the flash near the lens with least scatter of radiance by half-angle; the lens without samples."""
    every_second = [one.take(slice(None, None, 2)) for one in samples]
    if not every_second:
        return np.zeros(3)

    def misfit(place: Floats) -> float:  # grows steeply beyond `_FARTHEST_FLASH`
        beyond = max(float(np.hypot(*place)) / _FARTHEST_FLASH - 1, 0)
        return float(np.mean([_scatter(one, np.append(place, 0.0)) for one in every_second])) + 10 * beyond

    simplex = np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]])
    best = minimize(misfit, np.zeros(2), method="Nelder-Mead",
                    options={"initial_simplex": simplex, "maxfev": 60, "xatol": 0.002, "fatol": 1e-5})  # fmt: skip
    return np.append(best.x, 0.0)


def _scatter(samples: LobeSamples, flash: Floats) -> float:
    """Robust scatter of radiance over that of diffuse reflection, within bins of the half-angle."""
    to_light = samples.to_light(flash)
    diffuse = samples.diffuse(to_light)
    ratio = np.clip(samples.radiance / np.maximum(diffuse, 1e-3), 0.3, 6)  # limits outliers
    bin_ = (samples.half_angle_deg(to_light) / _FLASH_BIN_DEG).astype(int)
    weight = samples.weight * (samples.normal[:, 2] > np.cos(np.radians(_LARGEST_DEG)))
    mean = np.bincount(bin_, weight * ratio) / np.maximum(np.bincount(bin_, weight), 1e-9)
    squared = ((ratio - mean[bin_]) / _FLASH_SCATTER) ** 2
    return float((weight * np.log1p(squared)).sum() / max(weight.sum(), 1e-9))


def profile(samples: LobeSamples, flash: Floats) -> LobeProfile | None:
    """Means of a material's samples in bins of the half-angle; None for too few bins."""
    to_light = samples.to_light(flash)
    bin_ = (samples.half_angle_deg(to_light) / _BIN_DEG).astype(int)
    weight = samples.weight * _select_usual(samples, bin_)
    total = np.bincount(bin_, weight)
    filled = total > 0
    if filled.sum() < _LEAST_BINS:
        return None

    def mean(value: Floats) -> Floats:
        return np.asarray(np.bincount(bin_, weight * value)[filled] / total[filled])

    radiance, diffuse, cosine = mean(samples.radiance), samples.diffuse(to_light), samples.normal[:, 2]
    tangent = np.tan(np.arccos(np.clip(mean(cosine), 0.01, 1)))
    return LobeProfile(
        radiance=radiance,
        error=radiance * np.hypot(_RELATIVE, _PER_TANGENT * tangent),
        diffuse=np.stack([mean(diffuse), mean(diffuse * (1 - cosine))], axis=-1),
        specular=np.stack([mean(samples.specular(to_light, alpha)) for alpha in ALPHAS]),
        f0=samples.f0,
        alpha=samples.alpha,
        weight=float(samples.weight.sum()),
    )


def _select_usual(samples: LobeSamples, bin_: NDArray[np.intp]) -> Bools:
    """Samples (P,) in bins with enough of them, without the darkest and the brightest of each bin."""
    ratio = samples.radiance / np.maximum(samples.albedo, 1e-3)
    usual = np.zeros(len(ratio), bool)
    for number in range(int(_LARGEST_DEG / _BIN_DEG)):
        inside = np.flatnonzero(bin_ == number)
        if len(inside) >= _LEAST_IN_BIN:
            out = int(_OUTLIERS * len(inside))
            usual[inside[np.argsort(ratio[inside])][out : len(inside) - out]] = True
    return usual & (samples.radiance > 0)
