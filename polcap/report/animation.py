"""Animations of a result: the object under a moving light, or rotating on a turntable."""

from typing import Literal

import cv2
import numpy as np

from polcap.images import Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.optics import color, frames, projection, shade
from polcap.optics.reduction import ObjectReduction
from polcap.report.sheets import Picture
from polcap.stage_values import SurfaceMaps

Motion = Literal["light", "turntable"]
FRAMES = 48
SECONDS = 4.0
_SIDE = 480  # px, of a frame's longer side
_LIGHT_TILT = 0.75  # sine of the angle between the light's direction and the optical axis
_TURNTABLE_LIGHT = np.array([-0.35, 0.45, 0.82])  # direction towards the light: left, above and in front
_SWING = np.radians(35.0)  # to either side; a larger turn would show the unseen back
_OVERSAMPLING = 2  # surface points per pixel and side, so that turning leaves no holes
_WHITE_QUANTILE = 0.995  # of the light; it becomes nearly white
_BACKGROUND = 0.012  # linear


def light(maps: SurfaceMaps, ior: float) -> list[Picture]:
    """Frames of the object lit by a distant light that moves once around the optical axis."""
    small = ObjectReduction(maps.mask, _SIDE).maps(maps)
    ray = frames.rays(small.view, *small.mask.shape)
    drawn = []
    for turn in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        across = _LIGHT_TILT * np.array([np.sin(turn), np.cos(turn)])
        to_light = np.array([*across, np.sqrt(1 - across @ across)])
        drawn.append(np.where(small.mask[..., None], _shade(small, small.normal, ray, to_light, ior), _BACKGROUND))
    return _to_srgb(drawn)


def turntable(maps: SurfaceMaps, mesh: ReliefMesh, ior: float) -> list[Picture]:
    """Frames of the surface rotated to both sides and back, under a fixed light near the camera."""
    reduction = ObjectReduction(maps.mask & np.isfinite(mesh.depth), _OVERSAMPLING * _SIDE)
    small, depth = reduction.maps(maps), reduction.mean(mesh.depth)
    inside = small.mask & (depth > 0)
    row, column = (index.astype(float) for index in np.nonzero(inside))
    points = projection.back_project(small.view, column, row) * depth[inside, None].astype(np.float64)  # (N, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    drawn = []
    for angle in _SWING * np.sin(np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        moved = np.broadcast_to(middle, (*inside.shape, 3)).copy()
        moved[inside] = (points - middle) @ turn.T + middle
        ray = frames.unit(-moved)
        shaded = _shade(small, small.normal @ turn.T, ray, _TURNTABLE_LIGHT, ior)
        drawn.append(_draw_points(moved[inside], shaded[inside], small.view, inside.shape))
    return _to_srgb(drawn)


def _shade(maps: SurfaceMaps, normal: Floats, ray: Floats, to_light: Floats, ior: float) -> Floats:
    """Render S0 (H, W, 3) from normals (H, W, 3) under a light from `to_light` (3,), all in the camera frame."""
    to_light = to_light / np.linalg.norm(to_light)
    local = frames.to_ray_frame(np.broadcast_to(to_light, ray.shape), ray)
    facing = frames.to_ray_frame(normal, ray)
    one, rough = np.ones(maps.mask.shape), np.maximum(maps.roughness, 0.02)
    return np.asarray(shade.stokes(facing, maps.diffuse, maps.specular, rough, ior * one, local, one)[0])


def _draw_points(points: Floats, value: Floats, view: View, shape: tuple[int, int]) -> Floats:
    """Draw points (N, 3) as a picture (H, W, 3): each pixel shows the nearest point; small holes are filled."""
    height, width = shape[0] // _OVERSAMPLING, shape[1] // _OVERSAMPLING
    column, row = np.rint(projection.project(view, points) / _OVERSAMPLING).astype(int).T
    order = np.argsort(points[:, 2])  # the nearest last
    order = order[((row >= 0) & (row < height) & (column >= 0) & (column < width))[order]]
    picture = np.zeros((height, width, 3), np.float32)
    hit = np.zeros((height, width), np.uint8)
    picture[row[order], column[order]] = value[order]
    hit[row[order], column[order]] = 1
    closed = cv2.morphologyEx(hit, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    around = cv2.blur(picture, (3, 3)) / np.maximum(cv2.blur(hit.astype(np.float32), (3, 3)), 1e-6)[..., None]
    filled = np.where((hit == 0)[..., None], around, picture)
    return np.asarray(np.where((closed > 0)[..., None], filled, _BACKGROUND))


def _to_srgb(drawn: list[Floats]) -> list[Picture]:
    """Convert linear frames to sRGB, all with one exposure."""
    top = max(float(np.quantile(np.stack(drawn[:: FRAMES // 6])[..., 1], _WHITE_QUANTILE)), 1e-6)
    return [color.srgb_eight_bits(0.9 * frame / top) for frame in drawn]
