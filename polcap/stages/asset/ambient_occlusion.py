"""Ambient occlusion from normals and depth, by the horizon in sixteen directions.

References
----------
Jimenez et al., Practical real-time strategies for accurate indirect occlusion, 2016, eq. (7).
"""

import cv2
import numpy as np

from polcap.image_values import Floats
from polcap.optics import frames
from polcap.optics.projection import back_project
from polcap.stage_values import SurfaceMaps

_SIDE = 512  # px: longest side at which occlusion is computed, because it varies slowly
_DIRECTIONS = 16
_GROWTH = 1.05  # ratio of successive distances


def ambient_occlusion(maps: SurfaceMaps, depth: Floats) -> Floats:
    """Share (H, W) of a uniformly bright sky that reaches each pixel, weighted by the cosine; 1 outside the mask.

    `depth` (H, W) is along the optical axis. In each direction the horizon is the highest surface towards the camera.
    """
    height, width = maps.mask.shape
    step = -(-max(height, width) // _SIDE)
    row, column = (np.arange(step // 2, side, step) for side in (height, width))
    at = np.ix_(row, column)
    x, y = np.meshgrid(column, row)
    mask = maps.mask[at] & np.isfinite(depth[at])
    point = back_project(maps.view, x, y) * np.where(mask, depth[at], np.nan)[..., None]
    point, normal = point.astype(np.float32), maps.normal[at]
    distances = np.unique((_GROWTH ** np.arange(np.log(max(mask.shape)) / np.log(_GROWTH))).astype(int))
    reach = max(mask.shape)  # px, more than any distance
    around = np.pad(point, [(reach, reach), (reach, reach), (0, 0)], constant_values=np.nan)
    share = np.zeros(mask.shape, np.float32)
    for angle in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        along = normal[..., 0] * np.cos(angle) - normal[..., 1] * np.sin(angle)  # y runs up, rows run down
        tilt = np.arctan2(along, normal[..., 2])
        rise = -np.sin(tilt)  # cosine from optical axis to horizon, at first the tangent plane's
        for distance in distances:
            left, top = reach + round(distance * np.cos(angle)), reach + round(distance * np.sin(angle))
            towards = around[top : top + mask.shape[0], left : left + mask.shape[1]] - point
            rise = np.fmax(rise, towards[..., 2] / np.maximum(np.sqrt(frames.dot(towards, towards)), 1e-12))
        horizon = np.arccos(np.clip(rise, -1, 1))
        lit = np.cos(tilt) - np.cos(2 * horizon - tilt) + 2 * horizon * np.sin(tilt)
        share += np.hypot(along, normal[..., 2]) * lit / (2 * _DIRECTIONS)
    small = np.where(mask, np.clip(share, 0, 1), 1).astype(np.float32)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))
