"""Data of report.html: maps, photographs and re-rendering of the object, reduced to the size of a screen."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.images import Bools, Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.optics import frames, shade
from polcap.optics.resize import area_mean
from polcap.report.reduction import ObjectReduction
from polcap.stage_values import AngleStack, Cues, SurfaceMaps

_WHITE_PATCH = 18  # of a ColorChecker Classic, row by row from dark skin
_OUTLIER = 5  # standard deviations of the differences
_WHITE_QUANTILE = 0.995  # of the object's light; it becomes white


@dataclass(frozen=True)
class PageMaps:
    """Maps and cues of the object on one reduced grid, for report.html."""

    maps: SurfaceMaps
    depth: Floats  # (H, W) of the mesh; NaN outside
    radiance: Floats  # (H, W, 3) S0, linear Rec.709
    dolp: Floats  # (H, W)
    aolp: Floats  # (H, W) degrees, 0…180
    ratio: Floats  # (2, H, W) S1/S0, S2/S0
    angle: Floats  # (K,) rad


def reduce(maps: SurfaceMaps, mesh: ReliefMesh, cues: Cues, angle: Floats, longest: int) -> PageMaps:
    """Reduce the maps of a result to at most `longest` pixels a side; means are taken over the object only."""
    reduction = ObjectReduction(np.asarray(maps.mask & cues.mask, bool), longest)
    light = np.maximum(frames.total(cues.radiance), 1e-6)
    weight = np.maximum(reduction.mean(light), 1e-9)
    axis = [reduction.mean(part) for part in cues.normalized_stokes]
    small = reduction.maps(maps)
    where_depth = ObjectReduction(reduction.inside & np.isfinite(mesh.depth), longest)
    return PageMaps(
        maps=small,
        depth=np.where((where_depth.share > 0.5) & small.mask, where_depth.mean(mesh.depth), np.nan),
        radiance=reduction.mean(cues.radiance),
        dolp=reduction.mean(cues.dolp),
        aolp=np.degrees(np.arctan2(axis[1], axis[0]) / 2) % 180,
        ratio=np.stack([reduction.mean(part * light) / weight for part in cues.ratio]),
        angle=angle,
    )


@dataclass(frozen=True)
class Rerendering:
    """Gray photographs of each polarizer angle, and the maps rendered under the same light and angle."""

    measured: Floats  # (K, H, W) S0 + S1 cos 2θ + S2 sin 2θ; 1 is white, brighter values are clipped
    predicted: Floats  # (K, H, W) the same, rendered from the maps under a flash at the lens
    flashed: Floats  # (H, W, 3) S0 of the maps under that flash, linear Rec.709
    scale: float  # brightness of the photographs over that of the re-rendering, median of the pixels

    def residuals(self, inside: Bools) -> dict[str, list[float]]:
        """Difference of photograph and re-rendering at each angle: `rms` without outliers, and share of `outliers`.

        The rms is relative to white. An outlier differs by more than five standard deviations, which the median of
        the absolute differences gives: a few pixels of a highlight do not carry the figure.
        """
        found: dict[str, list[float]] = {"rms": [], "outliers": []}
        for measured, predicted in zip(self.measured, self.predicted):
            size = np.abs(measured - predicted)[inside]
            far = size > _OUTLIER * max(1.4826 * float(np.median(size)), 1e-6) if size.size else size > 0
            found["rms"].append(float(np.sqrt(np.mean(size[~far] ** 2))))
            found["outliers"].append(float(far.mean()))
        return found


def rerender(small: PageMaps, ior: float) -> Rerendering:
    """Render the maps under the flash for each polarizer angle, for comparison with the photographs."""
    maps = small.maps
    ray = frames.rays(maps.view, *maps.mask.shape)
    normal = frames.to_ray_frame(maps.normal, ray)
    ahead = np.zeros_like(ray)
    ahead[..., 2] = 1.0
    one = np.ones(maps.mask.shape, np.float32)
    rough = np.maximum(maps.roughness, 0.02)
    stokes = np.asarray(shade.stokes(normal, maps.diffuse, maps.specular, rough, ior * one, ahead, one))
    s0, s1, s2 = frames.total(stokes) / 3 * maps.mask
    seen = frames.total(small.radiance) / 3 * maps.mask
    light, lit = seen[maps.mask], s0[maps.mask]
    scale = float(np.median(light[lit > 0] / lit[lit > 0])) if (lit > 0).any() else 1.0
    white = max(float(np.quantile(light, _WHITE_QUANTILE)), 1e-6) if light.size else 1.0
    measured, predicted = [], []
    for angle in small.angle:
        on_ray = frames.axis_on_ray(np.float32(angle), ray)
        measured.append(seen * (1 + small.ratio[0] * np.cos(2 * angle) + small.ratio[1] * np.sin(2 * angle)) / white)
        predicted.append(scale * (s0 + s1 * np.cos(2 * on_ray) + s2 * np.sin(2 * on_ray)) / white)
    flashed = stokes[0] * maps.mask[..., None]
    return Rerendering(np.minimum(measured, 1.0), np.minimum(predicted, 1.0), flashed, scale)


def exposure(small: PageMaps) -> float:
    """Factor on S0 for display: the brightest parts of the object become just below white."""
    inside = small.radiance[small.maps.mask]
    return 0.9 / max(float(np.quantile(inside.max(axis=-1), _WHITE_QUANTILE)), 1e-6) if inside.size else 1.0


def photograph(radiance: AngleStack, calibration: ColorCalibration, view: View, size: tuple[int, int]) -> Floats:
    """The reference shot on the grid of the reduced maps, (H, W, 3), linear Rec.709 on the scale of S0.

    `view` is the camera of the reduced maps, `size` their (width, height).
    """
    factor = view.scale / radiance.view.scale  # pixels of the merged shot per pixel of the maps
    x, y = (edge * factor for edge in view.origin)
    width, height = size[0] * factor, size[1] * factor
    left, top = round(x), round(y)
    crop = np.asarray(radiance.value[0][top : top + round(height), left : left + round(width)], np.float32)
    return np.asarray(area_mean(2 * crop, size[::-1]) @ calibration.matrix.T.astype(np.float32))


def patches(radiance: AngleStack, found: ColorCalibration) -> Floats | None:
    """Measured chart colors (24, 3), linear Rec.709, corrected for uneven light and glare; None without a chart."""
    if found.place is None:
        return None
    camera = np.full((24, 3), np.nan)
    for index, quad in enumerate(found.place.quads):
        corners = np.round(quad).astype(np.int32)
        low = np.clip(corners.min(axis=0), 0, None)  # x, y
        part = radiance.value[0][low[1] : corners[:, 1].max() + 1, low[0] : corners[:, 0].max() + 1]
        inside = np.zeros(part.shape[:2], np.uint8)
        if inside.size:
            cv2.fillConvexPoly(inside, corners - low, 1)
        if inside.any():
            camera[index] = 2 * np.median(part[inside > 0], axis=0)
    row, column = np.divmod(np.arange(24), 6)
    offset = np.stack([column - column[_WHITE_PATCH], row - row[_WHITE_PATCH]], axis=-1)
    falloff, glare = ((0.0, 0.0), 0.0) if found.patches is None else (found.patches.falloff, found.patches.glare)
    light = 1 + offset @ np.array(falloff)
    return np.asarray((camera @ found.matrix.T - glare) / light[:, None])
