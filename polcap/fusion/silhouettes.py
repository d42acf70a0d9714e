"""Masks of the views and a grid of points: which points lie inside a mask, and which of its pixels they cover.

They serve the comparison of the masks, before there are maps: full masks with the lens's distortion, on a grid of
cells. The shape is made later, from each `SmallView` on the grid of `hull.py`: signed distances without distortion.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from polcap.fusion.poses import SessionCamera
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Floats
from polcap.optics.resize import area_mean

_GRID = 80  # points along the longest side of the object's box
_COARSE = 40  # the same, to find this box


@dataclass(frozen=True)
class Silhouette:
    """The object's mask in one view."""

    name: str
    mask: Bools  # (H, W) of the photograph, or reduced
    camera: SessionCamera  # on the mask's pixels
    pose: Pose

    @property
    def distance(self) -> float:
        """Distance of the board's middle along the optical axis [m]."""
        return float(-self.pose.translation[2])

    def cell_px(self, step: float) -> float:
        """Size in the mask of a step [m] at the board's distance, px."""
        return step * self.camera.focal_px / self.distance

    def shows(self, points: Floats, step: float) -> Bools:
        """Whether cells of size `step` [m] around points (P, 3) touch the mask; false outside the picture."""
        reach = max(round(0.9 * self.cell_px(step)), 1)  # half the diagonal of a cell, about
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        grown = cv2.dilate(np.pad(self.mask.astype(np.uint8), reach + 1), disc)
        x, y = np.rint(self.camera.project(self.pose, points) + reach + 1).T
        height, width = grown.shape
        within = (x >= 0) & (y >= 0) & (x < width) & (y < height)  # near the lens plane no integer is as large
        row, column = (np.where(within, one, 0).astype(int) for one in (y, x))
        return np.asarray(within & (grown[row, column] > 0))

    def coarse(self, points: Floats, step: float) -> tuple[Bools, Bools]:
        """Mask (h, w) reduced to pixels as wide as a cell, and those of these pixels that points (P, 3) cover."""
        cell_px = max(self.cell_px(step), 1.0)
        height, width = (int(np.ceil(side / cell_px)) for side in self.mask.shape)
        mask = area_mean(self.mask, (height, width)) > 0.5
        x, y = np.rint((self.camera.project(self.pose, points) + 0.5) / cell_px - 0.5).astype(int).T
        within = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        covered = np.zeros((height, width), np.uint8)
        covered[y[within], x[within]] = 1
        return mask, cv2.dilate(covered, np.ones((3, 3), np.uint8)) > 0

    def covered(self, points: Floats, step: float) -> Bools:
        """Pixels (H, W) of the mask that the points cover."""
        covered, (height, width) = self.coarse(points, step)[1].astype(np.uint8), self.mask.shape
        return np.asarray(cv2.resize(covered, (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def grid_around(views: Sequence[Silhouette]) -> tuple[Floats, float]:
    """Grid points (P, 3) [m] around the object, and their spacing [m]."""
    reach = max(_extent(view) for view in views)  # m; the object is in a box about the board's middle
    low, high = np.array([-reach, -0.2 * reach, -reach]), np.array([reach, 2 * reach, reach])
    points, step = _grid(low, high, _COARSE)
    share = np.mean([view.shows(points, step) for view in views], axis=0)
    object_ = points[share >= max(0.5, 0.8 * share.max())]  # single masks may lack a part
    return _grid(object_.min(axis=0) - step, object_.max(axis=0) + step, _GRID)


def _grid(low: Floats, high: Floats, count: int) -> tuple[Floats, float]:
    """Points (P, 3) of a box, `count` steps along its longest side, and the step."""
    step = float((high - low).max() / count)
    axes = [np.arange(first, last + step, step) for first, last in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), step


def _extent(view: Silhouette) -> float:
    """Longer side of a mask at the board's distance [m]."""
    row, column = np.nonzero(view.mask)
    side_px = max(np.ptp(row), np.ptp(column)) if len(row) else 0
    return float(side_px) * view.distance / view.camera.focal_px


def halve(points: Floats, step: float) -> tuple[Floats, float]:
    """The points (8 P, 3) in the corners of the cells about `points`, and their spacing [m]."""
    corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return (points[:, None] + step * corners).reshape(-1, 3), step / 2
