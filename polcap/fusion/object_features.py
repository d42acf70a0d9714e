"""Features of the object in a view, for poses without a board.

They are found in the diffuse map, which has no highlights, with the measured normal at each of them.

References
----------
Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004. Arandjelović & Zisserman, Three things
everyone should know to improve object retrieval, CVPR 2012 (square roots of descriptors).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.chart_values import ColorCalibration
from polcap.errors import CaptureError
from polcap.fusion.values import ViewMask
from polcap.image_values import Floats
from polcap.optics import projection
from polcap.quality import flatness, shot_order
from polcap.stage_values import AngleStack, ObjectMask, SelfCalibration, StokesImage, SurfaceMaps
from polcap.stages import stage

_CONTRAST = 0.004  # least, of a feature; OpenCV's 0.04 is for photographs of high contrast


@dataclass(frozen=True)
class ObjectFeatures:
    """Features of a view, and the camera and mask of the maps in which they were found."""

    ray: Floats  # (N, 2) slopes X/−Z, Y/−Z in the camera frame
    normal: Floats  # (N, 3) unit, camera frame
    descriptor: NDArray[np.float32]  # (N, 128) unit; square roots, so that distances are Hellinger's
    focal: float  # px of the maps
    distance_m: float | None  # of the object, assumed equal to the chart's; None: unknown
    bend: tuple[float, float]  # k₁ and k₂ of the calibrated lens
    mask: ViewMask


@stage(version=2)
def find(
    radiance: AngleStack,
    color: ColorCalibration,
    object_: ObjectMask,
    calibration: SelfCalibration,
    stokes: StokesImage,
    maps: SurfaceMaps,
) -> ObjectFeatures:
    """Find features of the object in its diffuse map.

    Raises CaptureError: the outline or the network contradicts the order of the polarizer angles, so the normals are
    wrong everywhere.
    """
    flat = flatness.measure(stokes, maps)
    order = shot_order.order_of_shots(radiance, object_, calibration.outline, maps.order, flat)
    if order.state == "fail":
        raise CaptureError(f"{order.message}. {order.remedy}")
    lens = radiance.equipment.distortion
    return ObjectFeatures(
        *_features(maps),
        focal=maps.view.focal,
        distance_m=None if color.metres_per_px is None else color.metres_per_px * radiance.view.focal,
        bend=(0.0, 0.0) if lens is None else (lens.k1, lens.k2),
        mask=ViewMask(object_.mask, radiance.view.scale),
    )


def _features(maps: SurfaceMaps) -> tuple[Floats, Floats, NDArray[np.float32]]:
    """Rays (N, 2), normals (N, 3) and descriptors (N, 128) of features in the diffuse map with a display's gamma."""
    gray, mask = np.asarray(maps.diffuse, np.float32).mean(axis=-1), np.asarray(maps.mask)
    picture = 255 * np.clip(gray / max(float(np.quantile(gray[mask], 0.99)), 1e-6), 0, 1) ** (1 / 2.2)
    finder = cv2.SIFT.create(contrastThreshold=_CONTRAST)
    points, descriptor = finder.detectAndCompute(picture.astype(np.uint8), mask.astype(np.uint8))
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    # SIFT repeats a point for each of its orientations; the first one is used
    place, index = np.unique(np.array([point.pt for point in points]), axis=0, return_index=True)
    column, row = np.rint(place).astype(int).T
    ray = np.stack(projection.ray_slopes(maps.view, *place.T), axis=-1)
    roots = np.sqrt(descriptor[index] / descriptor[index].sum(axis=1, keepdims=True))
    return ray, np.asarray(maps.normal, np.float64)[row, column], roots
