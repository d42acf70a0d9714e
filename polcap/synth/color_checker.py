"""Simulated ColorChecker Classic: flat, matt, unpolarized patches in a black frame."""

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polcap.formats import shipped_data
from polcap.image_values import Floats

_PATCH, _FRAME, _FRAME_ALBEDO = 0.88, 0.18, 0.03  # side of a patch and width of the frame, in patch pitches
_MIDDLE = np.array([3, 2]) - (1 - _PATCH) / 2  # column and row of the chart's middle


class Chart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose and size of the chart. Without a turn it faces the lens, dark skin at the top left."""

    center: tuple[float, float, float] = (0.105, 0.0, -0.70)  # m, camera frame
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector
    pitch: float = 0.0155  # m from patch to patch

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m] of the chart between the outer corners of its patches."""
        return self.pitch * (5 + _PATCH), self.pitch * (3 + _PATCH)

    @property
    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Unit vectors of the chart: its normal, along the rows, down the columns."""
        turn = Rotation.from_rotvec(self.turn_deg, degrees=True)
        return turn.apply([0.0, 0.0, 1.0]), turn.apply([1.0, 0.0, 0.0]), turn.apply([0.0, -1.0, 0.0])


def corners(chart: Chart) -> Floats:
    """Outer corners of the chart's patch field (4, 3) [m, camera frame], dark skin first, clockwise."""
    return _points(chart, np.array([[0, 0], [5 + _PATCH, 0], [5 + _PATCH, 3 + _PATCH], [0, 3 + _PATCH]]))


def patches(chart: Chart, margin: float = 0.0) -> Floats:
    """Corners of every chart patch (24, 4, 3) [m, camera frame], moved inwards by `margin` of the patch's side."""
    origin = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(24, 1, 2)
    near, far = _PATCH * margin, _PATCH * (1 - margin)
    return _points(chart, origin + np.array([[near, near], [far, near], [far, far], [near, far]]))


def intersect(chart: Chart, v: Floats) -> tuple[NDArray[np.integer], Floats, Floats]:
    """Intersect rays v (P, 3) with the chart: indices (N,) of the rays that hit it, lengths (N,) [m], albedo (N, 3)."""
    center = np.array(chart.center)
    near = np.flatnonzero(-(v @ center) > np.linalg.norm(center) * np.cos(5 * chart.pitch / np.linalg.norm(center)))
    distance, column, row = meet_plane(chart, v[near])  # rays within five pitches of the chart's middle
    on = (np.abs(column) < 3 + _FRAME) & (np.abs(row) < 2 + _FRAME) & (distance > 0)
    column, row = column[on] + _MIDDLE[0], row[on] + _MIDDLE[1]
    patch = (column >= 0) & (row >= 0) & (column % 1 < _PATCH) & (row % 1 < _PATCH) & (column < 6) & (row < 4)
    number = np.where(patch, row.astype(int) * 6 + column.astype(int), 24)
    colors = np.vstack([shipped_data.colorchecker().rec709, np.full((1, 3), _FRAME_ALBEDO)])
    return near[on], distance[on], colors[number]


def meet_plane(chart: Chart, v: Floats) -> tuple[Floats, Floats, Floats]:
    """Intersect rays with the chart's plane: lengths [m]; columns and rows from the chart's middle, in patches.

    v (P, 3) are unit vectors from the surface to the lens.
    """
    facing, across, down = chart.axes
    distance = -(np.array(chart.center) @ facing) / (v @ facing)
    point = -v * distance[:, None] - chart.center
    return distance, point @ across / chart.pitch, point @ down / chart.pitch


def _points(chart: Chart, column_row: Floats) -> Floats:
    """Points (..., 3) in the chart's plane for (column, row) coordinates (..., 2) from its first patch corner."""
    _, across, down = chart.axes
    return np.array(chart.center) + (column_row - _MIDDLE) @ (chart.pitch * np.stack([across, down]))
