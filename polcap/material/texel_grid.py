"""Grid of texels on the plane of the sample, and the geometry of each view at its points.

The plane's frame is x right, y up the printed page, z out of it; its point (x, y, z) is (x, z, −y) in the board's world
frame. Row 0 of a map is at the top of the page.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polcap.fusion.values import Pose
from polcap.image_values import Floats, Indices
from polcap.optics import frames

TO_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from the plane's frame


@dataclass(frozen=True)
class TexelGrid:
    """Texels of a rectangle on the board's plane; their middles are at origin + texel · (column, row)."""

    origin: tuple[float, float]  # m, x and z (down the page) of the first texel's middle, world frame
    texel: float  # m
    size: tuple[int, int]  # columns, rows

    def coarser(self, step: int) -> "TexelGrid":
        """The grid of blocks of step × step texels; incomplete blocks are left out."""
        shift = (step - 1) / 2 * self.texel
        first = self.origin[0] + shift, self.origin[1] + shift
        return TexelGrid(first, self.texel * step, (self.size[0] // step, self.size[1] // step))

    def points(self, height: Floats) -> Floats:
        """World points (H, W, 3) [m] of the texels at heights (H, W) [m] over the board."""
        x = self.origin[0] + self.texel * np.arange(self.size[0])
        z = self.origin[1] + self.texel * np.arange(self.size[1])
        return np.stack([*np.broadcast_arrays(x[None], height, z[:, None])], axis=-1)


@dataclass(frozen=True)
class FlashLight:
    """Flash beside the lens, the same in all views, and its energy in each."""

    place: Floats  # (3,) m, camera frame
    gain: Floats  # (K,) irradiance at 1 m that faces the flash, in units of a white plane's S0
    shot_matrix: Floats  # (K, 3, 3, 3) channel, corrected Stokes parameters from those of a view
    sigma: float  # relative, of the paper's radiance about the model
    paper: float  # albedo of the board's paper that the model implies
    shine: float  # highlight of the paper over its diffuse reflection, at the brightest point


@dataclass(frozen=True)
class TexelViews:
    """Directions and light at N points of the sample in K views, in the frame of each ray."""

    normal_to_ray: Floats  # (K, N, 3, 3) rows e_x, e_y, v in the plane's frame
    to_light: Floats  # (K, N, 3) unit
    irradiance: Floats  # (K, N) on a plane that faces the flash

    def take(self, index: slice | Indices) -> "TexelViews":
        """The geometry at some of the points."""
        return TexelViews(self.normal_to_ray[:, index], self.to_light[:, index], self.irradiance[:, index])


def geometry(point: Floats, poses: Sequence[Pose], light: FlashLight) -> TexelViews:
    """Directions and irradiance at world points (N, 3) [m] in all views."""
    rays, lights, levels = [], [], []
    for pose, gain in zip(poses, light.gain, strict=True):
        in_camera = pose.to_camera(point)
        v = frames.unit(-in_camera)
        across, up = frames.basis(v)
        axes = np.stack([across, up, v], axis=-2)  # (N, 3, 3) in the camera frame
        rays.append((axes @ (pose.rotation @ TO_WORLD)).astype(np.float32))
        towards = light.place - in_camera
        squared = frames.dot(towards, towards)
        lights.append(frames.to_ray_frame(towards / np.sqrt(squared)[:, None], v).astype(np.float32))
        levels.append((gain / squared).astype(np.float32))
    return TexelViews(np.stack(rays), np.stack(lights), np.stack(levels))
