"""capture.toml: its facts are used, and a wrong key or value is one clear line."""

from typing import Any

import pytest

from polcap.errors import CaptureError
from polcap.formats.capture import reader as capture
from polcap.formats.raw import frame_decoder
from tests.formats.capture.capture_folders import degrees, each, folders, names, pictures, shoot, state

OUTSIDE = ("../", "sub/../../", "/", "..\\\\")


def test_a_clockwise_ring_negates_the_angles(tmp_path):
    folder = folders(tmp_path)
    assert degrees(capture.read(folder, clockwise=True)) == [0, -45, -90]
    assert degrees(capture.read(folder, (90.0, 0.0, 45.0), clockwise=True)) == [-90, 0, -45]
    (folder / "capture.toml").write_text("clockwise = true\n")
    understood = capture.read(folder)
    assert degrees(understood) == [0, -45, -90] and "angles counted clockwise, as stated" in understood.notes


def test_capture_toml_states_angles_roles_and_exposures(tmp_path):
    for number in range(9):
        shoot(tmp_path / f"{number}.dng", 1 / 50, f_number=8, iso=200)
    (tmp_path / "log.csv").write_text("0\n")
    entries: list[dict[str, Any]] = [
        *[{"angle": angle, "flash_energy": energy} for angle in (0, 60, 120) for energy in (1.0, 0.25)],
        {"angle": 0, "role": "ambient"}, {"role": "chart"}, {"role": "ambient"},
    ]  # fmt: skip
    lines = ['name = "bowl"', "focal_length_mm = 60", "sensor_width_mm = 36", 'rotator = { log = "log.csv" }']
    for number, entry in enumerate(entries):
        lines += ["[[frame]]", f'file = "{number}.dng"']
        lines += [f'{key} = "{value}"' if key == "role" else f"{key} = {value}" for key, value in entry.items()]
    (tmp_path / "capture.toml").write_text("\n".join(lines))
    understood = capture.read(tmp_path)
    assert (understood.layout, understood.name) == ("toml", "bowl")
    assert degrees(understood) == [0, 60, 120]
    assert names(understood.shots[0]) == ["1.dng", "0.dng"]
    assert understood.shots[0].frames[1].exposure == pytest.approx(1.0 * 200 / 100 / 64)
    assert [len(shot.ambient) for shot in understood.shots] == [2, 1, 1]
    assert [frame.path.endswith("7.dng") for frame in understood.chart_frames] == [True]
    assert understood.focal_known and understood.focal_px == pytest.approx(60 / 36 * 48)


def test_a_catalog_fact_outside_its_table_is_named_with_its_place(tmp_path):
    folder = folders(tmp_path)
    (folder / "capture.toml").write_text('title = "Vase"\n')
    with pytest.raises(CaptureError, match=r"title: is a fact of the catalog; write it below a line \[catalog\]"):
        capture.read(folder)


def test_capture_toml_may_come_from_windows(tmp_path):
    each(tmp_path, ("pol000", "pol045", "pol090"))
    state(tmp_path, {f"pol{angle:03d}\\\\a.dng": angle for angle in (0, 45, 90)}, name='"bowl"')
    text = (tmp_path / "capture.toml").read_bytes().replace(b"\n", b"\r\n")
    (tmp_path / "capture.toml").write_bytes(b"\xef\xbb\xbf" + text)  # with a byte order mark
    understood = capture.read(tmp_path)
    assert (understood.name, degrees(understood)) == ("bowl", [0, 45, 90])


def test_a_repeat_is_a_shot_of_its_own_at_about_its_angle(tmp_path):
    """A motor that returns to 45° may report 45.02°; at 0° it may report 179.99°."""
    repeat = '\nrole = "repeat"'
    angles = {"a": 0, "b": 45, "c": 90, "d": f"45.02{repeat}", "e": f"179.99{repeat}", "f": f"60{repeat}"}
    state(tmp_path, {shoot(tmp_path / f"{name}.dng").name: angle for name, angle in angles.items()})
    understood = capture.read(tmp_path)
    assert degrees(understood) == pytest.approx([0, 45, 90, 45.02, 179.99])
    assert understood.shots[3].frames[0].role == "repeat"


def test_capture_toml_without_frames_only_adds_facts(tmp_path):
    folder = pictures(tmp_path, [f"pol_{angle}.tif" for angle in (0, 45, 90)])
    (folder / "capture.toml").write_text('encoding = "srgb"\nfocal_length_mm = 50\nsensor_width_mm = 36\n')
    stated = capture.read(folder)
    assert stated.layout == "flat" and stated.focal_known
    assert frame_decoder.decode(stated.shots[0].frames[0]).lossy
    (folder / "capture.toml").unlink()
    assumed = capture.read(folder)
    assert not assumed.focal_known and not frame_decoder.decode(assumed.shots[0].frames[0]).lossy
    assert assumed.shots[0].frames[0].digest != stated.shots[0].frames[0].digest  # other values, other key


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('nmae = "x"', "nmae"),
        ("focal_length_mm = -1", "focal_length_mm"),
        ('[[frame]]\nfile = "a.dng"', "has role shot and no angle"),
        ('[[frame]]\nfile = "gone.dng"\nangle = 0', r"no file gone\.dng"),
        ('[[frame]]\nfile = "a.dng"\nangle = 0\nexposure = 1\nflash_energy = 1', "both exposure and flash_energy"),
        ('[[frame]]\nfile = "a.dng"\nangle = 0\nrole = "sample"', "sample"),
        ("focal_length_mm = ", "capture.toml"),
        ('[rotator]\nlog = "no.csv"', r"no rotator log no\.csv"),
        ("cells = [[0, 45], [90, 90]]", "the angles of the sensor's 2×2 cell, row by row: 0, 45, 90 and 135"),
        ("cells = [[0, 30], [60, 90]]", "the angles of the sensor's 2×2 cell"),  # no sensor has these
        *((f'[[frame]]\nfile = "{path}a.dng"\nangle = 0', "lies outside the folder") for path in OUTSIDE),
        ("\n".join(f'[[frame]]\nfile = "a.dng"\nangle = {a}' for a in (0, 45, 90)), "names a file twice"),
    ],
)
def test_capture_toml_is_strict(tmp_path, text, message):
    for folder in (tmp_path, tmp_path / "vase"):
        shoot(folder / "a.dng")
    (folder / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        capture.read(folder)
