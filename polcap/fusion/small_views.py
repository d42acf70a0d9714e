"""Views reduced to the resolution of the shape: silhouette distances and world normals, and their values at points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from scipy import ndimage

from polcap import parallel
from polcap.fusion.values import FusionView, Pose
from polcap.image_values import Bools, Floats, View
from polcap.optics.frames import dot, unit
from polcap.optics.projection import project
from polcap.optics.resize import area_mean, weighted_area_mean

SIDE = 420  # px of the object's box in a small view, at most: three to a step of the default grid
_MARGIN = 3  # px around the box
_LEAST_SIGMA = 1.0  # deg, least expected error of a normal
_ROW = 1024  # points in a row of cv2.remap, which takes 32,767 at most


@dataclass(frozen=True)
class SmallView:
    """One view on its own small grid, cropped to the object; images are float32."""

    pose: Pose
    camera: View
    outline: Floats  # (H, W) signed distance from the silhouette's border, px, negative inside
    slope: Floats  # (H, W, 2) gradient of `outline` along x and y
    normal: Floats  # (H, W, 3) unit, world frame; 0 outside
    certainty: Floats  # (H, W) 1/σ² of the normals, 1/deg²; 0 outside
    diffuse: Floats  # (H, W, 3) albedo

    def distance(self, point: Floats) -> Floats:
        """Signed distances (N,) m of world points (N, 3) from the cone of the silhouette, negative inside."""
        in_camera = point @ self.pose.rotation.T.astype(point.dtype) + self.pose.translation.astype(point.dtype)
        pixel = project(self.camera, in_camera)
        height, width = self.outline.shape
        inside = np.clip(pixel, 0, np.array([width - 1, height - 1], pixel.dtype))
        distance_px = sample(self.outline, inside) + np.hypot(*(pixel - inside).T)  # plus the way to the picture
        return np.asarray(distance_px * -in_camera[:, 2] / self.camera.focal)

    def pixels(self, point: Floats) -> Floats:
        """Pixels x, y (N, 2) of world points (N, 3)."""
        return project(self.camera, self.pose.to_camera(point))

    def towards(self, point: Floats) -> Floats:
        """Unit vectors (N, 3) from world points (N, 3) to the lens."""
        return unit(self.pose.center - point)

    def nearest_rim(self, point: Floats) -> tuple[Floats, Floats]:
        """Pixels x, y (N, 2) of the silhouette nearest to world points (N, 3), and normals (N, 3) of a surface there.

        These unit normals point out of the silhouette, square to the rays of the points, in the world frame.
        """
        pixel = self.pixels(point)
        slope = sample(self.slope, pixel)
        outward_px = slope / np.maximum(np.hypot(*slope.T), 1e-9)[:, None]
        outward = np.concatenate([outward_px * [1, -1], np.zeros((len(pixel), 1))], axis=1) @ self.pose.rotation
        ray = self.towards(point)
        normal = unit(outward - ray * dot(outward, ray)[:, None])
        return pixel - outward_px * sample(self.outline, pixel)[:, None], normal


def reduce_views(views: Sequence[FusionView]) -> list[SmallView]:
    """Crop each view to its object and reduce it to SIDE px."""
    return parallel.results([partial(_reduce, view) for view in views])


def _reduce(of: FusionView) -> SmallView:
    """The view cropped to its object, with a margin, and reduced."""
    rows, columns = (np.flatnonzero(of.mask.any(axis=axis)) for axis in (1, 0))
    step = max(1.0, max(np.ptp(rows) + 1, np.ptp(columns) + 1) / SIDE)
    margin = int(np.ceil(_MARGIN * step))
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    box = np.s_[top : rows[-1] + margin + 1, left : columns[-1] + margin + 1]
    mask = of.mask[box]
    shape = tuple(max(1, round(side / step)) for side in mask.shape)
    scale = np.array(mask.shape[::-1]) / shape[::-1]  # px of the map per small px, x and y, equal within 1/SIDE
    x, y = ((np.array(of.camera.center) - (left, top)) + 0.5) / scale - 0.5
    camera = View(of.camera.focal / float(scale.mean()), (float(x), float(y)), of.camera.scale * float(scale.mean()))
    normal = weighted_area_mean(of.normal[box], mask, shape) @ of.pose.rotation
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    outline = area_mean(_signed_distance(mask), shape) / np.float32(scale.mean())
    certainty = np.where(mask, 1 / np.maximum(of.sigma_deg[box], _LEAST_SIGMA) ** 2, 0).astype(np.float32)
    return SmallView(
        pose=of.pose,
        camera=camera,
        outline=outline,
        slope=np.stack([np.gradient(outline, axis=axis) for axis in (1, 0)], axis=-1),
        normal=(normal / np.maximum(length, 1e-9)).astype(np.float32),
        certainty=area_mean(certainty, shape),
        diffuse=weighted_area_mean(of.diffuse[box], mask, shape),
    )


def _signed_distance(mask: Bools) -> Floats:
    """Signed distance (H, W) px from the border of a mask's pixels, negative inside."""
    framed = np.pad(mask, 1)
    # not OpenCV's precise transform: its last bits differ from run to run
    inside, outside = (ndimage.distance_transform_edt(m) for m in (framed, ~framed))
    signed = np.where(framed, 0.5 - inside, outside - 0.5)[1:-1, 1:-1]
    return np.asarray(cv2.GaussianBlur(signed.astype(np.float32), (0, 0), 1.0))  # evens the pixels' stairs


def sample(image: Floats, pixel: Floats, border: int = cv2.BORDER_REPLICATE) -> Floats:
    """Values (N,) or (N, C) of an image (H, W) or (H, W, C) at pixels x, y (N, 2), linear; `border` as in OpenCV."""
    rows = max(1, -(-len(pixel) // _ROW))
    x, y = np.zeros((2, rows, _ROW), np.float32)
    x.flat[: len(pixel)], y.flat[: len(pixel)] = pixel.T
    out = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(out.reshape(-1, *image.shape[2:])[: len(pixel)])
