"""Estimates the chart's plane, the position of the flash and the falloff of light, from the chart in one shot.

A flash at L lights a point P of a chart with normal n by n·(L − P)/|L − P|³. Across the chart n·(L − P) is constant. So
the slope of the light over the chart shows where the flash is: the relative change per patch is 3 pitches over the
distance, times the sine of the angle from the normal to the flash. A lamp near the chart or a lens's vignetting adds
another slope, with an unknown effect on the level. The chart's orientation comes from its homography: its first two
columns point along the chart's rows and columns.

References
----------
Zhang, A flexible new technique for camera calibration, IEEE PAMI 2000 (pose from a homography).
"""

from dataclasses import dataclass

import numpy as np

from polcap.chart_values import ChartLight
from polcap.image_values import Floats, View
from polcap.optics import point_light
from polcap.stages.whitebalance import chart, patches
from polcap.stages.whitebalance.chart import Placement

# 1σ before the measurement: flash right of the lens, above the lens [chart distances], power of the falloff. A hot shoe
# is 0.1 to 0.15 m above the lens, objects at about 1 m; cos⁴ is a lens's natural falloff, cos⁰ a corrected one.
_PRIOR = np.array([0.1, 0.1, 2.0])
# 1σ of the chart's tilt by its outline [rad]: corners are right to 0.2 % of the chart, lenses distort by 1 %. And
# relative 1σ of a guessed focal length; the tilt has the same relative error.
_TURN_SIGMA, _FOCAL_SPREAD = 0.03, 0.3
_FARTHEST = 0.3  # largest distance of the flash from the lens [chart distances]
_LIGHT_PER_DELTA_E = 0.02  # relative error of Y per ΔE2000; about half of a ΔE is lightness
_LEAST_PATCH_ERROR = 0.005  # least relative error of Y
# A slope that the flash does not cause: 1σ before the measurement [per patch], and the error of the level per unit of
# it [patches]. On 40 charts lit by a lamp of their own or darkened by vignetting the level was off by 3 to 10 patches.
_OTHER_SLOPE, _OTHER_LEVEL = 0.012, 6.0
_STEP = 1e-4  # of the unknowns, for derivatives
_ROUNDS = 4  # of Gauss–Newton
_PLANE_FIT = np.linalg.pinv(
    np.column_stack([np.ones(24), patches.position()])
)  # (3, 24) maps the light of patches to level and slope


def measure(place: Placement, view: View, slope: Floats, delta_e: float) -> ChartLight:
    """Estimate the chart's plane, the most probable flash position and light falloff, and their covariance.

    slope (2,) is the relative change of the light per patch, towards the chart's right and down, at the white patch.
    delta_e, the mean residual of the patches, determines its error.
    """
    outlined = _ChartPlane(*_plane(place, view))
    tilt = np.hypot(*outlined.normal[:2]) / outlined.normal[2]  # tangent of the tilt from the image plane
    turn_sigma = _TURN_SIGMA if view.known else float(np.hypot(_TURN_SIGMA, _FOCAL_SPREAD * min(tilt, 1.0)))
    prior_precision = np.diag(1 / np.array([*_PRIOR, turn_sigma, turn_sigma, _OTHER_SLOPE, _OTHER_SLOPE]) ** 2)
    patch_error = max(_LEAST_PATCH_ERROR, _LIGHT_PER_DELTA_E * delta_e)
    precision = np.linalg.inv(patch_error**2 * (_PLANE_FIT @ _PLANE_FIT.T)[1:, 1:])

    state = np.zeros(7)  # flash (2,), falloff, turn (2,), other slope (2,)
    for _ in range(_ROUNDS):
        model = _slope(outlined, state)
        by_state = np.stack([(_slope(outlined, state + step) - model) / _STEP for step in _STEP * np.eye(7)], axis=1)
        covariance = np.linalg.inv(prior_precision + by_state.T @ precision @ by_state)
        state = covariance @ by_state.T @ precision @ (slope - model + by_state @ state)
        state[:2] = np.clip(state[:2], -_FARTHEST, _FARTHEST)
    found = outlined.turned(state[3:5])
    uneven = float(_OTHER_LEVEL * np.hypot(*state[5:]))
    return ChartLight(found.point[patches.WHITE], found.normal, state[:3], covariance[:5, :5], uneven)


@dataclass(frozen=True)
class _ChartPlane:
    """Place and direction of a chart."""

    point: Floats  # (24, 3) patch centers in the camera frame, in units of the distance of the chart's center
    normal: Floats  # (3,)

    def turned(self, turn: Floats) -> "_ChartPlane":
        """The chart's plane after a small rotation (2,) about x and y [rad] through its center."""
        from scipy.spatial.transform import Rotation  # here: the import takes 0.2 s

        rotation, middle = Rotation.from_rotvec([*turn, 0.0]), self.point.mean(axis=0)
        return _ChartPlane(middle + rotation.apply(self.point - middle), rotation.apply(self.normal))


def _slope(outlined: _ChartPlane, state: Floats) -> Floats:
    """Relative change (2,) of the light per patch, to the chart's right and down, as `state` (7,) predicts it.

    The light on the patches is fitted by a plane. `state` as in `measure`: flash (2,) [chart distances], power of the
    falloff, turn (2,) [rad], and the slope (2,) that the flash does not cause [per patch].
    """
    plane = outlined.turned(state[3:5])
    level, *slope = _PLANE_FIT @ point_light.irradiance(plane.point, state[:2], state[2], plane.normal)
    return np.asarray(np.array(slope) / level + state[5:])


def _plane(place: Placement, view: View) -> tuple[Floats, Floats]:
    """Chart plane in the camera frame: patch centers (24, 3) in units of the chart's distance, and normal (3,)."""
    pose = np.diag([1.0, -1.0, -1.0]) @ np.linalg.solve(view.intrinsic, place.homography)
    pose = -pose / (pose[2] @ [chart.COLUMNS / 2, chart.ROWS / 2, 1])
    normal = np.cross(pose[:, 1], pose[:, 0])
    at = chart.centers()
    return at @ pose[:, :2].T + pose[:, 2], normal / (np.linalg.norm(normal) * np.sign(normal[2]))
