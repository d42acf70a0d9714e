"""The focal length in pixels, and whether it is known."""

import math

import pytest

from polcap.formats.capture import focal_length
from polcap.images import Exif


def test_sensor_table_makes_a_stated_focal_length_known() -> None:
    found = focal_length.find(Exif(model="NIKON D90", focal_length_mm=50.0, width=4310, height=2868), None, None)
    assert found.known and found.px == pytest.approx(50 / 23.6 * 4310)


@pytest.mark.parametrize(("width", "height"), [(6000, 4000), (4000, 3000), (3000, 4000)])
def test_an_equivalent_has_the_diagonal_of_full_frame(width: int, height: int) -> None:
    """CIPA DCG-001: equal diagonals at any ratio of the sides; the whole angle of a 50 mm lens is 46.8°."""
    found = focal_length.find(Exif(focal_length_35mm=50.0, width=width, height=height), None, None)
    assert 2 * math.degrees(math.atan(math.hypot(width, height) / 2 / found.px)) == pytest.approx(46.79, abs=0.01)


def test_a_stated_focal_length_that_contradicts_exif_is_not_known() -> None:
    exif = Exif(model="NIKON D90", focal_length_mm=50.0, width=4310, height=2868)
    found = focal_length.find(exif, 24.0, None)
    shorter, longer = found.doubt  # EXIF states a longer one
    assert shorter == 0.0 and longer == pytest.approx(math.log(50 / 24))
    assert not found.known and "50 mm" in found.note
    assert found.px == pytest.approx(24 / 23.6 * 4310)  # the user's statement is used
    assert focal_length.find(exif, 51.0, None).known


def test_every_sensor_width_is_one_that_cameras_have() -> None:
    widths = focal_length.sensor_widths()
    assert len(widths) > 300
    assert all(5 < width < 55 for width in widths.values())
