"""Errors of the estimated maps of one evaluation picture, over the true mask."""

from dataclasses import replace

import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.optics import frames, shade
from polcap.optics.morphology import erode
from polcap.optics.outline import disc_radius
from polcap.stage_values import SurfaceMaps
from polcap.stages import surface
from polcap.training.evaluation_protocol import Case, render_lights
from polcap.training.scores import LIMITS_DEG, Score

MAPS = ("diffuse", "specular", "roughness")
_IOR, _MIN_ROUGHNESS = 1.5, 0.08  # of rendered surfaces; the maps have no refractive index
_MAX_PIXELS = 20_000  # of a rendering: every second, third … pixel of the mask
_INTEGRATED = 128  # px, approximate side for integration, which takes too long at 512²
_FLASH = np.array([0.0, 0.0, 1.0])  # direction to the light that defines white
_MIN_CLIPPED = 10  # clipped pixels needed for an error in highlights


class Judge:
    """Measures the errors of estimated maps of one evaluation picture."""

    def __init__(self, case: Case) -> None:
        self.case, self.mask = case, case.truth.mask
        self.core = erode(self.mask, 2)
        self.clipped = self.mask & ((case.cues.quality & Quality.CLIPPED) > 0)
        self.rendered_mask = np.zeros_like(self.mask)
        self.rendered_mask.flat[np.flatnonzero(self.mask)[:: -(-int(self.mask.sum()) // _MAX_PIXELS)]] = True
        self.white = float(np.percentile(render_intensity(case.truth, case, self.rendered_mask, _FLASH), 99))
        self.rendered = self._render(case.truth)

    def score(self, maps: SurfaceMaps) -> Score:
        """Errors of all maps of a picture by name: RMSE unless the name differs; angles in degrees, shares 0…1.

        `·_core` is the error in the mask eroded by 2 px; `·_picture` that of the whole square picture, with zero error
        outside the object. For `depth` both depths are centered in the mask, and divided by the truth's range;
        `depth_fitted` is the error after the best scale and shift. `diffuse_clipped` is the error where all exposures
        are saturated; it is absent for fewer than ten such pixels.
        """
        case, mask = self.case, self.mask
        error, out = frames.angle_deg(maps.normal, case.truth.normal), {}
        for suffix, inside in (("", mask), ("_core", self.core)):
            out[f"normal_mean{suffix}"] = float(error[inside].mean())
            out[f"normal_median{suffix}"] = float(np.median(error[inside]))
            for limit in LIMITS_DEG:
                out[f"normal_within_{limit:g}{suffix}"] = float((error[inside] < limit).mean())
        share = float(mask.mean())
        differences = {name: (getattr(maps, name) - getattr(case.truth, name))[mask] for name in MAPS}
        for name, difference in (differences | {"rendering": self._render(maps) - self.rendered}).items():
            rmse, l1 = _rmse(difference), float(np.abs(difference).mean())
            out |= {name: rmse, f"{name}_l1": l1}
            out |= {f"{name}_picture": rmse * share**0.5, f"{name}_l1_picture": l1 * share}
        if self.clipped.sum() >= _MIN_CLIPPED:
            out["diffuse_clipped"] = _rmse((maps.diffuse - case.truth.diffuse)[self.clipped])
        if maps.depth_prior is not None:
            out |= _depth(maps.depth_prior[mask], case.depth[mask])
        return out

    def integrated(self, maps: SurfaceMaps) -> Score:
        """`depth_integrated`: error of depth integrated from the maps by the stage `surface`, on every n-th pixel."""
        by = max(1, round(max(self.mask.shape) / _INTEGRATED))
        every = np.s_[::by, ::by]
        mask, (x, y) = (maps.mask & self.mask)[every], maps.view.center
        images = {name: getattr(maps, name)[every] for name in (*MAPS, "normal", "confidence")}
        thinned = replace(
            maps, **images, mask=mask, depth_prior=None if maps.depth_prior is None else maps.depth_prior[every],
            view=replace(maps.view, focal=maps.view.focal / by, center=(x / by, y / by), scale=maps.view.scale * by),
        )  # fmt: skip
        depth = surface.integrate(thinned, None, surface.SurfaceSettings()).depth[mask]
        unit = float(depth.mean() * disc_radius(mask) / thinned.view.focal)
        return {"depth_integrated": _depth(depth / unit, self.case.depth[every][mask])["depth"]}

    def _render(self, maps: SurfaceMaps) -> Floats:
        """S0 (20, M, 3) rendered from maps under the 20 test lights, clipped to 0…1, the truth's 99th percentile."""
        images = [render_intensity(maps, self.case, self.rendered_mask, light) for light in render_lights()]
        return np.asarray(np.clip(np.stack(images) / self.white, 0, 1))


def deciles(predicted: Floats, actual: Floats) -> list[dict[str, float]]:
    """Mean predicted and mean actual normal error of each tenth of the pixels, sorted by predicted error."""
    parts = np.array_split(np.argsort(predicted), 10)
    return [{"predicted": float(predicted[part].mean()), "actual": float(actual[part].mean())} for part in parts]


def render_intensity(maps: SurfaceMaps, case: Case, mask: Bools, light: Floats) -> Floats:
    """Render S0 (M, 3) of the masked pixels under a distant light (3,). Camera frame, no shadows."""
    rays = case.cues.rays[mask].astype(np.float32)
    normal = frames.to_ray_frame(maps.normal[mask], rays).astype(np.float32)
    toward = frames.to_ray_frame(np.broadcast_to(light.astype(np.float32), rays.shape), rays)
    one = np.ones(len(normal), np.float32)
    rough = np.maximum(maps.roughness[mask], _MIN_ROUGHNESS)
    stokes = shade.stokes(normal, maps.diffuse[mask], maps.specular[mask], rough, _IOR * one, toward, one)
    return np.asarray(stokes[0])


def _rmse(difference: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


def _depth(estimate: Floats, truth: Floats) -> Score:
    """RMS error of the depth over its range: as predicted, and with the best scale."""
    estimate, truth = (x.astype(np.float64) - x.mean(dtype=np.float64) for x in (estimate, truth))
    scale = (estimate @ truth) / max(float(estimate @ estimate), 1e-12)
    span = float(np.ptp(truth))
    return {"depth": _rmse(estimate - truth) / span, "depth_fitted": _rmse(scale * estimate - truth) / span}
