"""Absolute scale of the albedo and its error, from the chart's position and light.

The chart gives the ratio of reflectance to radiance for its own position and orientation. The object is elsewhere: its
visible surface is nearer to the flash than its center, and in another direction from the lens. No picture shows how far
the chart is; the stage `infer` adds this error where albedos are too bright.
"""

from dataclasses import replace
from math import hypot, log, sqrt

import numpy as np

from polcap.chart_values import ChartLight, ColorCalibration
from polcap.image_values import Bools, Floats, View
from polcap.optics import point_light
from polcap.optics.outline import disc_radius
from polcap.optics.projection import back_project
from polcap.stage_values import StokesImage

_BULGE = 0.5  # radii; mean distance of the visible surface in front of the center: 1/3 for a cone, 2/3 for a ball
_BULGE_SPREAD = 0.4  # radii; its 1σ over 204 views of training meshes and random shapes (decision 8)
_CHART_SPREAD = 0.3  # radii: 1σ of the depth of a chart next to the middle of the object
_LARGEST_RADIUS = 0.5  # of an object, over its distance; for larger ones the far-field law does not hold
_STEP = 1e-4  # of the chart's light, for derivatives


def is_known(color: ColorCalibration) -> bool:
    """Whether a chart gives the scale: one in this picture, or in another with the same camera and flash in place."""
    return color.source in ("chart", "corners") or color.light is not None


def surface_distance(mask: Bools, view: View) -> float:
    """Distance of the visible surface over that of the object's middle and of the chart next to it; mask (H, W)."""
    return 1 - _BULGE * _radius(mask, view)


def factor(stokes: StokesImage, color: ColorCalibration) -> float:
    """Factor that scales the radiance of a white plane to 1, if it faces the flash at the object's place on the axis.

    The light still falls off over the object, with distance and to the sides, as in the training pictures.
    """
    distance = surface_distance(stokes.mask, stokes.view)
    if color.light is None:
        return distance**2
    return float(np.exp(_log_factor(color.light, _middle(stokes, distance))))


def sigma(stokes: StokesImage, color: ColorCalibration) -> float | None:
    """Relative error (1σ) of the scale of all albedos; None where no chart gives it.

    Light falls with the square of the distance: a chart at the object's front makes the albedo too dark, a chart
    behind the object too bright. The position of the flash comes from the slope of the light across the chart.
    """
    if not is_known(color):
        return None
    radius = _radius(stokes.mask, stokes.view)
    distance = surface_distance(stokes.mask, stokes.view)
    depth = 2 * radius * hypot(_BULGE_SPREAD, _CHART_SPREAD) / distance
    if color.light is None:
        return depth
    light, middle = color.light, _middle(stokes, distance)
    log_factor = _log_factor(light, middle)
    slope = np.array([_log_factor(_changed(light, step), middle) - log_factor for step in _STEP * np.eye(5)]) / _STEP
    return hypot(depth, light.uneven, sqrt(slope @ light.covariance @ slope))


def _log_factor(light: ChartLight, middle: Floats) -> float:
    """Logarithm of chart over object irradiance, without the falloff cos² of a flash at the lens (see `factor`)."""
    flash, power = light.flash[:2], float(light.flash[2])
    at_chart = point_light.irradiance(light.white, flash, power, light.normal)
    at_object = point_light.irradiance(middle, flash, power)
    lens_flash = point_light.irradiance(middle, np.zeros(2), 0.0)
    # lens_flash × depth² is cos² of the object's angle from the axis; a chart turned away from the flash has no light
    return log(max(float(at_chart), 1e-6) * float(lens_flash) / float(at_object)) + 2 * log(-middle[2])


def _changed(light: ChartLight, step: Floats) -> ChartLight:
    """Change the chart's light: flash position and falloff by step[:3]; rotate the chart by step[3:] about x and y."""
    from scipy.spatial.transform import Rotation  # here: the import takes 0.2 s

    turned = Rotation.from_rotvec([*step[3:], 0.0]).apply(np.array(light.normal))  # SciPy takes no read-only array
    return replace(light, flash=light.flash + step[:3], normal=turned)


def _middle(stokes: StokesImage, distance: float) -> Floats:
    """Center (3,) of the object's pixels in the camera frame, at a given depth along the optical axis."""
    row, column = (axis.mean() for axis in np.nonzero(stokes.mask)) if stokes.mask.any() else (0.0, 0.0)
    return distance * back_project(stokes.view, np.array(column), np.array(row))


def _radius(mask: Bools, view: View) -> float:
    """Radius of the object relative to its distance: that of a disc with as many pixels."""
    return min(disc_radius(mask) / view.focal, _LARGEST_RADIUS)
