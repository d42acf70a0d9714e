"""Data of report.html: maps, photographs and re-rendering of the object, reduced to the size of a screen."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.image_values import Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.optics.reduction import ObjectReduction
from polcap.optics.resize import area_mean
from polcap.quality import rerendering
from polcap.quality.rerendering import WHITE_QUANTILE, ReducedResult
from polcap.stage_values import AngleStack, Cues, SurfaceMaps

_WHITE_PATCH = 18  # of a ColorChecker Classic, row by row from dark skin


@dataclass(frozen=True)
class PageMaps(ReducedResult):
    """Maps and cues of the object on one reduced grid, for report.html."""

    depth: Floats  # (H, W) of the mesh; NaN outside
    dolp: Floats  # (H, W)
    aolp: Floats  # (H, W) degrees, 0…180


def reduce(maps: SurfaceMaps, mesh: ReliefMesh, cues: Cues, angle: Floats, longest: int) -> PageMaps:
    """Reduce the maps of a result to at most `longest` pixels a side; means are taken over the object only."""
    small = rerendering.reduce(maps, cues, angle, longest)
    reduction = ObjectReduction(np.asarray(maps.mask & cues.mask, bool), longest)
    cosine, sine = (reduction.mean(part) for part in cues.normalized_stokes)  # of twice the AoLP
    of_depth = ObjectReduction(reduction.inside & np.isfinite(mesh.depth), longest)
    return PageMaps(
        **vars(small),
        depth=np.where((of_depth.share > 0.5) & small.maps.mask, of_depth.mean(mesh.depth), np.nan),
        dolp=reduction.mean(cues.dolp),
        aolp=np.degrees(np.arctan2(sine, cosine) / 2) % 180,
    )


def exposure(small: PageMaps) -> float:
    """Factor on S0 for display: the brightest parts of the object become just below white."""
    inside = small.radiance[small.maps.mask]
    return 0.9 / max(float(np.quantile(inside.max(axis=-1), WHITE_QUANTILE)), 1e-6) if inside.size else 1.0


def photograph(radiance: AngleStack, calibration: ColorCalibration, view: View, size: tuple[int, int]) -> Floats:
    """The reference shot on the grid of the reduced maps, (H, W, 3), linear Rec.709 on the scale of S0.

    `view` is the camera of the reduced maps, `size` their (width, height).
    """
    factor = view.scale / radiance.view.scale  # pixels of the merged shot per pixel of the maps
    x, y = (edge * factor for edge in view.origin)
    width, height = size[0] * factor, size[1] * factor
    left, top = round(x), round(y)
    crop = np.asarray(radiance.value[0][top : top + round(height), left : left + round(width)], np.float32)
    # a shot has half of S0
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
            camera[index] = 2 * np.median(part[inside > 0], axis=0)  # a shot has half of S0
    row, column = np.divmod(np.arange(24), 6)
    offset = np.stack([column - column[_WHITE_PATCH], row - row[_WHITE_PATCH]], axis=-1)
    falloff, glare = ((0.0, 0.0), 0.0) if found.patches is None else (found.patches.falloff, found.patches.glare)
    light = 1 + offset @ np.array(falloff)
    return np.asarray((camera @ found.matrix.T - glare) / light[:, None])
