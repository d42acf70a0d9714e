"""Exposure brackets: parsed, by default, and with the camera's nearest settings."""

import pytest

from polcap.errors import SettingError
from polcap.rig.exposure_bracket import Exposure, bracket_by_iso, nearest, parse_bracket


def test_a_bracket_by_iso_takes_what_the_camera_offers() -> None:
    assert [one.iso for one in bracket_by_iso([50, 100, 200, 400, 800, 1600])] == [100, 400, 1600]
    assert [one.iso for one in bracket_by_iso([160, 320, 640, 1250, 2500])] == [160, 640, 2500]
    with pytest.raises(SettingError, match="flash power or aperture"):
        bracket_by_iso([])


def test_a_bracket_is_read_as_photographers_write_it() -> None:
    assert [frame.time_s for frame in parse_bracket("1/200,1/50,0.5s")] == [0.005, 0.02, 0.5]
    flash = parse_bracket("1/160 f/11 iso100 flash1/64, flash1/16")
    assert flash[1] == Exposure(time_s=1 / 160, f_number=11.0, iso=100.0, flash=1 / 16)
    assert parse_bracket(", ".join(map(str, flash))) == flash
    for wrong in ("fast", "1/50,1/50", "f/0", ""):
        with pytest.raises(SettingError, match="--bracket"):
            parse_bracket(wrong)


def test_the_nearest_setting_is_so_in_stops() -> None:
    assert nearest("time_s", 1 / 60, [0.1, 0.02, 0.01]) == 0.02
    assert nearest("f_number", 9.5, [8.0, 11.0], power=2.0) == 11.0
    with pytest.raises(SettingError, match=r"f_number 9\.5"):
        nearest("f_number", 9.5, [5.6, 16.0], power=2.0)
