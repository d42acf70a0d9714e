"""Maps of a processed view as the fusion needs them: free of lens distortion, for the camera of the whole session."""

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
    mask, s0 = np.asarray(maps.mask), np.asarray(results.cues.radiance, np.float32)
    others = [np.asarray(one, np.float32) for one in (maps.confidence, maps.diffuse, maps.specular, maps.roughness)]
    if max(np.abs(source_x - x).max(), np.abs(source_y - y).max()) >= _LEAST_SHIFT_PX:
        source = source_x.astype(np.float32), source_y.astype(np.float32)

        def resample(image: Floats) -> Floats:
            return np.asarray(cv2.remap(image, *source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

        mask = cv2.remap(mask.astype(np.float32), *source, cv2.INTER_LINEAR) > 0.5
        normal, s0, others = frames.unit(resample(normal)), resample(s0), [resample(one) for one in others]
    white_distance = scale.surface_distance(maps.mask, maps.view) if scale.is_known(results.color) else None
    sigma_deg, diffuse, specular, roughness = others
    return FusionView(
        name, pose, view, mask, normal, sigma_deg, diffuse, specular, roughness, s0, white_distance, metric
    )


def on_grid(camera: SessionCamera, grid: View) -> View:
    """The session's camera on the pixel grid of maps: map pixel i shows RAW pixels about scale·(origin + i)."""
    x, y = (projection.to_grid(at, grid.scale) - start for at, start in zip(camera.principal_px, grid.origin))
    return View(camera.focal_px / grid.scale, (x, y), grid.scale, grid.origin)


def _turn_normals(normal: Floats, before: View, after: View, source: tuple[Floats, Floats]) -> Floats:
    """Normals (H, W, 3), which were estimated in the frame of each ray, for the rays of another camera.

    The normal of a pixel turns with the pixel's ray.
    """
    height, width = normal.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    pinhole = x - (source[0] - x), y - (source[1] - y)  # pixel of the undistorted picture that appears at each pixel
    local = frames.to_ray_frame(np.asarray(normal, np.float64), frames.rays(before, height, width))
    return np.asarray(frames.from_ray_frame(local, frames.rays_at(after, *pinhole)), np.float32)
