"""`polcap check` keeps what is good, and of what is not it names the fault and the shot."""

import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import numpy as np
import pytest

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import CaptureError, ChartError
from polcap.formats import dng_writer, shipped_data
from polcap.formats.capture import reader as captures
from polcap.formats.raw import frame_decoder, probe
from polcap.formats.raw import libraw as raw
from polcap.pipeline import check, models
from polcap.pipeline.check import Verdict
from polcap.pipeline.path import AUTO
from polcap.pipeline.small_capture import reduce
from polcap.quality.gate_values import Gate
from polcap.report import page
from polcap.stages import hdr, whitebalance
from tests import faulty
from tests.conftest import Command

WIDTH = 512  # the chart must be found: without its greys order and angles are measured less well


def verdict(folder: Path) -> Verdict:
    return check.inspect(captures.read(folder), Config(), networks=lambda: (None, None))


def test_a_fault_of_no_single_shot_is_named_in_the_first_line() -> None:
    order = Gate("order", "fail", None, None, "The outline fits another order")
    assert check.table(check.Verdict(False, (), (order,), "vase", 1.0)).startswith("reshoot: order   (vase")
    assert check.table(check.Verdict(False, ("45°",), (order,), "vase", 1.0)).startswith("reshoot 45°   (vase")


def test_ordinary_jitter_and_nudges_are_kept(tmp_path: Path) -> None:
    """Those of another capture where `test_swapped_folders_get_a_remedy_that_works` ends."""
    faulty.shoot(tmp_path / "good", 2, "", WIDTH)
    found = verdict(tmp_path / "good")
    assert found.keep, check.table(found)


MENDED = ("swapped", "clockwise")  # whose remedies are followed below


@pytest.mark.parametrize(
    "fault", [name for name, lines in faulty.FAULTS.items() if lines and name not in ("wrong angle", *MENDED)]
)
def test_planted_fault_is_named(tmp_path: Path, fault: str) -> None:
    faulty.shoot(tmp_path / "bad", 1, fault, WIDTH)
    found_as_planted(tmp_path / "bad", fault)


def found_as_planted(folder: Path, fault: str) -> Verdict:
    """The verdict on a capture, in which the planted fault is found with one or two remedies."""
    found = verdict(folder)
    states = ("fail", "warn") if fault in ("shaken", "drift", "misfire") else ("fail",)  # these are corrected
    failed = {line.name for line in found.lines if line.state in states}
    assert failed & set(faulty.FAULTS[fault]), check.table(found)
    assert 1 <= sum(bool(line.remedy) for line in found.lines) <= 2, check.table(found)
    return found


def test_one_turned_shot_of_three_is_named_and_not_taken_for_the_ring(tmp_path: Path) -> None:
    faulty.shoot(tmp_path / "bad", 3, "wrong angle", WIDTH)  # 0°, by −15°
    line = next(line for line in verdict(tmp_path / "bad").lines if line.name == "angles")
    assert line.state == "warn" and line.cost_deg > 1 and "take the shot again" in line.remedy
    assert line.shots == ("0°",) and line.value == pytest.approx(-15, abs=4)


def test_a_clockwise_ring_gets_a_remedy_that_works(tmp_path: Path) -> None:
    faulty.shoot(tmp_path / "bad", 1, "clockwise", WIDTH)
    line = next(line for line in found_as_planted(tmp_path / "bad", "clockwise").lines if line.name == "order")
    assert line.state == "fail" and "dd --clockwise, or clockwise = true in capture.toml" in line.remedy
    (tmp_path / "bad" / "capture.toml").write_text("clockwise = true\n")
    found = verdict(tmp_path / "bad")
    assert found.keep, check.table(found)


def test_swapped_folders_get_a_remedy_that_works(
    tmp_path: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(models, "load_networks", lambda: (None, None))
    faulty.shoot(tmp_path / "bad", 1, "swapped", WIDTH)
    done = polcap("check", tmp_path / "bad", "--json")
    about = json.loads(done.stdout)
    assert done.returncode == 3 and about["verdict"] == "reshoot" and not about["keep"]
    assert [line["name"] for line in about["lines"] if line["state"] == "fail"] == ["order"]
    (remedy,) = (line["remedy"] for line in about["lines"] if line["remedy"])
    pairs = re.findall(r"(pol\d+) to (pol\d+)", remedy)
    assert len(pairs) == 2 and "Rename the folders" in remedy
    for old, new in pairs:
        (tmp_path / "bad" / old).rename(tmp_path / "bad" / f"new {new}")
    for _, new in pairs:
        (tmp_path / "bad" / f"new {new}").rename(tmp_path / "bad" / new)
    found = verdict(tmp_path / "bad")
    assert found.keep, check.table(found)


def test_process_measures_the_blur_that_check_measures(tmp_path: Path) -> None:
    faulty.shoot(tmp_path / "bad", 1, "defocus", 256)
    capture = captures.read(tmp_path / "bad")
    merged = hdr.merge(capture, frame_decoder.decode, Config().hdr)
    assert np.nanmax(merged.bracket.blur_px) > Config().gates.max_blur_px
    with ThreadPoolExecutor(2) as pool:
        np.testing.assert_array_equal(merged.bracket.blur_px, reduce(capture, 0.98, pool).blur_px)


def test_missing_chart_keeps_and_says_what_process_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    faulty.shoot(tmp_path / "small", 1, "", 200)  # too small for a chart to be found
    capture = captures.read(tmp_path / "small")
    found = verdict(tmp_path / "small")
    line = next(line for line in found.lines if line.name == "chart")
    assert line.state == "warn" and found.needs == "--no-chart" and "--no-chart" in line.message
    with pytest.raises(ChartError):
        merged = hdr.merge(capture, frame_decoder.decode, Config().hdr)
        whitebalance.measure(merged, shipped_data.colorchecker(), AUTO, Config().whitebalance)

    def fail(*_: object) -> None:
        raise ChartError("no chart (the best (cost 0.05) is none); give its corners", "the best (cost 0.05) is none")

    monkeypatch.setattr(check, "_colors_at_full_size", fail)
    again = next(line for line in verdict(tmp_path / "small").lines if line.name == "chart")
    assert "(the best (cost 0.05) is none);" in again.message
    asked = check.inspect(capture, Config(), ChartRequest("none"), lambda: (None, None))
    assert asked.needs == "" and next(line for line in asked.lines if line.name == "chart").state == "not measured"


@pytest.mark.parametrize("width", [200, 512])
def test_a_small_chart_is_judged_as_process_judges_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, width: int
) -> None:
    """Its size in RAW pixels is that of the photographs; the smaller pictures of `check` do not matter."""
    monkeypatch.setattr("polcap.pipeline.small_capture._MOST_PIXELS", 2e4)
    faulty.shoot(tmp_path / "small", 1, "", width)
    capture = captures.read(tmp_path / "small")
    merged = hdr.merge(capture, frame_decoder.decode, Config().hdr)
    reason = ""
    try:
        whitebalance.measure(merged, shipped_data.colorchecker(), AUTO, Config().whitebalance)
    except ChartError as error:
        reason = error.reason
    line = next(line for line in verdict(tmp_path / "small").lines if line.name == "chart")
    assert reason in line.message and (line.state == "warn") is bool(reason) is (width == 200)


def test_missing_frame_is_bad_input(tmp_path: Path) -> None:
    faulty.shoot(tmp_path / "bad", 1, "missing", 128)
    with pytest.raises(CaptureError, match=r"2 frames where .* has 3"):
        captures.read(tmp_path / "bad")


def test_command_tells_keep_and_writes_nothing(example: Path, polcap: Command, tmp_path: Path) -> None:
    folder = tmp_path / "capture"
    shutil.copytree(example, folder)
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    done = polcap("check", folder)
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("keep")
    assert len(done.stdout.splitlines()) <= 30  # one screen
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before


def test_ambient_light_is_measured(tiny: Path, tmp_path: Path) -> None:
    frames = []
    for angle in (0, 45, 90):
        (file,) = (tiny / "C" / f"pol{angle:03d}").glob("*.DNG")
        shutil.copy(file, tmp_path)
        frames.append(f'[[frame]]\nfile = "{file.name}"\nangle = {angle}\n')
        middle = raw.read(file)
        dark = middle.value.astype(float) - middle.black.mean()
        dng_writer.write(
            tmp_path / f"dark{angle}.dng",
            (middle.black.mean() + dark / 5).astype(np.uint16),
            cfa=middle.cfa,
            black=float(middle.black.mean()),
            white=middle.white,
            exif=probe.read(file).exif,
            color_matrix=np.eye(3),
            as_shot_neutral=np.ones(3),
        )
        frames.append(f'[[frame]]\nfile = "dark{angle}.dng"\nrole = "ambient"\nangle = {angle}\n')
    (tmp_path / "capture.toml").write_text("".join(frames))
    line = next(line for line in verdict(tmp_path).lines if line.name == "ambient")
    assert line.state == "pass" and line.value == pytest.approx(0.2, rel=0.05)  # of all the light


def test_a_reduced_picture_has_the_same_middle_and_clipped_pixels(
    example: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polcap.pipeline.small_capture._MOST_PIXELS", 7e4)
    with ThreadPoolExecutor(2) as pool:
        taken = reduce(captures.read(example), 0.98, pool)
    found, (width, height) = taken.capture, taken.capture.size_px
    assert taken.step == 4 and (width, height) == (288, 216)
    assert found.principal_px == pytest.approx(((width - 1) / 2, (height - 1) / 2))
    assert found.focal_px * taken.step == pytest.approx(84 / 36 * 1152)
    brightest = taken.decode(found.shots[0].frames[2])
    assert brightest.cfa is None and brightest.value.shape == (216, 288, 3)
    assert ((taken.clipped[0, 2] > 0) == (brightest.value == 1).all(-1)).all()
    assert taken.clipped[0, 2].mean() > 0.001


def test_corners_of_the_chart_are_moved_to_the_reduced_picture() -> None:
    """The outer edges of a block of RAW pixels are the outer edges of its pixel."""
    edges = np.array([[-0.5, -0.5], [39.5, -0.5], [39.5, 23.5], [-0.5, 23.5]])
    moved = check._scale_chart(ChartRequest("corners", corners=edges), 4)
    np.testing.assert_allclose(moved.corners, [[-0.5, -0.5], [9.5, -0.5], [9.5, 5.5], [-0.5, 5.5]])


def test_shares_are_per_cent_on_the_terminal_and_shares_in_json() -> None:
    verdict = Verdict(True, (), (Gate("mask", "pass", 0.03, 0.25, "About 3 % of the outline may be wrong"),), "bowl", 1)
    assert "(limit 25 %)" in check.table(verdict, everything=True)
    assert check.table(verdict).splitlines()[1:] == ["1 of 1 gates passed; -v prints all"]
    unmeasured = Gate("ambient", "not measured", None, 0.3, "No frame was taken without the flash")
    with_it = check.table(msgspec.structs.replace(verdict, lines=(*verdict.lines, unmeasured)))
    assert with_it.endswith("1 of 2 gates passed, 1 not measured; -v prints all")
    (line,) = json.loads(json.dumps(check.to_json(verdict)))["lines"]
    assert (line["value"], line["limit"], line["unit"]) == (0.03, 0.25, "1")
    assert page.gate_row(line)["limit"] == "25 %"
