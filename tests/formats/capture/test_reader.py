"""Capture folders are read and listed, and every fault is one clear line."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from polcap.errors import CaptureError, DecodeError, InputError
from polcap.formats.capture import reader as capture
from polcap.formats.raw import frame_decoder
from polcap.optics import sensor
from tests.formats.capture.capture_folders import degrees, each, folders, shoot
from tests.formats.headers import DATA, needs_data
from tests.formats.raw.test_photo import save

POL = ("pol000", "pol045", "pol090")


@pytest.mark.parametrize(
    ("settings", "known", "focal_px"),
    [
        ({"focal": 60}, False, 60 / 36 * 48),  # full frame assumed
        ({"focal": 60, "model": b"NIKON D5000"}, True, 60 / 23.6 * 48),  # from the table
        ({"focal": 0}, False, 50 / 43.2666 * np.hypot(48, 32)),
    ],
)
def test_focal_length_is_found_or_assumed_with_a_note(tmp_path, settings, known, focal_px):
    understood = capture.read(each(tmp_path, POL, **settings))
    assert understood.focal_known is known
    assert understood.focal_px == pytest.approx(focal_px, rel=1e-4)
    assert known or any("state" in note and "capture.toml" in note for note in understood.notes)


def test_table_shows_every_frame_and_assumption(tmp_path):
    understood = capture.read(folders(tmp_path / "vase"))
    text = capture.table(understood)
    assert text.count("1/200 s") == 3 and text.count("1/50 s") == 3
    parts = ("pol045/IMG_1.dng", "45°", "Acme Z1, 48×32 px", "Macro 60", "80 px (assumed)", "3 shots, 2 + 2 + 2")
    for part in (*parts, "2026-01-02 00"):
        assert part in text, part


def finished(root, suffix, pixels, **attributes):
    """A capture of finished pictures, one for each angle."""
    for number, folder in enumerate(POL):
        (root / folder).mkdir(parents=True, exist_ok=True)
        one = pixels.copy()
        one[0, 0] = one[0, 0] * (1 + 0.01 * number)  # other bytes
        save(root / folder / f"a.{suffix}", one, **attributes)
    return root


SIXTEEN = np.full((24, 32, 3), 3000, np.uint16)
RADIANCE = np.linspace(0.1, 700, 96 * 128 * 3, dtype=np.float32).reshape(96, 128, 3)


def test_a_stated_encoding_is_noted_and_enters_the_digest(tmp_path):
    linear = capture.read(finished(tmp_path / "linear", "tif", SIXTEEN))
    srgb = capture.read(finished(tmp_path / "srgb", "tif", SIXTEEN, oiio__ColorSpace="sRGB"))
    assert "finished pictures of 16 bits, taken as linear" in linear.notes
    assert "finished pictures of 16 bits, taken as srgb, as their EXIF ColorSpace states" in srgb.notes
    assert linear.shots[0].frames[0].digest.endswith(" default")
    assert srgb.shots[0].frames[0].digest.endswith(" srgb")


def test_a_contradictory_encoding_is_refused_unless_the_user_decides(tmp_path):
    folder = finished(tmp_path, "png", SIXTEEN, oiio__ColorSpace="sRGB")
    with pytest.raises(CaptureError, match=r"a\.png: its sRGB chunk states srgb, but .*state encoding = "):
        capture.read(folder)
    (folder / "capture.toml").write_text('encoding = "linear"\n')
    assert "not used: their sRGB chunk states srgb, but capture.toml decides" in capture.read(folder).notes


def test_pictures_of_several_encodings_are_refused(tmp_path):
    """One of them lost its profile."""
    folder = finished(tmp_path, "tif", SIXTEEN, oiio__ColorSpace="sRGB")
    save(folder / "pol045" / "a.tif", SIXTEEN + 1)
    with pytest.raises(CaptureError, match=r"pol045.a\.tif: is linear, but .*pol000.a\.tif is srgb; save all pictures"):
        capture.read(folder)


def test_white_of_linear_pictures_contradicts_another_encoding(tmp_path):
    folder = finished(tmp_path, "tif", SIXTEEN, oiio__ColorSpace="sRGB")
    (folder / "capture.toml").write_text("white = 4095\n")
    with pytest.raises(CaptureError, match=r"states srgb, but capture\.toml states white.*encoding = \"linear\" too"):
        capture.read(folder)


def test_radiance_above_one_is_not_over_exposed(tmp_path):
    """One white for all frames: they stay on one scale."""
    understood = capture.read(finished(tmp_path / "radiance", "exr", RADIANCE))
    images = [frame_decoder.decode(shot.frames[0]) for shot in understood.shots]
    assert len({image.white for image in images}) == 1
    assert not any(sensor.clipped_share(image, 0.98) for image in images)
    assert any("radiance up to 700: over-exposed from white = 735 on" in note for note in understood.notes)
    below = capture.read(finished(tmp_path / "below", "exr", RADIANCE / 1000))
    assert frame_decoder.decode(below.shots[0].frames[0]).white == 1
    (tmp_path / "radiance" / "capture.toml").write_text("white = 500\n")
    stated = frame_decoder.decode(capture.read(tmp_path / "radiance").shots[0].frames[0])
    assert stated.white == 500 and sensor.clipped_share(stated, 0.98) > 0.2


def test_a_few_wrong_pixels_do_not_set_the_scale_of_radiance(tmp_path):
    radiance = RADIANCE.copy()
    radiance[5, 6] = 1e9
    understood = capture.read(finished(tmp_path, "exr", radiance))
    assert 700 < frame_decoder.decode(understood.shots[0].frames[0]).white < 20 * 700


def test_a_gain_map_that_is_not_applied_is_noted(tmp_path):
    """OpcodeList2 of a phone's DNG: against the lens's shading."""
    gain_map = struct.pack(">5I", 1, 9, 0x01030000, 0, 8) + bytes(8)
    phone = capture.read(each(tmp_path / "phone", POL, tags={51009: (7, gain_map)}))
    assert "not applied: the gain maps of 3 files" in phone.notes
    assert not any("gain map" in note for note in capture.read(each(tmp_path / "plain", POL)).notes)


def test_digest_follows_the_bytes(tmp_path):
    folder = folders(tmp_path)
    before = capture.read(folder).shots[0].frames[0].digest
    assert capture.read(folder).shots[0].frames[0].digest == before
    shoot(folder / "pol000" / "IMG_1.dng", 1 / 200)
    assert capture.read(folder).shots[0].frames[0].digest != before


def remake(place, *time, **settings):
    """Replace a photograph by another one."""
    return lambda folder: shoot(folder / place, *time, **settings)


def heic_only(folder):
    """Replace the RAW files of one angle by a phone's picture."""
    empty(folder / "pol045")
    (folder / "pol045" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))


def zipped(folder):
    """Replace the folder by its archive."""
    packed = shutil.make_archive(f"{folder} packed", "zip", folder)
    shutil.rmtree(folder)
    Path(packed).rename(folder)


def move(old, new, function=shutil.move):
    """Move or copy a file or a folder."""
    return lambda folder: function(folder / old, folder / new)


def rewrite(place, change):
    """Change the bytes of a photograph."""
    return lambda folder: (folder / place).write_bytes(change((folder / place).read_bytes()))


def empty(folder):
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


FRAME = "pol045/IMG_1.dng"
TOO_FEW = "2 different polarizer angles where 3 are needed"
FAULTS = {
    "missing angle": (lambda vase: shutil.rmtree(vase / "pol045"), rf"angles are 0, 90: {TOO_FEW}"),
    "name of an angle": (move("pol045", "angle45"), rf"angles are 0, 90: {TOO_FEW}; add the .*, or name angle45 as"),
    "axes that coincide": (move("pol045", "pol180"), TOO_FEW),
    "empty angle": (lambda vase: empty(vase / "pol045"), "pol045: holds no photograph"),
    "empty folder": (empty, "holds no photograph that polcap reads; give the folder that holds the photographs"),
    "no folder": (shutil.rmtree, "no such folder"),
    "HEIC": (heic_only, "IMG_1.HEIC are compressed with loss: set the camera or phone to RAW or DNG, and shoot again"),
    "archive": (zipped, "is a ZIP archive; unpack it and give the folder that it holds"),
    "archive inside": (
        lambda vase: (empty(vase), shutil.make_archive(str(vase / "shots"), "zip", Path(__file__).parent)),
        r"unpack shots\.zip first",
    ),
    "camera": (remake("pol045/IMG_0.dng", model=b"Other"), "pol045/IMG_0.dng: was taken with Acme Other, not Acme Z1"),
    "lens": (remake("pol090/IMG_0.dng", lens=b"Zoom"), r"IMG_0\.dng: was taken through Zoom, not Macro 60"),
    "zoom": (remake("pol090/IMG_0.dng", focal=70), "was taken at 70 mm, not 60 mm"),
    "size": (remake("pol090/IMG_0.dng", size=(32, 64)), "has 64×32 px, not 48×32"),
    "bracket length": (lambda vase: (vase / "pol090/IMG_0.dng").unlink(), "pol090: 90° has 1 frames where 0° has 2"),
    "bracket exposure": (remake("pol090/IMG_0.dng", 1 / 25), "IMG_0.dng: 1/25 s f/8.0 ISO 200.0 where 0° has 1/50 s"),
    "duplicate": (move("pol000/IMG_0.dng", "pol090/IMG_0.dng", shutil.copy), "is the same photograph as"),
    "truncated": (rewrite(FRAME, lambda data: data[:-50]), rf"{FRAME}: its image data run past the end"),
    "zero bytes": (rewrite(FRAME, lambda data: b""), rf"{FRAME}: is empty"),
    "noise": (rewrite(FRAME, lambda data: np.random.default_rng(3).bytes(5000)), rf"{FRAME}: not a picture"),
    "same angle twice": (move("pol045", "pol45", shutil.copytree), "45° is also in pol045"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_inconsistent_capture_is_one_clear_line(tmp_path, fault):
    folder = folders(tmp_path / "vase")
    spoil, message = FAULTS[fault]
    spoil(folder)
    with pytest.raises((CaptureError, DecodeError), match=message) as caught:
        capture.read(folder)
    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no file that refuses to be read")
def test_unreadable_file_is_one_clear_line(tmp_path):
    folder = folders(tmp_path)
    locked = folder / "pol045" / "IMG_1.dng"
    locked.unlink()
    locked.symlink_to("/proc/self/mem")  # the superuser may read a file of any mode, but not this one
    with pytest.raises(InputError, match=r"pol045/IMG_1\.dng: cannot be read \(Input/output error\)"):
        capture.read(folder)


@needs_data
@pytest.mark.parametrize("name", ["d21_spot", "d22_demosthenes", "d23_penguin", "d24_scorpion"])
def test_rendered_captures_are_understood(name):
    understood = capture.read(DATA / "rendered" / name)
    assert understood.layout == "folders" and degrees(understood) == [0, 45, 90]
    assert [len(shot.frames) for shot in understood.shots] == [3, 3, 3]
    exposures = [[frame.exif.relative_exposure for frame in shot.frames] for shot in understood.shots]
    assert (np.diff(exposures, axis=1) > 0).all()
    assert not understood.focal_known and understood.size_px == (1152, 864)


@needs_data
def test_real_folders_are_understood():
    bowl = capture.read(DATA / "real/polarized_photos/gorshok")
    assert degrees(bowl) == [0, 45, 90, 135] and frame_decoder.decode(bowl.shots[0].frames[0]).lossy
    for name in ("macbeth_classic", "potery"):
        rotated = capture.read(DATA / "real/polarizer_rotated" / name, (0.0, 45.0, 90.0))
        assert degrees(rotated) == [0, 45, 90] and not frame_decoder.decode(rotated.shots[0].frames[0]).lossy
    fruits = capture.read(DATA / "real/polarization_mosaic")
    assert fruits.layout == "sensor" and fruits.size_px == (1224, 1024)
    truth = capture.read(DATA / "real/polarized_ground_truth")
    assert degrees(truth) == [0, 45, 90, 135]
    assert "not used: the folders mask, normal" in truth.notes
    with pytest.raises(CaptureError, match="equal brackets"):  # one bracket is no capture
        capture.read(DATA / "real/raw_bracket")
