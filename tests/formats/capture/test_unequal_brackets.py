"""The exposures show which photograph of a bracket is missing, or one too many."""

import pytest

from polcap.errors import CaptureError
from polcap.formats.capture import reader as capture
from tests.formats.capture.capture_folders import flat, folders, shoot

TIMES = (1 / 200, 1 / 50, 1 / 12)


def ordered(root):
    return sorted(root.iterdir(), key=lambda path: path.name.replace("IMG_99", "A"))


def test_a_single_bracket_is_no_capture(tmp_path):
    for file in ordered(flat(tmp_path, times=TIMES))[3:]:
        file.unlink()
    with pytest.raises(CaptureError, match="one bracket at one angle, or the camera changed the exposure"):
        capture.read(tmp_path)


@pytest.mark.parametrize("number", [1, 4, 8])
def test_the_missing_frame_of_a_flat_folder_is_named(tmp_path, number):
    files = ordered(flat(tmp_path, times=TIMES))
    files.pop(number).unlink()
    text, angle = ("1/200 s", "1/50 s", "1/12 s")[number % 3], 45 * (number // 3)
    others = [file.name for k, file in enumerate(files) if (k + (k >= number)) % 3 == number % 3]
    advice = f"the frame of {text} at {angle}° is missing.* move {', '.join(others)}, the same exposure of every other"
    with pytest.raises(CaptureError, match=f"8 frames do not make 3 equal brackets.*{advice}"):
        capture.read(tmp_path)
    for name in others:
        (tmp_path / name).unlink()
    assert len(capture.read(tmp_path).shots[0].frames) == 2


def test_the_surplus_frame_of_a_flat_folder_is_named(tmp_path):
    flat(tmp_path, times=TIMES)
    shoot(tmp_path / "IMG_0050.dng", 1 / 50, "00:05:30")  # once more, after the bracket of 45°
    with pytest.raises(CaptureError, match=r"IMG_0050.dng is one too many, by its exposure \(1/50 s\)"):
        capture.read(tmp_path)


def test_more_brackets_than_angles_are_counted(tmp_path):
    with pytest.raises(CaptureError, match="they are 4 brackets of 3: state 4 angles with --angles"):
        capture.read(flat(tmp_path, shots=4, times=TIMES))


def test_equal_exposures_show_nothing(tmp_path):
    flat(tmp_path, times=(1 / 50, 1 / 50)).joinpath("IMG_9999.dng").unlink()
    with pytest.raises(CaptureError, match=r"5 frames do not make 3 equal brackets.*; give the order with --angles"):
        capture.read(tmp_path)


def test_a_folder_that_lacks_a_frame_names_it_and_those_to_leave_out(tmp_path):
    folders(tmp_path, times=TIMES)
    (tmp_path / "pol045" / "IMG_1.dng").unlink()
    with pytest.raises(CaptureError, match=r"2 frames where .* has 3; the frame of 1/50 s at 45° is missing") as error:
        capture.read(tmp_path)
    assert "move pol000/IMG_1.dng, pol090/IMG_1.dng, the same exposure" in str(error.value)


def test_a_folder_with_a_frame_too_many_names_it(tmp_path):
    folders(tmp_path, times=TIMES)
    shoot(tmp_path / "pol090" / "IMG_7.dng", 1 / 12)
    with pytest.raises(CaptureError, match=r"pol090/IMG_7.dng is one too many, by its exposure \(1/12 s\)"):
        capture.read(tmp_path)
