"""A run that an error ends names the first cause, as `check` does, and leaves a picture that shows it."""

from pathlib import Path

import pytest

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.formats.maps import png
from polcap.pipeline import check, run
from polcap.pipeline.path import UserInput
from tests.campaigns import planted_causes as causes


def shoot(folder: Path, plant: causes.Plant) -> Path:
    to = causes.Shooting(causes.studio(1, 400, chart=None))
    plant(to)
    to.write(folder)
    return folder


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (causes.other_object(2), "in pol090: are they of this object?"),
        (causes.other_object(0), "in pol000: are they of this object?"),
        (causes.shot_moved(100, 1), "Lock the camera"),
    ],
    ids=["another object", "another object first", "moved"],
)
def test_process_and_check_name_the_same_cause(tmp_path: Path, plant: causes.Plant, words: str) -> None:
    folder = shoot(tmp_path / "capture", plant)
    request = ChartRequest("none")
    verdict = check.inspect(captures.read(folder), Config(), request, lambda: (None, None))
    advised = [line.remedy for line in verdict.lines if line.remedy]
    assert not verdict.keep and len(advised) == 1 and words in advised[0]
    assert message_of(folder, request, tmp_path / "out") in (
        advised[0],
        f"{advised[0]}; see {tmp_path}/out/work/stopped.png",
    )


def message_of(folder: Path, request: ChartRequest, out: Path) -> str:
    """The remedy of `process`, in its error or of its first gate."""
    try:
        about = run.process(captures.read(folder), UserInput(request), Config(), out)
    except InputError as error:
        assert png.read(out / "work" / "stopped.png").shape[2] == 3 and "\n" not in str(error)
        return str(error).partition("; ")[2]
    assert about is not None and about["verdict"] == "fail"
    return next(gate["remedy"] for gate in about["gates"] if gate["remedy"])


def test_an_error_before_the_pictures_are_merged_stays_as_it_is(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "capture", causes.frame_moved(150, 1, 2))
    with pytest.raises(InputError, match=r"IMG_0006\.DNG, frame 3 of shot 45°, moved by") as error:
        run.process(captures.read(folder), UserInput(ChartRequest("none")), Config(), tmp_path / "out")
    assert error.value.__cause__ is None and "stopped.png" not in str(error.value)


def test_a_chart_that_is_not_found_leaves_the_picture_of_the_search(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "capture", lambda to: None)
    with pytest.raises(InputError, match=r"--no-chart; see .*stopped\.png"):
        run.process(captures.read(folder), UserInput(), Config(), tmp_path / "out")
    assert (tmp_path / "out" / "work" / "stopped.png").exists()
