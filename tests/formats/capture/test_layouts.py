"""The layouts of a capture folder: angle folders, flat folders, frames of a polarization sensor."""

import re

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.formats.capture import folder_names
from polcap.formats.capture import reader as capture
from polcap.formats.raw import frame_decoder
from tests.formats.capture.capture_folders import degrees, each, flat, folders, names, pictures, shoot, state
from tests.formats.raw.test_photo import mosaic, save


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
    (tmp_path / "notes 7").mkdir()
    understood = capture.read(each(tmp_path, listed))
    assert understood.layout == "folders" and folder_names.states_angles(listed)
    assert degrees(understood) == [float(re.sub(r"[^\d,]", "", name).replace(",", ".")) for name in listed]
    assert "not used: the folders notes 7" in understood.notes
    with pytest.raises(CaptureError, match="holds one angle of a capture"):
        capture.read(tmp_path / listed[1])


@pytest.mark.parametrize(
    ("listed", "expected"),
    [
        (("01 Foto 0°", "02 Foto 45°", "03 Foto 90°"), [0, 45, 90]),
        (("IMG 3 - 90 Grad", "IMG 1 - 0 Grad", "IMG 2 - 45 Grad"), [0, 45, 90]),
        (("1_30deg", "2_90deg", "3_150 degrees"), [30, 90, 150]),
        (("take1 22,5º", "take2 67.5°", "take3 112,5 GRAD"), [22.5, 67.5, 112.5]),
    ],
)
def test_a_number_with_a_unit_is_the_angle_whatever_else_counts(tmp_path, listed, expected):
    assert degrees(capture.read(each(tmp_path, listed))) == expected


def test_file_names_with_a_unit_state_the_angles_of_brackets(tmp_path):
    for number, angle in enumerate((0, 0, 45, 45, 90, 90)):
        shoot(tmp_path / f"DSC{number:04d} {angle}°.dng", (1 / 200, 1 / 50)[number % 2])
    understood = capture.read(tmp_path)
    assert degrees(understood) == [0, 45, 90] and [len(shot.frames) for shot in understood.shots] == [2, 2, 2]


@pytest.mark.parametrize(
    ("listed", "advice"),
    [
        (("1-0", "2-45", "3-90"), "rename 1-0 to pol000, 2-45 to pol045, 3-90 to pol090"),
        (("diagonal", "horizontal", "vertical"), "if each holds one angle, rename it to that angle$"),
        (("a1", "a2", "a3", "a4"), "a3 to pol090, a4 to pol135"),
        *((numbered, "") for numbered in (("1", "2", "3"), ("10", "20", "30"), ("0", "100", "200"))),
        (("vase 0", "cup 45", "90"), ""),
    ],
)
def test_other_names_such_as_numbers_of_objects_get_a_suggestion_for_each_folder(tmp_path, listed, advice):
    with pytest.raises(CaptureError, match=f"but polcap looks for pol000.*{advice}"):
        capture.read(each(tmp_path, listed))
    assert not folder_names.states_angles(listed)  # for a batch too, these are captures


def test_angles_pick_from_those_stated_and_set_the_reference(tmp_path):
    folder = folders(tmp_path, ("000", "045", "090", "135"))
    assert degrees(capture.read(folder, (90.0, 0.0, 135.0))) == [90, 0, 135]
    with pytest.raises(CaptureError, match=r"no shot at 60° \(there are 0, 45, 90, 135\)"):
        capture.read(folder, (0.0, 60.0, 90.0))


def test_flat_folder_is_cut_into_equal_brackets_by_time(tmp_path):
    understood = capture.read(flat(tmp_path))
    assert understood.layout == "flat" and degrees(understood) == [0, 45, 90]
    numbers = [["9998", "9999"], ["0000", "0001"], ["0002", "0003"]]
    assert [names(shot) for shot in understood.shots] == [[f"IMG_{one}.dng" for one in pair] for pair in numbers]


@pytest.mark.parametrize(
    ("times", "order", "note"),
    [  # of the frames 1 to 6; set back after the third frame, set back between two brackets, renamed, equal
        ("10:00 10:01 10:02 09:03 09:04 09:05", "1 3 5", "by the numbers in their names (their EXIF times contradict"),
        ("10:00 10:01 10:02 10:03 09:04 09:05", "1 3 5", "their EXIF times contradict: was the clock set?"),
        ("10:02 10:03 10:00 10:01 10:04 10:05", "3 1 5", "the numbers in their names contradict: were they renamed?"),
        ("10:00 10:00 10:00 10:00 10:00 10:00", "1 3 5", "6 frames by name taken as 3 brackets"),
    ],
)
def test_numbers_decide_where_the_clock_was_set_and_the_clock_where_files_were_renamed(tmp_path, times, order, note):
    for number, clock in enumerate(times.split()):
        shoot(tmp_path / f"DSC_000{number + 1}.dng", (1 / 200, 1 / 50)[number % 2], f"{clock}:00")
    understood = capture.read(tmp_path)
    assert [names(shot)[0] for shot in understood.shots] == [f"DSC_000{number}.dng" for number in order.split()]
    assert any(note in one for one in understood.notes)


def test_the_time_of_writing_orders_nothing(tmp_path):
    """DateTime is when a converter wrote the file, here in the opposite order."""
    for number in range(6):
        written = {306: (2, f"2026:01:02 00:{59 - number}:00".encode())}
        shoot(tmp_path / f"DSC_{number}.dng", (1 / 200, 1 / 50)[number % 2], clock=None, tags=written)
    with pytest.raises(CaptureError, match="6 frames without EXIF times cannot be assigned to angles"):
        capture.read(tmp_path)


@pytest.mark.parametrize(("raw", "dng"), [("IMG_7.NEF", "IMG_7.dng"), ("IMG_7.nef", "img_7.DNG")])
def test_a_raw_and_its_converted_dng_are_one_photograph(tmp_path, raw, dng):
    for minute, angle in enumerate(("000", "045", "090")):
        for name in (raw, dng):
            shoot(tmp_path / f"pol{angle}" / name, clock=f"00:0{minute}:00")
    understood = capture.read(tmp_path)
    assert [names(shot) for shot in understood.shots] == [[raw]] * 3
    used = ["1 DNGs are converted from a RAW in the folder: the RAW is used" in note for note in understood.notes]
    assert sum(used) == 3


def test_a_dng_that_names_its_raw_is_that_photograph(tmp_path):
    """OriginalRawFileName of DNG 1.2."""
    for minute, angle in enumerate(("000", "045", "090")):
        for name, tags in (("a.dng", None), ("b.dng", {50827: (2, b"A.dng")})):
            shoot(tmp_path / f"pol{angle}" / name, clock=f"00:0{minute}:00", tags=tags)
    assert [names(shot) for shot in capture.read(tmp_path).shots] == [["a.dng"]] * 3


def test_frames_of_one_name_and_another_time_are_two_photographs(tmp_path):
    for angle in ("000", "045", "090"):
        shoot(tmp_path / f"pol{angle}" / "a.nef", 1 / 200, "00:00:00")
        shoot(tmp_path / f"pol{angle}" / "a.dng", 1 / 50, "00:00:05")
    assert [names(shot) for shot in capture.read(tmp_path).shots] == [["a.nef", "a.dng"]] * 3


def test_a_shot_listed_as_raw_and_as_dng_is_named(tmp_path):
    state(tmp_path, listed := {"a.nef": 0, "a.dng": 45, "b.nef": 90})
    for name, angle in listed.items():
        shoot(tmp_path / name, clock=f"00:0{angle // 90}:00")
    with pytest.raises(CaptureError, match=r"a\.dng: is the same photograph as .*a\.nef"):
        capture.read(tmp_path)


def test_flat_folder_follows_the_stated_order(tmp_path):
    flat(tmp_path, shots=4)
    for order in ((0, 45, 90, 135), (135, 90, 45, 0)):
        assert degrees(capture.read(tmp_path, tuple(map(float, order)))) == list(order)


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
    assert understood.size_px == (20, 16)
    assert understood.focal_px == pytest.approx(50 / 43.2666 * np.hypot(20, 16), 1e-4)
    assert [frame_decoder.decode(shot.frames[0]).value.mean() for shot in understood.shots] == [1300, 1150, 700, 850]
    assert len({shot.frames[0].digest for shot in understood.shots}) == 4
    with pytest.raises(CaptureError, match="a polarization sensor has no ring; leave it out"):
        capture.read(tmp_path, clockwise=True)


def test_the_folders_of_one_angle_and_of_several_captures_are_no_capture(tmp_path):
    folders(tmp_path / "krug", times=(1 / 200, 1 / 50, 1 / 12))
    with pytest.raises(CaptureError, match=f"holds one angle of a capture; give the folder of all, {tmp_path}/krug"):
        capture.read(tmp_path / "krug/pol045")
    (tmp_path / "notes").mkdir()
    with pytest.raises(CaptureError, match="sub-folders krug hold captures: give one of them, or run `polcap batch`"):
        capture.read(tmp_path)


def test_views_of_one_object_are_for_fuse(tmp_path):
    """Other files and the fused result next to the views do not hide the remedy."""
    folders(tmp_path / "view01")
    (tmp_path / "truth.npz").write_bytes(b"PK\x05\x06" + bytes(18))
    (tmp_path / "fused" / "maps").mkdir(parents=True)
    with pytest.raises(
        CaptureError,
        match="sub-folders view01 are views of one object: join them with `polcap fuse`, or `polcap material`",
    ):
        capture.read(tmp_path)


def test_only_the_first_view_of_a_session_must_show_the_chart(tmp_path):
    for name in ("vase/view01", "vase/view02", "mug/setA/view01", "mug/setB/view01", "alone"):
        (tmp_path / name).mkdir(parents=True)
    later = {name.relative_to(tmp_path).as_posix() for name in tmp_path.glob("**/") if folder_names.is_later_view(name)}
    assert later == {"vase/view02", "mug/setB/view01"}


@pytest.mark.parametrize(
    ("names", "missing"),
    [
        (["view01", "view02", "view03"], []),
        (["view01", "view03", "view05"], ["view02", "view04"]),
        (["setA/view2", "setA/view3", "setB/view1"], ["setA/view1"]),
        (["view000", "view030", "view060"], []),  # degrees
        (["view", "view_b"], []),
    ],
)
def test_missing_numbers_of_views_are_named(names, missing):
    assert folder_names.missing_views(names) == missing


def test_untimed_brackets_in_one_folder_are_to_be_sorted(tmp_path):
    """No order of the angles can separate the brackets, so the message does not mention --angles."""
    folder = pictures(tmp_path, [f"krug_{angle}_shot_{number}.png" for angle in (0, 45, 90) for number in range(3)])
    for angles in (None, (0.0, 45.0, 90.0)):
        with pytest.raises(CaptureError, match="cannot be assigned to angles; sort the frames into pol000") as caught:
            capture.read(folder, angles)
        assert "--angles" not in str(caught.value)


def test_raw_wins_over_its_jpeg(tmp_path):
    for folder in ("pol000", "pol045", "pol090"):
        save(shoot(tmp_path / folder / "a.dng").with_suffix(".jpg"), np.full((8, 8, 3), 90, np.uint8))
    (tmp_path / "polcap").mkdir()
    understood = capture.read(tmp_path)
    assert [names(shot) for shot in understood.shots] == [["a.dng"]] * 3
    assert sum("the RAW is used" in note for note in understood.notes) == 3
    assert not any("not used" in note for note in understood.notes)


def test_a_folder_of_jpegs_is_read_and_asks_for_raw(tmp_path):
    for angle in (0, 45, 90):
        save(tmp_path / f"bowl_{angle}.jpg", np.full((8, 8, 3), 90 + angle, np.uint8))
    notes = " ".join(capture.read(tmp_path).notes)
    assert "lose accuracy against RAW; set the camera to RAW or DNG" in notes and "remove" not in notes


def test_a_flat_folder_that_does_not_divide_into_equal_brackets_is_refused(tmp_path):
    """By the number of its frames, by the angles on the command line, or by the first frame that differs."""
    flat(tmp_path, shots=2)
    with pytest.raises(CaptureError, match=r"4 frames do not make 3 equal brackets.*--angles"):
        capture.read(tmp_path)
    flat(tmp_path)
    with pytest.raises(CaptureError, match="--angles states 0, 90, 180: 2 different"):
        capture.read(tmp_path, (0.0, 90.0, 180.0))
    shoot(tmp_path / "IMG_0001.dng", 1 / 100, "00:03:00")
    with pytest.raises(CaptureError, match=r"IMG_0001\.dng: its exposure is 0\.5 times"):
        capture.read(tmp_path)
