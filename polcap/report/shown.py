"""In: the results of a run. Out: what a page shows of them, reduced to the size of a screen."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import AngleStack, ColorCalibration, Cues, Floats, Mesh, SurfaceMaps, View
from polcap.optics import frames, shade
from polcap.report.smaller import Smaller, area

WHITE_PATCH = 18  # of a ColorChecker Classic, row by row from dark skin
_COLUMNS = 6
_GREATEST_S0 = 0.995  # percentile of the object's light that becomes white


@dataclass(frozen=True)
class Shown:
    """Maps, cues and photographs of the object on one grid, no longer than a given side."""

    maps: SurfaceMaps
    depth: Floats  # (H, W) as the mesh has it; NaN outside
    radiance: Floats  # (H, W, 3) S0, linear Rec.709
    dolp: Floats  # (H, W)
    aolp: Floats  # (H, W) degrees, 0…180
    ratio: Floats  # (2, H, W) S1/S0, S2/S0
    angle: Floats  # (K,) rad


def reduce(maps: SurfaceMaps, mesh: Mesh, cues: Cues, angle: Floats, longest: int) -> Shown:
    """The results with at most `longest` pixels a side; colors and angles are averaged over the object alone."""
    way = Smaller(np.asarray(maps.mask & cues.mask, bool), longest)
    light = np.maximum(frames.total(cues.radiance), 1e-6)
    weight = np.maximum(way.mean(light), 1e-9)
    axis = [way.mean(part) for part in cues.normalized_stokes]
    small = way.maps(maps)
    to_depth = Smaller(way.inside & np.isfinite(mesh.depth), longest)
    return Shown(
        maps=small,
        depth=np.where((to_depth.share > 0.5) & small.mask, to_depth.mean(mesh.depth), np.nan),
        radiance=way.mean(cues.radiance),
        dolp=way.mean(cues.dolp),
        aolp=np.degrees(np.arctan2(axis[1], axis[0]) / 2) % 180,
        ratio=np.stack([way.mean(part * light) / weight for part in cues.ratio]),
        angle=angle,
    )


@dataclass(frozen=True)
class Rerendered:
    """The photographs of each angle, in grey, beside what the maps say they should be."""

    measured: Floats  # (K, H, W) S0 + S1 cos 2θ + S2 sin 2θ, 1 where the object is brightest, not beyond
    predicted: Floats  # (K, H, W) the same from normals and material under a flash beside the lens
    flashed: Floats  # (H, W, 3) S0 of the maps under that flash, linear Rec.709
    scale: float  # brightness of the photographs over that of the re-rendering, median of the pixels

    def rms(self, inside: NDArray[np.bool_]) -> list[float]:
        """Root mean square of the difference of each angle, of white."""
        return [float(np.sqrt(np.mean((m - p)[inside] ** 2))) for m, p in zip(self.measured, self.predicted)]


def rerender(shown: Shown, ior: float) -> Rerendered:
    """Light the maps as the photographs were lit, through the same polarizer angles."""
    maps = shown.maps
    ray = frames.rays(maps.view, *maps.mask.shape)
    normal = frames.to_ray_frame(maps.normal, ray)
    ahead = np.zeros_like(ray)
    ahead[..., 2] = 1.0
    index = np.full(maps.mask.shape, ior, np.float32)
    ones = np.ones_like(index)
    drawn = shade.stokes(normal, maps.diffuse, maps.specular, np.maximum(maps.roughness, 0.02), index, ahead, ones)
    flashed = np.asarray(drawn)[0] * maps.mask[..., None]
    drawn = frames.total(np.asarray(drawn)) / 3 * maps.mask
    seen = frames.total(shown.radiance) / 3 * maps.mask
    light, lit = seen[maps.mask], drawn[0][maps.mask]
    scale = float(np.median(light[lit > 0] / lit[lit > 0])) if (lit > 0).any() else 1.0  # highlights have no say
    white = max(float(np.quantile(light, _GREATEST_S0)), 1e-6) if light.size else 1.0
    measured, predicted = [], []
    for angle in shown.angle:
        on_ray = frames.axis_on_ray(np.float32(angle), ray)
        measured.append(seen * (1 + shown.ratio[0] * np.cos(2 * angle) + shown.ratio[1] * np.sin(2 * angle)) / white)
        predicted.append(
            scale * (drawn[0] + drawn[1] * np.cos(2 * on_ray) + drawn[2] * np.sin(2 * on_ray)) * maps.mask / white
        )
    return Rerendered(np.minimum(measured, 1.0), np.minimum(predicted, 1.0), flashed, scale)


def exposure(shown: Shown) -> float:
    """What S0 is multiplied by so that the object's brightest parts come just below white."""
    inside = shown.radiance[shown.maps.mask]
    return 0.9 / max(float(np.quantile(inside.max(axis=-1), _GREATEST_S0)), 1e-6) if inside.size else 1.0


def photograph(radiance: AngleStack, calibration: ColorCalibration, view: View, size: tuple[int, int]) -> Floats:
    """The reference shot where the maps lie, linear Rec.709 on the scale of S0, (H, W, 3) at `size` (width, height).

    view : of the maps, whose full size on their own grid is that of `size` times what `view.scale` says.
    """
    factor = view.scale / radiance.view.scale  # pixels of the merged shot per pixel of the maps
    x, y = (edge * factor for edge in view.origin)
    width, height = size[0] * factor, size[1] * factor
    left, top = round(x), round(y)
    crop = radiance.value[0][top : top + round(height), left : left + round(width)]
    return np.asarray(area(2 * np.asarray(crop, np.float32), size) @ calibration.matrix.T.astype(np.float32))


def patches(radiance: AngleStack, found: ColorCalibration) -> Floats | None:
    """The chart's colors as measured, (24, 3) linear Rec.709, without the light's slope and glare; None: no chart."""
    if found.place is None:
        return None
    camera = np.zeros((24, 3))
    for index, quad in enumerate(found.place.quads):
        corners = np.round(quad).astype(np.int32)
        low = np.clip(corners.min(axis=0), 0, None)  # x, y
        part = radiance.value[0][low[1] : corners[:, 1].max() + 1, low[0] : corners[:, 0].max() + 1]
        drawn = np.zeros(part.shape[:2], np.uint8)
        if drawn.size:
            cv2.fillConvexPoly(drawn, corners - low, 1)
        inside = part[drawn > 0]
        camera[index] = 2 * np.median(inside, axis=0) if len(inside) else np.nan
    row, column = np.divmod(np.arange(24), _COLUMNS)
    white_row, white_column = divmod(WHITE_PATCH, _COLUMNS)
    offset = np.stack([column - white_column, row - white_row], axis=-1)
    colors = found.patches
    light = 1 + offset @ np.array((0.0, 0.0) if colors is None else colors.falloff)
    glare = 0.0 if colors is None else colors.glare
    return np.asarray((camera @ found.matrix.T - glare) / light[:, None])
