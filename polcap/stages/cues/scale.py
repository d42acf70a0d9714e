"""The scale of the albedo and its error, by the chart's place and light.

The chart gives the ratio of reflectance to radiance at its own place and turn. The object is at another place: its
visible surface is nearer to the flash than its middle, and at another angle to the optical axis.
"""

from dataclasses import replace
from math import hypot, log, pi, sqrt

import numpy as np

from polcap.images import ChartLight, ColorCalibration, Floats, StokesImage
from polcap.optics import point_light
from polcap.optics.projection import back_project

_BULGE = 0.5  # mean distance of the visible surface before the middle, in radii: a cone's 1/3 to a ball's 2/3
_BULGE_SPREAD = 0.4  # 1σ of it over 204 views of training meshes and random shapes (decision 8)
_CHART_SPREAD = 3**-0.5  # radii: 1σ of the depth of a chart anywhere between the object's front and back
_LARGEST_RADIUS = 0.5  # of an object, over its distance; beyond, the law of the far field ends
_STEP = 1e-4


def factor(stokes: StokesImage, color: ColorCalibration) -> float:
    """Factor on the radiance after which 1 is a white plane on the axis, at the object's distance, facing the flash.

    Light falls off over the object, with distance and to the sides, as in the pictures of the network's training.
    """
    ahead = 1 - _BULGE * _radius(stokes)
    if color.light is None:
        return ahead**2
    return float(np.exp(_log_factor(color.light, _middle(stokes, ahead))))


def doubt(stokes: StokesImage, color: ColorCalibration) -> float | None:
    """Relative 1σ of the scale of all albedos; None where no chart in the picture gives it.

    The light falls with the square of the distance: a chart level with the object's front makes albedo too dark, one
    behind it too bright. The flash's place is known by the light's slope across the chart.
    """
    if color.source not in ("chart", "corners"):
        return None
    radius = _radius(stokes)
    ahead = 1 - _BULGE * radius
    depth = 2 * radius * hypot(_BULGE_SPREAD, _CHART_SPREAD) / ahead
    if color.light is None:
        return depth
    light, middle = color.light, _middle(stokes, ahead)
    here = _log_factor(light, middle)
    slope = np.array([_log_factor(_changed(light, step), middle) - here for step in _STEP * np.eye(5)]) / _STEP
    return hypot(depth, sqrt(slope @ light.covariance @ slope))


def _log_factor(light: ChartLight, middle: Floats) -> float:
    """ln of the chart's irradiance over the object's, the latter relative to a flash at the lens."""
    flash, power = light.flash[:2], float(light.flash[2])
    chart = point_light.irradiance(light.white, flash, power, light.normal)
    object_ = point_light.irradiance(middle, flash, power)
    alone = point_light.irradiance(middle, np.zeros(2), 0.0)
    return log(max(float(chart), 1e-6) * float(alone) / float(object_)) + 2 * log(-middle[2])


def _changed(light: ChartLight, step: Floats) -> ChartLight:
    """The light with flash and falloff moved by a step (5,), and the chart turned about x and y."""
    from scipy.spatial.transform import Rotation  # here: importing it costs .2 s of every start

    turned = Rotation.from_rotvec([*step[3:], 0.0]).apply(np.array(light.normal))  # SciPy takes no read-only array
    return replace(light, flash=light.flash + step[:3], normal=turned)


def _middle(stokes: StokesImage, distance: float) -> Floats:
    """The middle of the object's pixels (3,), camera frame, at a distance along the axis."""
    row, column = (axis.mean() for axis in np.nonzero(stokes.mask)) if stokes.mask.any() else (0.0, 0.0)
    return distance * back_project(stokes.view, np.array(column), np.array(row))


def _radius(stokes: StokesImage) -> float:
    """Radius of a disc of as many pixels as the object, over its distance."""
    return min(sqrt(stokes.mask.sum() / pi) / stokes.view.focal, _LARGEST_RADIUS)
