"""In: maps and mesh. Out: frames of the object under a light that goes round, or turned before the eye."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, Mesh, SurfaceMaps, View
from polcap.optics import color, frames, shade
from polcap.report.sheets import Picture
from polcap.report.smaller import Smaller

Motion = Literal["light", "turntable"]
FRAMES = 48
SECONDS = 4.0
_SIDE = 480  # px, of a frame's longer side
_LIGHT_TILT = 0.75  # of the light's direction across the optical axis
_BESIDE_EYE = np.array([-0.35, 0.45, 0.82])  # of the turntable, from the left above
_SWING = np.radians(35.0)  # to either side: what the camera did not see would gape beyond
_OVER = 2  # points of the surface per pixel of a frame and side, so that turning leaves no holes
_BRIGHTEST = 0.995  # quantile of the light that is just below white
_GROUND = 0.012  # linear


def light(maps: SurfaceMaps, ior: float) -> list[Picture]:
    """The maps under a distant light that goes once round the optical axis."""
    small = Smaller(maps.mask, _SIDE).maps(maps)
    ray = frames.rays(small.view, *small.mask.shape)
    normal = frames.to_ray_frame(small.normal, ray)
    drawn = []
    for turn in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        across = _LIGHT_TILT * np.array([np.sin(turn), np.cos(turn)])
        to_light = np.array([*across, np.sqrt(1 - across @ across)])
        drawn.append(np.where(small.mask[..., None], _lit(small, normal, ray, to_light, ior), _GROUND))
    return _developed(drawn)


def turntable(maps: SurfaceMaps, mesh: Mesh, ior: float) -> list[Picture]:
    """The surface swung to both sides and back, lit from beside the eye."""
    way = Smaller(maps.mask & np.isfinite(mesh.depth), _OVER * _SIDE)
    small, depth = way.maps(maps), way.mean(mesh.depth)
    inside = small.mask & (depth > 0)
    points = _points(depth, inside, small.view)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    drawn = []
    for angle in _SWING * np.sin(np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        moved = np.zeros((*inside.shape, 3))
        moved[inside] = (points - middle) @ turn.T + middle
        moved[~inside] = middle
        ray = -moved / np.linalg.norm(moved, axis=-1, keepdims=True)
        normal = frames.to_ray_frame(small.normal @ turn.T, ray)
        seen = _lit(small, normal, ray, _BESIDE_EYE, ior)
        drawn.append(_nearest(moved[inside], seen[inside], small.view, inside.shape))
    return _developed(drawn)


def _points(depth: Floats, inside: NDArray[np.bool_], view: View) -> Floats:
    """The surface's points (N, 3) in the camera frame, one per pixel."""
    row, column = np.nonzero(inside)
    along = np.stack(
        [(column - view.center[0]) / view.focal, -(row - view.center[1]) / view.focal, -np.ones(len(row))], axis=-1
    )
    return np.asarray(along * depth[inside, None].astype(np.float64))


def _lit(maps: SurfaceMaps, normal: Floats, ray: Floats, to_light: Floats, ior: float) -> Floats:
    """S0 (H, W, 3) of normals in the frames of their rays; to_light (3,) in the camera frame."""
    to_light = to_light / np.linalg.norm(to_light)
    local = frames.to_ray_frame(np.broadcast_to(to_light, ray.shape), ray)
    index, one = np.full(maps.mask.shape, ior), np.ones(maps.mask.shape)
    drawn = shade.stokes(normal, maps.diffuse, maps.specular, np.maximum(maps.roughness, 0.02), index, local, one)
    return np.asarray(drawn[0])


def _nearest(points: Floats, seen: Floats, view: View, shape: tuple[int, int]) -> Floats:
    """A picture (H, W, 3) of points (N, 3): in each pixel the one nearest to the eye, small holes closed."""
    height, width = shape[0] // _OVER, shape[1] // _OVER
    away = -points[:, 2]
    column = np.rint((view.focal * points[:, 0] / away + view.center[0]) / _OVER).astype(int)
    row = np.rint((-view.focal * points[:, 1] / away + view.center[1]) / _OVER).astype(int)
    order = np.argsort(-away)  # the nearest last
    order = order[((row >= 0) & (row < height) & (column >= 0) & (column < width))[order]]
    picture = np.zeros((height, width, 3), np.float32)
    hit = np.zeros((height, width), np.uint8)
    picture[row[order], column[order]] = seen[order]
    hit[row[order], column[order]] = 1
    closed = cv2.morphologyEx(hit, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    around = cv2.blur(picture, (3, 3)) / np.maximum(cv2.blur(hit.astype(np.float32), (3, 3)), 1e-6)[..., None]
    filled = np.where((hit == 0)[..., None], around, picture)
    return np.asarray(np.where((closed > 0)[..., None], filled, _GROUND))


def _developed(drawn: list[Floats]) -> list[Picture]:
    """Linear frames as sRGB, all with one exposure."""
    top = max(float(np.quantile(np.stack(drawn[:: FRAMES // 6])[..., 1], _BRIGHTEST)), 1e-6)
    return [color.srgb_eight_bits(0.9 * frame / top) for frame in drawn]
