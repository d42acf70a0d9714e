"""Values of the fusion: views with their poses, and the closed mesh.

World frame: that of the board. The origin is the board's middle, y points up out of the board, x and z lie in it,
right-handed, metres. Without a board, y is the axis of the object's turn, and the origin is on it below the object; if
the scale is unknown, the unit is the distance of the lens from this axis. Camera frame: x right, y up, z towards the
camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats, View

IOR = 1.5  # refractive index that the fusion assumes for diffuse reflection and Fresnel's terms


@dataclass(frozen=True)
class Pose:
    """Position of the board before the camera: camera point = rotation @ world point + translation."""

    rotation: Floats  # (3, 3) world to camera
    translation: Floats  # (3,) m

    @property
    def center(self) -> Floats:
        """Position (3,) of the lens in the world, m."""
        return -self.rotation.T @ self.translation

    def to_camera(self, point: Floats) -> Floats:
        """World points (N, 3) in the camera frame, m."""
        return point @ self.rotation.T + self.translation


@dataclass(frozen=True)
class FusionView:
    """Maps of one capture, free of lens distortion, and its pose."""

    name: str
    pose: Pose
    camera: View  # pinhole camera of the maps' grid
    mask: Bools  # (H, W)
    normal: Floats  # (H, W, 3) unit, camera frame
    sigma_deg: Floats  # (H, W) expected error of the normals
    diffuse: Floats  # (H, W, 3) albedo, linear Rec.709
    specular: Floats  # (H, W, 3) F0
    roughness: Floats  # (H, W) perceptual
    s0: Floats | None = None  # (H, W, 3) white-balanced radiance under the flash at the lens
    white_distance: float | None = None  # where a white plane has S0 = 1, over the object's distance; None: unknown
    metric: bool = True  # the pose is in metres; else its unit is the distance of the lens


@dataclass(frozen=True)
class ViewMask:
    """The object's mask on the merged picture of a view."""

    mask: Bools  # (H, W)
    scale: float  # RAW px per px


@dataclass(frozen=True)
class ClosedMesh:
    """A closed, manifold triangle mesh, outward orientation, in the world frame."""

    vertices: Floats  # (V, 3) m
    faces: NDArray[np.int32]  # (F, 3) counter-clockwise seen from outside
