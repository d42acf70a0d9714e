"""EXIF of every maker: headers built here, and real files where available."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.errors import DecodeError, SettingError
from polcap.formats.raw import exif, file_checks, file_kind, probe
from polcap.formats.raw import libraw as raw
from tests.formats import headers
from tests.formats.headers import DATA, EXIF_IFD, SUB_IFDS, needs_data

PHOTO = headers.settings(time=1 / 50, f_number=8, iso=200, focal=60, flash=0x0F)
WITHOUT_ISO = {tag: value for tag, value in PHOTO.items() if tag != 34855}
WITH_EXIF = {EXIF_IFD: PHOTO}


def _exif(path):
    return probe.read(path).exif


def _kind(path):
    with path.open("rb") as file:
        return file_kind.kind(file, path.suffix)


def nef():
    sensor = {259: (3, (34713,)), 262: (3, (32803,)), 273: (4, (8,)), 279: (4, (0,))}
    return headers.tiff(headers.camera() | {254: (4, (1,))}, {SUB_IFDS: sensor, EXIF_IFD: PHOTO}, order="<")


BUILT = {
    "CR3": headers.cr3(headers.camera(), PHOTO),
    "RAF": headers.raf(headers.tiff(headers.camera(), WITH_EXIF)),
    "ORF": headers.tiff(headers.camera(), WITH_EXIF, magic=b"IIRO"),
    "RW2": headers.tiff(headers.camera(), WITH_EXIF, magic=b"IIU\0"),
    "MRW": headers.mrw(headers.tiff(headers.camera(), WITH_EXIF, magic=b"MM\0*", order=">")),
    "NEF": nef(),
    "IIQ": headers.tiff(headers.camera(), WITH_EXIF)[:8] + b"IIII" + headers.tiff(headers.camera())[12:],
}


@pytest.mark.parametrize("maker", BUILT)
def test_raw_is_known_by_its_content_and_its_header_gives_camera_and_settings(tmp_path, maker):
    path = tmp_path / "photo.jpg"  # the name is wrong
    path.write_bytes(BUILT[maker])
    assert _kind(path) == "raw"
    if maker == "IIQ":  # without settings
        return
    fact = exif.tags(BUILT[maker])
    assert (fact.make, fact.model, fact.lens, fact.taken) == ("Acme", "Z1", "Macro 60", "2026-01-02T03:04:05.25")
    assert (fact.f_number, fact.iso, fact.focal_length_mm, fact.flash_fired) == (8, 200, 60, True)
    assert fact.exposure_time == pytest.approx(1 / 50)
    assert fact.relative_exposure == pytest.approx(1 / 50 * 2 / 64)


@pytest.mark.parametrize(
    ("tags", "iso"), [({34855: (3, (65535,)), 34866: (4, (102400,))}, 102400), ({34855: (3, (0, 320))}, 320)]
)
def test_iso_beyond_sixteen_bits_after_a_zero_and_in_a_tag_of_panasonic_s_is_read(tags, iso):
    assert exif.tags(headers.dng(np.zeros((32, 32)), photo=PHOTO | tags)).iso == iso
    main = headers.camera() | {0x17: (3, (400,))}
    assert exif.tags(headers.tiff(main, {EXIF_IFD: WITHOUT_ISO}, magic=b"IIU\0")).iso == 400


def test_iso_without_a_tag_comes_from_the_decoder(tmp_path, monkeypatch):
    """Nikon's first cameras state it in tags of their own, old Kodaks have one ISO; standard tags have priority."""
    raw_directory = {file_kind.PHOTOMETRIC: (file_kind.CFA,)}
    of_a_maker = SimpleNamespace(dng=False, truncated=False, directories=(raw_directory,))
    monkeypatch.setattr(file_kind, "structure", lambda data: of_a_maker)
    monkeypatch.setattr(file_checks, "check_structure", lambda *known: None)
    monkeypatch.setattr(file_checks, "is_lossy", lambda structure: False)
    asked = []

    def size(path, data, unpack):
        asked.append(unpack)
        return {"width": 32, "height": 32, "exif": {"iso": 160.0, "exposure_time": 9.0}}

    monkeypatch.setattr(raw, "size", size)
    for photo, iso in ((PHOTO, 200), (WITHOUT_ISO, 160)):
        path = tmp_path / f"{iso}.dng"
        path.write_bytes(headers.dng(np.zeros((32, 32)), photo=photo))
        found = probe.examine(str(path))[0]["probe"]["exif"]
        assert (found["iso"], found["exposure_time"]) == (iso, pytest.approx(1 / 50))
    assert asked == [False, True]


@pytest.mark.parametrize(("flash", "fired"), [(None, None), (0x10, False), (0x19, True)])
def test_flash_that_is_not_mentioned_is_unknown(flash, fired):
    assert exif.tags(headers.dng(np.zeros((32, 32)), photo=headers.settings(flash=flash))).flash_fired is fired


def test_color_matrix_under_daylight_is_preferred():
    tungsten, daylight = [1, 0, 0] * 3, [0, 1, 0] * 3
    matrices = {50721: (10, tungsten), 50778: (3, (17,)), 50722: (10, daylight), 50779: (3, (21,))}
    found = exif.tags(headers.tiff(headers.camera() | {50706: (1, (1, 4, 0, 0))} | matrices))
    assert found.color_matrix == tuple(daylight)


@pytest.mark.parametrize(
    ("per_unit", "unit", "width", "pitch_um"),
    [
        *((per_unit / 40, unit, 640, 40) for unit, per_unit in ((2, 25400), (3, 10000), (4, 1000))),
        (1000, 3, 2560, 40),  # 10 µm before it was quartered
        (72, 2, 640, None),  # a sensor 226 mm wide
    ],
)
def test_pixel_pitch_is_read_in_every_unit_and_follows_a_resized_picture(tmp_path, per_unit, unit, width, pitch_um):
    photo = PHOTO | {41486: (5, (per_unit,)), 41488: (3, (unit,)), 40962: (4, (width,))}
    (tmp_path / "a.dng").write_bytes(headers.dng(np.zeros((480, 640)), photo=photo))
    assert _exif(tmp_path / "a.dng").pixel_pitch_um == (pitch_um and pytest.approx(pitch_um, rel=1e-4))


def test_pictures_without_exif_give_their_size_alone(tmp_path):
    picture = np.zeros((30, 40, 3), np.uint16)
    for name in ("a.png", "a.tif"):
        assert cv2.imwrite(str(tmp_path / name), picture)
        fact = _exif(tmp_path / name)
        assert (fact.width, fact.height, fact.make, fact.exposure_time) == (40, 30, "", None)
        assert _kind(tmp_path / name) == "photo"


def test_damaged_exif_counts_as_none(tmp_path):
    body, path = headers.dng(np.zeros((32, 32))), tmp_path / "a.dng"
    for seed in range(40):  # exifread may fail, but no exception is raised
        broken = bytearray(body)
        for at in np.random.default_rng(seed).integers(8, 600, 20):
            broken[at] ^= 0xFF
        path.write_bytes(broken)
        assert isinstance(exif.tags(bytes(broken)), Exif)
        assert _kind(path) in ("raw", "photo", "other", "unknown")


def test_not_a_picture_is_one_error(tmp_path):
    path = tmp_path / "a.cr2"
    path.write_bytes(np.random.default_rng(1).bytes(4000))
    assert _kind(path) == "unknown" == probe.read(path).kind
    with pytest.raises(DecodeError, match="No such file"):
        _exif(tmp_path / "missing.cr2")


@needs_data
def test_real_files():
    canon = _exif(DATA / "real/raw_other/IMG_5952.CR2")
    assert (canon.model, canon.exposure_time, canon.f_number, canon.iso) == ("Canon EOS 30D", 1 / 400, 22, 640)
    assert (canon.width, canon.height, canon.flash_fired) == (3522, 2348, False)
    assert canon.pixel_pitch_um == pytest.approx(22.5e3 / 3504, rel=2e-3)  # Canon's sensor is 22.5 mm wide
    linear = _exif(DATA / "real/raw_other/canon_eos_6d.dng")
    assert linear.lens == "EF24-105mm f/4L IS USM"
    assert linear.pixel_pitch_um * linear.width / 1e3 == pytest.approx(36, rel=0.01)  # resized, still full frame
    assert linear.color_matrix[0] == pytest.approx(0.7034)  # the second matrix, D65
    nikon = _exif(DATA / "real/raw_bracket/sample2.dng")
    assert (nikon.make, nikon.exposure_time, nikon.focal_length_35mm) == ("NIKON CORPORATION", 1 / 640, 36)
    assert nikon.iso == 200
    powershot = _exif(DATA / "real/raw_chart/CRW_0101.CRW")  # no EXIF: LibRaw's own reading
    assert powershot.iso == 50 and powershot.exposure_time == pytest.approx(1 / 100, rel=0.02)
    assert powershot.focal_length_mm == pytest.approx(7.09, abs=0.01)
    kodak = _exif(DATA / "real/raw_chart/P003910.KDC")
    assert kodak.iso == 160  # the DC120's only one
    assert (kodak.width, kodak.height, kodak.model) == (848, 976, "Kodak DC120 ZOOM Digital Camera")


@pytest.mark.parametrize("head", [b"\0MRM\0\0\1", b"\0MRM", b"FUJIFILMCCD-RAW ", b"\0\0\0\x18ftypcrx CMT1"])
def test_a_head_cut_short_has_no_tags(head: bytes) -> None:
    assert exif.tags(head) == Exif()


def test_an_exif_reader_that_does_not_work_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise all photographs would seem to have no EXIF."""
    exif._check_reader.cache_clear()
    monkeypatch.setattr("exifread.process_file", lambda file, strict: {})
    with pytest.raises(SettingError, match=r"EXIF cannot be read: exifread 3\..*pip install"):
        exif.tags(BUILT["NEF"])
    exif._check_reader.cache_clear()
