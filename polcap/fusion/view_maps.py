"""Maps of a processed view as the fusion needs them: free of lens distortion, for the camera of the whole session."""

from dataclasses import replace

import cv2
import numpy as np

from polcap.fusion.poses import SessionCamera
from polcap.fusion.values import FusionView, Pose
from polcap.image_values import Distortion, Floats, View
from polcap.optics import distortion, frames, projection
from polcap.results import ResultsUntilInfer
from polcap.stages.cues import scale

_LEAST_SHIFT_PX = 0.02  # of the map: below, a lens counts as free of distortion and nothing is resampled


def fusion_view(
    name: str, results: ResultsUntilInfer, camera: SessionCamera, pose: Pose, metric: bool, undistort: bool
) -> FusionView:
    """The maps of a view's results, with its pose.

    `undistort` is the setting with which the capture's own calibration has corrected the lens, if there is one.
    """
    undistorted = undistort and results.radiance.equipment.distortion is not None
    maps, height, width = results.maps, *results.maps.mask.shape
    view = on_grid(camera, maps.view)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    lens = Distortion(view.focal, view.center, camera.k1, camera.k2)
    source_x, source_y = (x, y) if undistorted else distortion.distort(lens, x, y)
    normal = _turn_normals(maps.normal, maps.view, view, (source_x, source_y))
    found = FusionView(
        name=name,
        pose=pose,
        view=view,
        light=np.zeros(3),
        mask=np.asarray(maps.mask),
        normal=normal,
        sigma_deg=np.asarray(maps.confidence, np.float32),
        diffuse=np.asarray(maps.diffuse, np.float32),
        specular=np.asarray(maps.specular, np.float32),
        roughness=np.asarray(maps.roughness, np.float32),
        s0=np.asarray(results.cues.radiance, np.float32),
        white_distance=scale.surface_distance(maps.mask, maps.view) if scale.is_known(results.color) else None,
        metric=metric,
    )
    if max(np.abs(source_x - x).max(), np.abs(source_y - y).max()) < _LEAST_SHIFT_PX:
        return found
    return _resample(found, source_x.astype(np.float32), source_y.astype(np.float32))


def on_grid(camera: SessionCamera, grid: View) -> View:
    """The session's camera on the pixel grid of maps: map pixel i shows RAW pixels about scale·(origin + i)."""
    x, y = (projection.to_grid(at, grid.scale) - start for at, start in zip(camera.principal_px, grid.origin))
    return View(camera.focal_px / grid.scale, (x, y), grid.scale, grid.origin)


def _turn_normals(normal: Floats, before: View, after: View, source: tuple[Floats, Floats]) -> Floats:
    """Normals (H, W, 3), which were estimated in the frame of each ray, for the rays of another camera.

    The normal of a pixel turns with the pixel's ray.
    """
    height, width = normal.shape[:2]
    lens_x, lens_y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    moved = lens_x - (source[0] - lens_x), lens_y - (source[1] - lens_y)  # pinhole pixel that appears at each pixel
    local = frames.to_ray_frame(np.asarray(normal, np.float64), frames.rays(before, height, width))
    return np.asarray(frames.from_ray_frame(local, frames.rays_at(after, *moved)), np.float32)


def _resample(view: FusionView, x: Floats, y: Floats) -> FusionView:
    """The view with pixels from the places x, y (H, W)."""

    def linear(image: Floats) -> Floats:
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    mask = cv2.remap(view.mask.astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.5
    return replace(
        view,
        mask=mask,
        normal=frames.unit(linear(view.normal)),
        sigma_deg=linear(view.sigma_deg),
        diffuse=linear(view.diffuse),
        specular=linear(view.specular),
        roughness=linear(view.roughness),
        s0=None if view.s0 is None else linear(view.s0),
    )
