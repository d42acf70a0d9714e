"""The focal length in pixels, and whether it is known."""

import math
from dataclasses import replace

import pytest

from polcap.capture_values import Exif
from polcap.formats.capture import focal_length

D90 = Exif(model="NIKON D90", focal_length_mm=50.0, width=4310, height=2868)


@pytest.mark.parametrize(("width", "height"), [(6000, 4000), (4000, 3000), (3000, 4000)])
def test_an_equivalent_has_the_diagonal_of_full_frame(width: int, height: int) -> None:
    """CIPA DCG-001: equal diagonals at any ratio of the sides; the whole angle of a 50 mm lens is 46.8°."""
    found = focal_length.find(Exif(focal_length_35mm=50.0, width=width, height=height), None, None)
    assert 2 * math.degrees(math.atan(math.hypot(width, height) / 2 / found.px)) == pytest.approx(46.79, abs=0.01)


def test_the_sensor_table_makes_a_focal_length_known_unless_exif_contradicts_the_stated_one() -> None:
    known = focal_length.find(D90, None, None)
    assert known.known and known.px == pytest.approx(50 / 23.6 * 4310)
    found = focal_length.find(D90, 24.0, None)
    shorter, longer = found.doubt  # EXIF states a longer one
    assert shorter == 0.0 and longer == pytest.approx(math.log(50 / 24))
    assert not found.known and "50 mm" in found.note
    assert found.px == pytest.approx(24 / 23.6 * 4310)  # the user's statement is used
    assert focal_length.find(D90, 51.0, None).known


CROPPED = Exif(model="Canon EOS 6D Mark II", focal_length_mm=40.0, width=4000, height=2667)  # a table width of 35.9 mm
PITCH_UM, TABLE_MM = 24e3 / 4000, 35.9  # of a picture 24 mm wide


@pytest.mark.parametrize(
    ("exif", "stated_width_mm", "width_mm", "other_mm"),
    [
        (replace(CROPPED, pixel_pitch_um=PITCH_UM), None, TABLE_MM, 24.0),
        (replace(CROPPED, focal_length_35mm=60.0), None, 24.0, TABLE_MM),
        (replace(CROPPED, pixel_pitch_um=PITCH_UM, focal_length_35mm=60.0), None, 24.0, TABLE_MM),
        (replace(CROPPED, pixel_pitch_um=PITCH_UM, focal_length_35mm=40.0), None, TABLE_MM, 24.0),
        (replace(CROPPED, pixel_pitch_um=2 * PITCH_UM), None, TABLE_MM, 48.0),
        (replace(CROPPED, model="", pixel_pitch_um=PITCH_UM, focal_length_35mm=40.0), None, 36.0, 24.0),
        (CROPPED, 24.0, 24.0, TABLE_MM),
        (replace(CROPPED, model="", pixel_pitch_um=PITCH_UM), 36.0, 36.0, 24.0),
    ],
)
def test_sources_that_contradict_each_other_leave_a_doubt(
    exif: Exif, stated_width_mm: float | None, width_mm: float, other_mm: float
) -> None:
    """The user's statement, or the source that most others confirm, decides; the doubt reaches to the others."""
    found = focal_length.find(exif, None, stated_width_mm)
    assert found.px == pytest.approx(40 / width_mm * 4000, rel=0.02)
    other = math.log(width_mm / other_mm)
    assert list(found.doubt) == pytest.approx([min(other, 0.0), max(other, 0.0)], abs=0.02)
    assert not found.known and " but " in found.note


def test_sources_that_differ_by_less_than_a_tenth_and_a_confirmed_statement_are_known() -> None:
    """The most precise source is used, or the user's, who has decided between two sources of the file."""
    found = focal_length.find(replace(CROPPED, pixel_pitch_um=35e3 / 4000, focal_length_35mm=41.0), None, None)
    assert found.known and found.px == pytest.approx(40 / 35.0 * 4000)
    decided = focal_length.find(replace(CROPPED, pixel_pitch_um=PITCH_UM), None, 36.0)
    assert decided.known and decided.px == pytest.approx(40 / 36 * 4000) and "24.0 mm" in decided.note


def test_doubts_on_focal_length_and_sensor_add_up() -> None:
    found = focal_length.find(replace(CROPPED, pixel_pitch_um=PITCH_UM), 80.0, None)
    assert list(found.doubt) == pytest.approx([math.log(40 / 80), math.log(TABLE_MM / 24)])


def test_every_sensor_width_is_one_that_cameras_have() -> None:
    widths = focal_length.sensor_widths()
    assert len(widths) > 300
    assert all(5 < width < 55 for width in widths.values())
