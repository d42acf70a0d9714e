"""Errors of one picture's maps against its truth, over the truth's mask."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, Quality, SurfaceMaps
from polcap.optics import frames, shade
from polcap.stages import surface
from polcap.training.evaluation_protocol import Case, render_lights

MAPS = ("diffuse", "specular", "roughness")
_IOR = 1.5  # of the rendering error: the maps do not say it
_DRAWN = 20_000  # pixels of the rendering error, at most: every second, third... of the mask
_INTEGRATED = 128  # px, about: integrating 512² takes longer than all else
_FLASH = np.array([0.0, 0.0, 1.0])  # where the light that sets white stands
_LEAST_CLIPPED = 10  # pixels, for a highlight's error to count

Score = dict[str, float]
Bools = NDArray[np.bool_]


class Judge:
    """Scores estimates of one picture; what depends on the truth alone is worked out once."""

    def __init__(self, case: Case) -> None:
        self.case, self.mask = case, case.truth.mask
        self.core = cv2.erode(self.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        clipped = self.mask & ((case.cues.quality & Quality.CLIPPED) > 0)
        self.clipped = clipped if clipped.sum() >= _LEAST_CLIPPED else None
        self.drawn = np.zeros_like(self.mask)
        self.drawn.flat[np.flatnonzero(self.mask)[:: -(-int(self.mask.sum()) // _DRAWN)]] = True
        self.white = float(np.percentile(render_intensity(case.truth, case, self.drawn, _FLASH), 99))
        self.rendered = self._rendered(case.truth)

    def score(self, maps: SurfaceMaps) -> Score:
        """RMSE unless said, angles in degrees, shares of pixels in 0…1. `·_core`: mask eroded by 2 px.

        `·_picture`: over the whole square picture, where nothing is wrong beside the object.

        depth: both centred in the mask, over the truth's greatest minus least; `depth_fitted`: after the best
        scale and shift. diffuse_clipped: where every exposure is saturated; absent where fewer than ten pixels are.
        """
        case, mask, error = self.case, self.mask, angle(maps, self.case)
        out = {}
        for suffix, inside in (("", mask), ("_core", self.core)):
            out[f"normal_mean{suffix}"] = float(error[inside].mean())
            out[f"normal_median{suffix}"] = float(np.median(error[inside]))
            for limit in (11.25, 22.5, 30.0):
                out[f"normal_within_{limit:g}{suffix}"] = float((error[inside] < limit).mean())
        for name in MAPS:
            difference = (getattr(maps, name) - getattr(case.truth, name))[mask]
            out |= self._counted(name, difference)
        if self.clipped is not None:
            out["diffuse_clipped"] = _rmse((maps.diffuse - case.truth.diffuse)[self.clipped])
        if maps.depth_prior is not None:
            out |= _depth(maps.depth_prior[mask], case.depth[mask])
        difference = self._rendered(maps) - self.rendered
        return out | self._counted("rendering", difference)

    def _counted(self, name: str, difference: Floats) -> Score:
        """RMSE and L1, over the object and over the picture."""
        rmse, l1, share = _rmse(difference), float(np.abs(difference).mean()), float(self.mask.mean())
        return {
            name: rmse, f"{name}_l1": l1, f"{name}_picture": rmse * share**0.5, f"{name}_l1_picture": l1 * share,
        }  # fmt: skip

    def integrated(self, maps: SurfaceMaps) -> Score:
        """depth_integrated: depth's error once stage 9 has made a surface of the maps, on every n-th pixel."""
        by = max(1, round(max(self.mask.shape) / _INTEGRATED))
        thin = _thinned(maps, by)
        mask = thin.mask & self.mask[::by, ::by]
        depth = surface.integrate(replace(thin, mask=mask), None, surface.SurfaceSettings()).depth[mask]
        unit = float(depth.mean() * np.sqrt(mask.sum() / np.pi) / thin.view.focal)
        return {"depth_integrated": _depth(depth / unit, self.case.depth[::by, ::by][mask])["depth"]}

    def _rendered(self, maps: SurfaceMaps) -> Floats:
        """S0 (20, M, 3) under the stored lights, clipped to 0…1; 1 is the flash-lit truth's 99th percentile."""
        return np.stack(
            [
                np.clip(render_intensity(maps, self.case, self.drawn, light) / self.white, 0, 1)
                for light in render_lights()
            ]
        )


def angle(maps: SurfaceMaps, case: Case) -> Floats:
    """Degrees between estimated and true normal, (H, W)."""
    half = np.linalg.norm(maps.normal.astype(np.float64) - case.truth.normal, axis=-1) / 2
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(half, 0, 1))))


def deciles(predicted: Floats, actual: Floats) -> list[dict[str, float]]:
    """Mean predicted and mean actual normal error in each tenth of the pixels, by predicted error."""
    order = np.argsort(predicted)
    return [
        {"predicted": float(predicted[part].mean()), "actual": float(actual[part].mean())}
        for part in np.array_split(order, 10)
    ]


def _thinned(maps: SurfaceMaps, by: int) -> SurfaceMaps:
    """Every by-th pixel of every by-th row."""
    thin = np.s_[::by, ::by]
    x, y = maps.view.center
    return replace(
        maps, normal=maps.normal[thin], diffuse=maps.diffuse[thin], specular=maps.specular[thin],
        roughness=maps.roughness[thin], confidence=maps.confidence[thin], mask=maps.mask[thin],
        depth_prior=None if maps.depth_prior is None else maps.depth_prior[thin],
        view=replace(maps.view, focal=maps.view.focal / by, center=(x / by, y / by), scale=maps.view.scale * by),
    )  # fmt: skip


def render_intensity(maps: SurfaceMaps, case: Case, mask: Bools, light: Floats) -> Floats:
    """S0 (M, 3) of the masked pixels under a distant light (3,), camera frame; as `optics/shade.py`, no shadow."""
    rays = case.cues.rays[mask].astype(np.float32)
    normal = frames.to_ray_frame(maps.normal[mask], rays).astype(np.float32)
    toward = frames.to_ray_frame(np.broadcast_to(light.astype(np.float32), rays.shape), rays)
    one = np.ones(len(normal), np.float32)
    rough = np.maximum(maps.roughness[mask], 0.08)
    stokes = shade.stokes(normal, maps.diffuse[mask], maps.specular[mask], rough, _IOR * one, toward, one)
    return np.asarray(stokes[0])


def _rmse(difference: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


def _depth(ahead: Floats, truth: Floats) -> Score:
    ahead, truth = (x.astype(np.float64) - x.mean(dtype=np.float64) for x in (ahead, truth))
    scale = (ahead @ truth) / max(float(ahead @ ahead), 1e-12)
    span = float(np.ptp(truth))
    return {"depth": _rmse(ahead - truth) / span, "depth_fitted": _rmse(scale * ahead - truth) / span}
