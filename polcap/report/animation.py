"""Animations of a result: the object under a moving light, or rotating on a turntable."""

from dataclasses import replace
from typing import Literal, NamedTuple

import cv2
import numpy as np

from polcap.image_values import Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.optics import color, frames, outline, projection, shade
from polcap.optics.reduction import scaled_view
from polcap.optics.resize import area_mean
from polcap.report.sheets import Picture
from polcap.stage_values import SurfaceMaps

Motion = Literal["light", "turntable"]
FRAMES = 48
SECONDS = 4.0
SKY = 0.25  # light of the sky, relative to the lamp
_SIDE = 720  # px, at most, of a frame's longer side
_LIGHT_TILT = 0.75  # sine of the angle between the light's direction and the optical axis
_TURNTABLE_LIGHT = np.array([-0.35, 0.45, 0.82])  # direction towards the light: left, above and in front
_UP = np.array([0.0, 1.0, 0.0])  # camera frame
_SWING = np.radians(35.0)  # largest turn to either side; a larger one would show the unseen back
_OVERSAMPLING = 2  # surface points per pixel side, so that turning leaves no holes
_WHITE_QUANTILE = 0.995  # of the light; it becomes nearly white
_BACKGROUND = 0.012  # linear


class TexturedPoints(NamedTuple):
    """Normals (..., 3), diffuse albedo (..., 3), F0 (..., 3) and roughness (...,) of points of a surface."""

    normal: Floats
    diffuse: Floats
    specular: Floats
    roughness: Floats


def render(points: TexturedPoints, ray: Floats, to_light: Floats, up: Floats, ior: float) -> Floats:
    """Radiance (..., 3) of surface points under a distant lamp and a gray sky.

    Normals, `ray` (..., 3) towards the camera, `to_light` (3,) and `up` (3,) are in the camera's frame.
    """
    towards = np.asarray(to_light / np.linalg.norm(to_light), ray.dtype)
    lamp = frames.to_ray_frame(np.broadcast_to(towards, ray.shape), ray)
    facing = frames.lifted(frames.to_ray_frame(points.normal, ray))
    one, rough = np.ones(ray.shape[:-1], np.float32), np.maximum(points.roughness, np.float32(0.05))
    lit = shade.stokes(facing, points.diffuse, points.specular, rough, ior * one, lamp, one)[0]
    sky = 0.6 + 0.4 * (points.normal @ up.astype(np.float32))  # 1 on a normal upwards, 0.2 downwards
    return np.asarray(lit + SKY * (points.diffuse * sky[..., None] + points.specular), np.float32)


def light(maps: SurfaceMaps, ior: float) -> list[Picture]:
    """Frames of the object lit by a distant light that moves once around the optical axis."""
    sized = _ResizedMaps(maps, _SIDE)
    points, ray = sized.points(), frames.rays(sized.view, *sized.shape).astype(np.float32)
    drawn = []
    for turn in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        across = _LIGHT_TILT * np.array([np.sin(turn), np.cos(turn)])
        to_light = np.array([*across, np.sqrt(1 - across @ across)])
        drawn.append(_over_background(render(points, ray, to_light, _UP, ior), sized.coverage))
    return _to_srgb(drawn)


def turntable(maps: SurfaceMaps, mesh: ReliefMesh, ior: float) -> list[Picture]:
    """Frames of the surface rotated to both sides and back, under a fixed light near the camera."""
    sized = _ResizedMaps(replace(maps, mask=maps.mask & np.isfinite(mesh.depth)), _SIDE)
    surface, inside = sized.points(), sized.coverage > 0.5
    row, column = np.mgrid[: sized.shape[0], : sized.shape[1]].astype(np.float32)
    points = projection.back_project(sized.view, column, row) * sized.fit(mesh.depth)[..., None]  # (H, W, 3)
    middle = (points[inside].min(axis=0) + points[inside].max(axis=0)) / 2
    fine = tuple(_OVERSAMPLING * side for side in sized.shape[::-1])
    fine_inside = cv2.resize(sized.coverage, fine) > 0.5
    drawn = []
    for angle in _SWING * np.sin(np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32)
        moved = ((points - middle) @ turn.T + middle).astype(np.float32)
        turned = surface._replace(normal=surface.normal @ turn.T)
        shaded = render(turned, frames.unit(-moved), _TURNTABLE_LIGHT, _UP, ior)
        points_fine, shaded_fine = (np.asarray(cv2.resize(one, fine))[fine_inside] for one in (moved, shaded))
        drawn.append(_draw_points(points_fine, shaded_fine, sized.view, sized.shape))
    return _to_srgb(drawn)


class _ResizedMaps:
    """Maps of one view at the size of the base color, but with at most `longest` px a side.

    Values continue beyond the outline, whose pixels the object covers by `coverage` (H, W).
    """

    def __init__(self, maps: SurfaceMaps, longest: int) -> None:
        self.maps = maps
        height, width = maps.mask.shape
        factor = min(1 if maps.detail is None else 2, longest / max(height, width))
        self.shape = (max(1, round(height * factor)), max(1, round(width * factor)))
        self.view = scaled_view(maps.view, factor)
        self.coverage = self._resize(outline.matte(maps.mask))

    def fit(self, image: Floats) -> Floats:
        """An image (H, W) or (H, W, C) of the maps' grid in this size, continued beyond the outline."""
        planes = np.atleast_3d(image).astype(np.float32)
        return self._resize(outline.fill_outward(planes, self.maps.mask).reshape(image.shape))

    def points(self) -> TexturedPoints:
        """Normals, albedo with its detail, F0 and roughness, (H, W, …)."""
        maps = self.maps
        diffuse = self.fit(maps.diffuse)
        if maps.detail is not None:
            diffuse *= np.exp(self._resize(maps.detail.astype(np.float32)))[..., None]
        return TexturedPoints(
            frames.unit(self.fit(maps.normal)), diffuse, self.fit(maps.specular), self.fit(maps.roughness)
        )

    def _resize(self, image: Floats) -> Floats:
        if self.shape[0] < image.shape[0]:
            return area_mean(image, self.shape)
        return np.asarray(cv2.resize(image, self.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _over_background(drawn: Floats, coverage: Floats) -> Floats:
    """Radiance (H, W, 3) blended with the background by the object's coverage (H, W)."""
    return np.asarray(_BACKGROUND + (drawn - _BACKGROUND) * coverage[..., None], np.float32)


def _draw_points(points: Floats, value: Floats, view: View, shape: tuple[int, int]) -> Floats:
    """Draw points (N, 3) as a picture (H, W, 3): each pixel shows the nearest point; small holes are filled."""
    height, width = shape
    column, row = np.rint(projection.project(view, points)).astype(np.int32).T
    order = np.argsort(points[:, 2])  # the nearest last
    order = order[((row >= 0) & (row < height) & (column >= 0) & (column < width))[order]]
    picture = np.zeros((height, width, 3), np.float32)
    hit = np.zeros((height, width), np.uint8)
    picture[row[order], column[order]] = value[order]
    hit[row[order], column[order]] = 1
    closed = cv2.morphologyEx(hit, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    around = cv2.blur(picture, (3, 3)) / np.maximum(cv2.blur(hit.astype(np.float32), (3, 3)), 1e-6)[..., None]
    filled = outline.fill_outward(np.where((hit == 0)[..., None], around, picture), closed > 0)
    return _over_background(filled, outline.matte(closed > 0))


def _to_srgb(drawn: list[Floats]) -> list[Picture]:
    """Convert linear frames to sRGB, all with one exposure: by the green channel of six of them."""
    top = max(float(np.quantile(np.stack(drawn[:: FRAMES // 6])[..., 1], _WHITE_QUANTILE)), 1e-6)
    return [color.srgb_eight_bits(0.9 * frame / top) for frame in drawn]
