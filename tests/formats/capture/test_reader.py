"""Capture folders: every layout is understood, and every fault is one clear line."""

import re
import shutil
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.errors import CaptureError, DecodeError, InputError
from polcap.formats.capture import layouts
from polcap.formats.capture import reader as capture
from polcap.formats.raw import frame_decoder
from tests.formats import headers
from tests.formats.headers import DATA, needs_data
from tests.formats.raw.test_photo import mosaic, save

_serial = count()


def shoot(path, time=1 / 50, clock="00:00:00", model=b"Z1", lens=b"Macro 60", size=(32, 48), **settings):
    """A small DNG of its own pixels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    photo = headers.settings(time=time, **settings) | {36867: (2, f"2026:01:02 {clock}".encode()), 42036: (2, lens)}
    pixels = np.random.default_rng(next(_serial)).integers(500, 4000, size)
    path.write_bytes(headers.dng(pixels, photo=photo, maker=headers.camera(model=model)))
    return path


def folders(root, angles=("000", "045", "090"), times=(1 / 200, 1 / 50)):
    for angle in angles:
        for number, time in enumerate(reversed(times)):  # brightest first, to be sorted
            shoot(root / f"pol{angle}" / f"IMG_{number}.dng", time)
    return root


def flat(root, shots=3, times=(1 / 200, 1 / 50)):
    for number in range(shots * len(times)):
        name = f"IMG_{(number + 9998) % 10000:04d}.dng"  # the camera's counter starts again at 0
        shoot(root / name, times[number % len(times)], f"00:{number:02d}:00")
    return root


def pictures(root, names):
    for number, name in enumerate(names):
        save(root / name, np.full((8, 10, 3), 300 + number, np.uint16))
    return root


def degrees(understood):
    return np.degrees(understood.angle).round(6).tolist()


def names(shot):
    return [frame.path.rpartition("/")[2] for frame in shot.frames]


# ---------------------------------------------------------------- layouts


def test_sub_folders_state_the_angles(tmp_path):
    understood = capture.read(folders(tmp_path / "vase", ("000", "022.5", "045", "90")))
    assert understood.layout == "folders" and understood.name == "vase"
    assert degrees(understood) == [0, 22.5, 45, 90]
    assert [names(shot) for shot in understood.shots] == [["IMG_1.dng", "IMG_0.dng"]] * 4  # darkest first
    assert understood.size_px == (48, 32) and understood.principal_px == (23.5, 15.5)
    image = frame_decoder.decode(understood.shots[1].frames[0])
    assert image.value.shape == (32, 48) and image.cfa.tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize(
    "listed",
    [
        ("0", "45", "90"),
        ("0 Grad", "60 Grad", "120 Grad"),
        ("角度0", "角度45", "角度90"),
        ("POL0°", "POL22,5°", "POL90°"),
        ("Filter 0°", "Filter 45°", "Filter 90°"),
    ],
)
def test_angles_are_read_from_folder_names_that_differ_in_one_number(tmp_path, listed):
    for name in listed:
        shoot(tmp_path / name / "a.dng")
    (tmp_path / "notes 7").mkdir()
    understood = capture.read(tmp_path)
    assert understood.layout == "folders"
    assert degrees(understood) == [float(re.sub(r"[^\d,]", "", name).replace(",", ".")) for name in listed]
    assert "not used: the folders notes 7" in understood.notes
    with pytest.raises(CaptureError, match="holds one angle of a capture"):
        capture.read(tmp_path / listed[1])


@pytest.mark.parametrize(
    "listed", [("1", "2", "3"), ("10", "20", "30"), ("0", "100", "200"), ("vase 0", "cup 45", "90")]
)
def test_numbered_folders_of_objects_are_not_angles(tmp_path, listed):
    for name in listed:
        shoot(tmp_path / name / "a.dng")
    with pytest.raises(CaptureError, match="but polcap looks for pol000"):
        capture.read(tmp_path)


def test_a_batch_distinguishes_angle_folders_from_numbered_captures(tmp_path):
    assert layouts.looks_like_a_capture(tmp_path, ("0 Grad", "45 Grad", "90 Grad"), ())
    assert not layouts.looks_like_a_capture(tmp_path, ("10", "20", "30"), ())


def test_a_clockwise_ring_negates_the_angles(tmp_path):
    folder = folders(tmp_path)
    assert degrees(capture.read(folder, clockwise=True)) == [0, -45, -90]
    assert degrees(capture.read(folder, (90.0, 0.0, 45.0), clockwise=True)) == [-90, 0, -45]
    (folder / "capture.toml").write_text("clockwise = true\n")
    understood = capture.read(folder)
    assert degrees(understood) == [0, -45, -90] and "angles counted clockwise, as stated" in understood.notes


def test_a_polarization_sensor_is_never_clockwise(tmp_path):
    save(tmp_path / "frame.png", mosaic())
    with pytest.raises(CaptureError, match="a polarization sensor has no ring; leave it out"):
        capture.read(tmp_path, clockwise=True)


def test_angles_pick_from_those_stated_and_set_the_reference(tmp_path):
    folder = folders(tmp_path, ("000", "045", "090", "135"))
    assert degrees(capture.read(folder, (90.0, 0.0, 135.0))) == [90, 0, 135]
    with pytest.raises(CaptureError, match=r"no shot at 60° \(there are 0, 45, 90, 135\)"):
        capture.read(folder, (0.0, 60.0, 90.0))


def test_flat_folder_is_cut_into_equal_brackets_by_time(tmp_path):
    understood = capture.read(flat(tmp_path))
    assert understood.layout == "flat" and degrees(understood) == [0, 45, 90]
    assert [names(shot) for shot in understood.shots] == [
        ["IMG_9998.dng", "IMG_9999.dng"],
        ["IMG_0000.dng", "IMG_0001.dng"],
        ["IMG_0002.dng", "IMG_0003.dng"],
    ]


def test_flat_folder_follows_the_stated_order(tmp_path):
    understood = capture.read(flat(tmp_path, shots=4), (0.0, 45.0, 90.0, 135.0))
    assert degrees(understood) == [0, 45, 90, 135]
    assert degrees(capture.read(flat(tmp_path, shots=4), (135.0, 90.0, 45.0, 0.0))) == [135, 90, 45, 0]


def test_angles_are_read_from_names_of_pictures(tmp_path):
    folder = pictures(tmp_path, [f"scene2_filter_{angle}_done.tif" for angle in (135, 0, 90, 45)])
    understood = capture.read(folder)
    assert understood.layout == "flat" and degrees(understood) == [0, 45, 90, 135]
    assert names(understood.shots[3]) == ["scene2_filter_135_done.tif"]


@pytest.mark.parametrize("listed", [("p_1.png", "p_2.png", "p_3.png"), ("p_0001.png", "p_0045.png", "p_0090.png")])
def test_counters_are_not_angles(tmp_path, listed):
    understood = capture.read(pictures(tmp_path, listed))
    assert degrees(understood) == [0, 45, 90]
    assert any("by name taken as 3 brackets of 1" in note for note in understood.notes)


def test_the_frame_of_a_polarization_sensor_is_four_shots(tmp_path):
    save(tmp_path / "frame.png", mosaic())
    understood = capture.read(tmp_path)
    assert understood.layout == "sensor" and degrees(understood) == [0, 45, 90, 135]
    assert understood.size_px == (20, 16) and understood.focal_px == pytest.approx(
        50 / 43.2666 * np.hypot(20, 16), 1e-4
    )
    assert [frame_decoder.decode(shot.frames[0]).value.mean() for shot in understood.shots] == [1300, 1150, 700, 850]
    assert len({shot.frames[0].digest for shot in understood.shots}) == 4


def test_capture_toml_states_angles_roles_and_exposures(tmp_path):
    for number in range(9):
        shoot(tmp_path / f"{number}.dng", 1 / 50, f_number=8, iso=200)
    (tmp_path / "log.csv").write_text("0\n")
    entries: list[dict[str, Any]] = [
        *[{"angle": angle, "flash_energy": energy} for angle in (0, 60, 120) for energy in (1.0, 0.25)],
        {"angle": 0, "role": "ambient"}, {"role": "chart"}, {"role": "ambient"},
    ]  # fmt: skip
    lines = ['name = "bowl"', "focal_length_mm = 60", "sensor_width_mm = 36", "[rotator]", 'log = "log.csv"']
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


def test_capture_toml_may_come_from_windows(tmp_path):
    text = 'name = "bowl"\r\n'
    for angle in (0, 45, 90):
        shoot(tmp_path / f"pol{angle:03d}" / "a.dng")
        text += f"[[frame]]\r\nfile = 'pol{angle:03d}\\a.dng'\r\nangle = {angle}\r\n"
    (tmp_path / "capture.toml").write_bytes(b"\xef\xbb\xbf" + text.encode())  # with a byte order mark
    understood = capture.read(tmp_path)
    assert (understood.name, degrees(understood)) == ("bowl", [0, 45, 90])


def test_the_folder_of_one_angle_is_no_capture(tmp_path):
    folders(tmp_path, times=(1 / 200, 1 / 50, 1 / 12))
    with pytest.raises(CaptureError, match=f"holds one angle of a capture; give the folder of all, {tmp_path}"):
        capture.read(tmp_path / "pol045")


def test_a_folder_of_captures_is_named_as_such(tmp_path):
    folders(tmp_path / "krug")
    with pytest.raises(CaptureError, match="sub-folders krug hold captures: give one of them, or run `polcap batch`"):
        capture.read(tmp_path)


def test_views_of_one_object_are_for_fuse(tmp_path):
    """Other files and the fused result next to the views do not hide the remedy."""
    folders(tmp_path / "view01")
    (tmp_path / "truth.npz").write_bytes(b"PK\x05\x06" + bytes(18))
    (tmp_path / "fused" / "maps").mkdir(parents=True)
    with pytest.raises(CaptureError, match="sub-folders view01 are views of one object: join them with `polcap fuse`"):
        capture.read(tmp_path)


def test_untimed_brackets_in_one_folder_are_to_be_sorted(tmp_path):
    """No order of the angles can separate the brackets, so the message does not mention --angles."""
    folder = pictures(tmp_path, [f"krug_{angle}_grad_{number}.png" for angle in (0, 45, 90) for number in range(3)])
    for angles in (None, (0.0, 45.0, 90.0)):
        with pytest.raises(CaptureError, match="cannot be assigned to angles; sort the frames into pol000") as caught:
            capture.read(folder, angles)
        assert "--angles" not in str(caught.value)


def test_a_repeat_is_a_shot_of_its_own_at_about_its_angle(tmp_path):
    """A motor that returns to 45° may report 45.02°; at 0° it may report 179.99°."""
    text = ""
    for name, angle in {"a": 0, "b": 45, "c": 90, "d": 45.02, "e": 179.99, "f": 60}.items():
        shoot(tmp_path / f"{name}.dng")
        role = '\nrole = "repeat"' if name in "def" else ""
        text += f'[[frame]]\nfile = "{name}.dng"\nangle = {angle}{role}\n'
    (tmp_path / "capture.toml").write_text(text)
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


def test_raw_wins_over_its_jpeg_and_sidecars_are_ignored(tmp_path):
    folder = folders(tmp_path, times=(1 / 50,))
    for angle in ("000", "045", "090"):
        save(folder / f"pol{angle}" / "IMG_0.jpg", np.full((8, 8, 3), 90, np.uint8))
        (folder / f"pol{angle}" / "IMG_0.xmp").write_text("<x/>")
        (folder / f"pol{angle}" / "Thumbs.db").write_bytes(bytes(range(256)))
        (folder / f"pol{angle}" / "._IMG_0.dng").write_bytes(b"\0\1\2")
    (folder / "polcap").mkdir()
    understood = capture.read(folder)
    assert [names(shot) for shot in understood.shots] == [["IMG_0.dng"]] * 3
    assert sum("the RAW is used" in note for note in understood.notes) == 3
    assert not any("not used" in note for note in understood.notes)


def test_a_folder_of_jpegs_is_read_and_asks_for_raw(tmp_path):
    for angle in (0, 45, 90):
        save(tmp_path / f"bowl_{angle}.jpg", np.full((8, 8, 3), 90 + angle, np.uint8))
    notes = " ".join(capture.read(tmp_path).notes)
    assert "lose accuracy against RAW; set the camera to RAW or DNG" in notes and "remove" not in notes


@pytest.mark.parametrize(
    ("settings", "known", "focal_px"),
    [
        ({"focal": 60}, False, 60 / 36 * 48),  # full frame assumed
        ({"focal": 60, "model": b"NIKON D5000"}, True, 60 / 23.6 * 48),  # from the table
        ({"focal": 0}, False, 50 / 43.2666 * np.hypot(48, 32)),
    ],
)
def test_focal_length_is_found_or_assumed_with_a_note(tmp_path, settings, known, focal_px):
    model = settings.pop("model", b"Z1")
    for angle in ("000", "045", "090"):
        shoot(tmp_path / f"pol{angle}" / "a.dng", model=model, **settings)
    understood = capture.read(tmp_path)
    assert understood.focal_known is known
    assert understood.focal_px == pytest.approx(focal_px, rel=1e-4)
    assert known or any("state" in note and "capture.toml" in note for note in understood.notes)


def test_table_shows_every_frame_and_assumption(tmp_path):
    understood = capture.read(folders(tmp_path / "vase"))
    text = capture.table(understood)
    assert text.count("1/200 s") == 3 and text.count("1/50 s") == 3
    for part in ("pol045/IMG_1.dng", "45°", "Acme Z1, 48×32 px", "Macro 60", "80 px (assumed)", "3 shots, 2 + 2 + 2"):
        assert part in text, part


def test_digest_follows_the_bytes(tmp_path):
    folder = folders(tmp_path)
    before = capture.read(folder).shots[0].frames[0].digest
    assert capture.read(folder).shots[0].frames[0].digest == before
    shoot(folder / "pol000" / "IMG_1.dng", 1 / 200)
    assert capture.read(folder).shots[0].frames[0].digest != before


# ---------------------------------------------------------------- faults


def remake(place, *time, **settings):
    """Replace a photograph by another one."""
    return lambda folder: shoot(folder / place, *time, **settings)


def heic_only(folder):
    """Replace the RAW files of one angle by a phone's picture."""
    empty(folder / "pol045")
    (folder / "pol045" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))


def zipped(folder):
    """Replace the folder by its archive."""
    shutil.make_archive(str(folder) + " packed", "zip", folder)
    shutil.rmtree(folder)
    Path(str(folder) + " packed.zip").rename(folder)


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
    "name of an angle": (
        lambda vase: (vase / "pol045").rename(vase / "angle45"),
        rf"angles are 0, 90: {TOO_FEW}; add the missing shot, or name angle45 as",
    ),
    "axes that coincide": (lambda vase: (vase / "pol045").rename(vase / "pol180"), TOO_FEW),
    "empty angle": (lambda vase: empty(vase / "pol045"), "pol045: holds no photograph"),
    "empty folder": (
        empty,
        "holds no photograph that polcap reads; give the folder that holds the photographs",
    ),
    "no folder": (shutil.rmtree, "no such folder"),
    "HEIC": (heic_only, "IMG_1.HEIC are compressed with loss: set the camera or phone to RAW or DNG, and shoot again"),
    "archive": (zipped, "is a ZIP archive; unpack it and give the folder that it holds"),
    "archive inside": (
        lambda vase: (empty(vase), shutil.make_archive(str(vase / "shots"), "zip", Path(__file__).parent)),
        r"unpack shots\.zip first",
    ),
    "camera": (
        remake("pol045/IMG_0.dng", model=b"Other"),
        r"pol045/IMG_0\.dng: was taken with Acme Other, not Acme Z1",
    ),
    "lens": (remake("pol090/IMG_0.dng", lens=b"Zoom"), r"IMG_0\.dng: was taken through Zoom, not Macro 60"),
    "zoom": (remake("pol090/IMG_0.dng", focal=70), "was taken at 70 mm, not 60 mm"),
    "size": (remake("pol090/IMG_0.dng", size=(32, 64)), "has 64×32 px, not 48×32"),
    "bracket length": (
        lambda vase: (vase / "pol090" / "IMG_0.dng").unlink(),
        "pol090: 90° has 1 frames where 0° has 2",
    ),
    "bracket exposure": (
        remake("pol090/IMG_0.dng", 1 / 25),
        r"pol090/IMG_0\.dng: 1/25 s f/8\.0 ISO 200\.0 where 0° has 1/50 s",
    ),
    "duplicate": (
        lambda vase: shutil.copy(vase / "pol000" / "IMG_0.dng", vase / "pol090" / "IMG_0.dng"),
        "is the same photograph as",
    ),
    "truncated": (rewrite(FRAME, lambda data: data[:-50]), rf"{FRAME}: its image data run past the end"),
    "zero bytes": (rewrite(FRAME, lambda data: b""), rf"{FRAME}: is empty"),
    "noise": (rewrite(FRAME, lambda data: np.random.default_rng(3).bytes(5000)), rf"{FRAME}: not a picture"),
    "same angle twice": (
        lambda vase: shutil.copytree(vase / "pol045", vase / "pol45"),
        "45° is also in pol045",
    ),
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


def test_a_flat_folder_that_does_not_divide_into_equal_brackets_is_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"4 frames do not make 3 equal brackets.*--angles"):
        capture.read(flat(tmp_path, shots=2))


def test_flat_folder_of_unequal_brackets_names_the_first_frame_that_differs(tmp_path):
    flat(tmp_path, times=(1 / 200, 1 / 50))
    shoot(tmp_path / "IMG_0001.dng", 1 / 100, "00:03:00")
    with pytest.raises(CaptureError, match=r"IMG_0001\.dng: its exposure is 0\.5 times"):
        capture.read(tmp_path)


def test_three_equal_angles_on_the_command_line_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="--angles states 0, 90, 180: 2 different"):
        capture.read(flat(tmp_path), (0.0, 90.0, 180.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('nmae = "x"', "nmae"),
        ("focal_length_mm = -1", "focal_length_mm"),
        ('[[frame]]\nfile = "a.dng"', "has role shot and no angle"),
        ('[[frame]]\nfile = "gone.dng"\nangle = 0', r"no file gone\.dng"),
        ('[[frame]]\nfile = "../a.dng"\nangle = 0', "lies outside the folder"),
        ('[[frame]]\nfile = "a.dng"\nangle = 0\nexposure = 1\nflash_energy = 1', "both exposure and flash_energy"),
        ('[[frame]]\nfile = "a.dng"\nangle = 0\nrole = "sample"', "sample"),
        ("focal_length_mm = ", "capture.toml"),
        ('[rotator]\nlog = "no.csv"', r"no rotator log no\.csv"),
        ("\n".join(f'[[frame]]\nfile = "a.dng"\nangle = {a}' for a in (0, 45, 90)), "names a file twice"),
    ],
)
def test_capture_toml_is_strict(tmp_path, text, message):
    shoot(tmp_path / "a.dng")
    (tmp_path / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        capture.read(tmp_path)


# ---------------------------------------------------------------- real folders


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
