"""The newest accuracy of the same camera, lens and filter is quoted, and no other."""

from dataclasses import replace
from pathlib import Path

import pytest

from polcap.calibration_values import BallAccuracy
from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import ball_accuracies

EXIF = Exif(make="Polcap", model="Synthetic", lens="60mm")
OLD = BallAccuracy("2026-11-22T20:00:00+00:00", "Polcap Synthetic", "60mm", "B+W", "ball", 3.2, 2.6, 3.0, 9000)


@pytest.fixture(autouse=True)
def users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path))
    return tmp_path


def test_the_newest_of_the_rig_is_chosen() -> None:
    new = replace(OLD, made="2026-11-23T20:00:00+00:00", mean_deg=2.8)
    for one in (new, OLD, replace(new, filter="Hoya"), replace(new, camera="Other")):
        ball_accuracies.write(one)
    assert ball_accuracies.choose(EXIF, "B+W") == new
    assert ball_accuracies.choose(EXIF, None) is None
    assert ball_accuracies.choose(Exif(), "B+W") is None


@pytest.mark.parametrize(
    ("content", "words"),
    [("made = 3", "is no measurement of a ball"), (None, "its errors are impossible; validate again, or remove it")],
)
def test_a_damaged_file_is_one_line(users: Path, content: str | None, words: str) -> None:
    path = ball_accuracies.write(replace(OLD, mean_deg=-1.0))
    if content is not None:
        path.write_text(content)
    with pytest.raises(CaptureError, match=words):
        ball_accuracies.choose(EXIF, "B+W")
