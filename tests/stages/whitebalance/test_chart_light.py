"""A chart's plane and the flash, back from its outline and from the slope of the light across it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.image_values import Floats, View
from polcap.stages.whitebalance import chart, chart_light, patches

VIEW = View(900.0, (255.5, 191.5), 2.0)
PITCH = 0.022  # of a chart, in its distances


def seen(
    turn_deg: tuple[float, float, float], at: tuple[float, float], sides: float = 1.0
) -> tuple[chart.Placement, Floats, Floats]:
    """A chart's place in the picture, its patches' points (24, 3) in distances of its middle, and its normal.

    `at`: its middle right of the axis and above it; `sides`: height of a patch's cell by its width.
    """
    turn = Rotation.from_rotvec(turn_deg, degrees=True)
    middle = np.array([*at, -1.0])
    flat = (chart.centers() - [3, 2]) * PITCH * [1, -sides]
    point = middle + turn.apply(np.column_stack([flat, np.zeros(24)]))
    px = np.column_stack([VIEW.center[0] - VIEW.focal * point[:, 0] / point[:, 2],
                          VIEW.center[1] + VIEW.focal * point[:, 1] / point[:, 2]])  # fmt: skip
    return chart.from_centers(px), point, turn.apply([0.0, 0.0, 1.0])


def slope(point: Floats, normal: Floats, flash: tuple[float, float]) -> Floats:
    """Relative change of n·l/d² per patch from the white one, by a straight fit over all."""
    to_light = np.array([*flash, 0.0]) - point
    light = to_light @ normal / np.linalg.norm(to_light, axis=1) ** 3
    level, *by = np.linalg.lstsq(np.column_stack([np.ones(24), patches.position()]), light, rcond=None)[0]
    return np.array(by) / level


def test_a_chart_square_to_the_lens_faces_it():
    place, point, normal = seen((0, 0, 4), (0, 0))
    found = chart_light.measure(place, VIEW, slope(point, normal, (0, 0)), 0.1)
    assert found.normal == pytest.approx([0, 0, 1], abs=1e-5)
    assert found.flash == pytest.approx(np.zeros(3), abs=1e-4)


@pytest.mark.parametrize("sides", [1.0, 1.03])
@pytest.mark.parametrize("turn", [(0, 20, 3), (-12, 5, -90), (8, -25, 178)])
def test_the_normal_of_a_tilted_chart_is_found_whatever_its_cells_sides(turn: tuple[float, float, float], sides: float):
    place, point, normal = seen(turn, (0.12, -0.05), sides)
    found = chart_light.measure(place, VIEW, slope(point, normal, (0, 0)), 0.1)
    assert found.normal == pytest.approx(normal, abs=1e-5)
    assert found.white == pytest.approx(point[patches.WHITE], abs=1e-5)
    assert np.cos(found.tilt) == pytest.approx(-normal @ point[patches.WHITE] / np.linalg.norm(point[patches.WHITE]))


@pytest.mark.parametrize("flash", [(0.09, 0.0), (0.0, 0.12), (-0.05, 0.07)])
def test_the_slope_of_the_light_gives_the_flash_s_place(flash: tuple[float, float]):
    """Within an error, because another lamp or the lens may cause the same slope."""
    place, point, normal = seen((5, 12, 3), (0.02, 0.0))  # on the axis the lens's falloff slopes nothing
    found = chart_light.measure(place, VIEW, slope(point, normal, flash), 0.1)
    error = found.flash[:2] - flash
    assert (np.abs(error) < 1.5 * np.sqrt(np.diag(found.covariance)[:2])).all()
    assert found.flash[:2] @ flash > 0
    assert found.uneven < 0.06


def test_a_slope_that_no_flash_at_the_lens_causes_makes_the_level_doubtful():
    place, point, normal = seen((5, 12, 3), (0.02, 0.0))
    lamp = slope(point, normal, (0, 0)) + np.array([0.06, 0.0])  # a third from side to side
    assert 0.15 < chart_light.measure(place, VIEW, lamp, 0.5).uneven < 0.35


def test_an_uncertain_slope_leaves_the_flash_at_the_lens():
    """Patches that are off by 10 % each."""
    place, point, normal = seen((0, 0, 0), (0.02, 0.0))
    found = chart_light.measure(place, VIEW, slope(point, normal, (0.1, 0.0)), 5.0)
    assert np.abs(found.flash[:2]).max() < 0.05
    assert np.sqrt(found.covariance[0, 0]) > 0.06


def test_a_flash_is_never_put_far_from_the_lens():
    place, _, _ = seen((0, 0, 0), (0.0, 0.0))
    found = chart_light.measure(place, VIEW, np.array([0.5, -0.5]), 0.1)
    assert np.abs(found.flash[:2]).max() <= 0.3
