"""The whole path on a small capture: right, resumable, and clear where the input is at fault."""

import functools
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polcap
from polcap.capture_values import Capture, Exif, Frame, Shot
from polcap.chart_values import ChartRequest, ColorCalibration
from polcap.config import Config
from polcap.errors import ObjectError, StorageError
from polcap.formats.capture import reader as captures
from polcap.formats.maps import maps_folder as maps
from polcap.formats.maps.result_maps import read_cues
from polcap.formats.raw import frame_decoder
from polcap.image_values import View
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput, distance_m, on_grid
from polcap.report import animation
from polcap.results import STAGES, Results
from polcap.stage_values import AngleStack, single_frames
from tests.conftest import TINY, Command, environment


def product(folder: Path) -> dict[str, bytes]:
    """The maps and the asset, byte for byte."""
    found = [file for part in ("maps", "asset") for file in (folder / part).iterdir()]
    return {f"{file.parent.name}/{file.name}": file.read_bytes() for file in sorted(found)}


def partial(folder: Path) -> list[Path]:
    """Files that a run left under a temporary name, and empty ones."""
    files = [file for file in folder.rglob("*") if file.is_file() and file.name != "lock"]
    return [file for file in files if ".part" in file.name or file.stat().st_size == 0]


def test_result_holds_what_the_contract_names(result: Path) -> None:
    named = """maps/normal.exr maps/normal.png maps/depth.exr maps/depth.png maps/diffuse.exr maps/diffuse.png
        maps/specular.exr maps/specular.png maps/roughness.exr maps/roughness.png maps/mask.png maps/confidence.exr
        maps/diffuse_error.exr maps/roughness_error.exr
        maps/stokes_covariance.exr
        maps/stokes.exr maps/cues.exr maps/maps.json asset/capture.glb asset/capture.obj asset/capture.mtl
        report.html report.json color.toml work"""
    assert [name for name in named.split() if not (result / name).exists()] == []
    assert partial(result) == []


def test_progress_counts_ambient_frames_and_never_exceeds_all(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [Frame(f"{k}.dng", Exif(), "shot", "") for k in range(5)]
    shots = Shot(0.0, (frames[0], frames[1]), ambient=(frames[2],)), Shot(1.0, (frames[3], frames[4]))
    capture = Capture("name", "folder", shots, "folders", 1000.0, True, (0.0, 0.0), (8, 8))
    reported: list[tuple[int, int]] = []
    monkeypatch.setattr(frame_decoder, "decode", lambda frame: None)
    decode = pipeline.decode_with_progress(capture, lambda done, total: reported.append((done, total)))
    for frame in (*frames, frames[0]):  # the first one had left memory
        decode(frame)
    assert reported == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5), (5, 5)]


def test_the_chart_of_one_capture_serves_another(polcap: Command, result: Path, tiny: Path, tmp_path: Path) -> None:
    """As a file of the result: the same colors, and nothing of a chart in the other's result."""
    command = ("process", tiny / "C", "--out", tmp_path, "--estimator", "analytic")
    assert polcap(*command, "--chart", result / "color.toml").returncode in (0, 3)
    ours, theirs = (pipeline.reopen(folder, Results)[0].color for folder in (tmp_path, result))
    assert (ours.source, theirs.source) == ("profile", "chart")
    np.testing.assert_allclose(ours.matrix, theirs.matrix, atol=1e-8)
    assert not (tmp_path / "color.toml").exists()


def test_normals_of_the_bundled_capture_are_near_the_truth(result: Path, example: Path) -> None:
    """Analytic estimator, three noisy shots with 1 % flash jitter and moved by up to 1.5 px: under 12° on the mean."""
    truth = np.load(example / "truth.npz")
    found = maps.read(result / "maps")
    (x, y), (height, width) = map(round, found.view.origin), found.mask.shape
    normal = truth["normal"].astype(np.float64)
    binned = sum(normal[i::2, j::2] for i in (0, 1) for j in (0, 1))[y : y + height, x : x + width]
    length = np.linalg.norm(binned, axis=-1)
    inside = found.mask & (length > 3.5)  # the four pixels agree: no outline between them
    cosine = (found.normal * binned).sum(-1)[inside] / length[inside]
    assert inside.sum() > 0.9 * found.mask.sum()
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 12


def test_running_again_computes_nothing_and_gives_the_same_bytes(
    tiny: Path, tiny_result: Path, polcap: Command
) -> None:
    (tiny_result / "maps" / "normal.png").unlink()
    (tiny_result / "asset" / "C.obj").unlink()
    again = polcap("process", tiny / "C", "--out", tiny_result, *TINY)
    states = [line.split()[1] for line in again.stderr.splitlines() if line.startswith(STAGES)]
    assert states.count("cached") == 8 and again.returncode in (0, 3)
    assert product(tiny_result) == product(tiny / "C" / "polcap")


def test_late_changes_end_as_a_first_run_with_these_settings_does(
    tiny: Path, tiny_result: Path, polcap: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "timings", lambda out: {})  # no two runs take the same time
    late, first = tiny_result, tmp_path / "first"
    command = ("process", tiny / "C", *TINY)
    settings = list[str]()
    for setting in ("gates.max_normal_error_deg=1", "asset.ior=1.4", "gates.max_turn_deg=4"):
        settings += ["--set", setting]
        assert polcap(*command, "--out", late, *settings).returncode == 3
    settings += ["--set", "asset.ior=1.45"]
    assert polcap(*command, "--out", late, *settings).returncode == 3
    assert polcap(*command, "--out", first, *settings).returncode == 3
    assert product(late) == product(first)
    shutil.rmtree(late / "asset")
    assert polcap(*command, "--out", late, *settings).returncode == 3
    assert product(late) == product(first)
    recorded, again = (json.loads((out / "report.json").read_text(encoding="utf-8")) for out in (late, first))
    assert recorded == again
    assert (late / "report.html").read_bytes() == (first / "report.html").read_bytes()


def test_killed_run_resumes_and_gives_the_same_bytes(tiny: Path, tmp_path: Path, polcap: Command) -> None:
    words = ("process", str(tiny / "C"), "--out", str(tmp_path), *TINY)
    process = subprocess.Popen(
        [sys.executable, "-m", "polcap", *words], env=environment(), stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    for line in process.stderr:  # killed a moment after the second stage
        if line.startswith("whitebalance"):
            time.sleep(0.05)
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    done = polcap(*words)
    assert "hdr           cached" in done.stderr and "cues          cached" not in done.stderr
    assert done.returncode in (0, 3), done.stderr
    assert product(tmp_path) == product(tiny / "C" / "polcap")
    assert partial(tmp_path) == []


def test_interrupted_run_ends_with_130_and_one_line(example: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "polcap", "process", str(single_exposures(example, tmp_path / "c"))]
    process = subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    seen = []
    for line in process.stderr:
        seen.append(line)
        if line.startswith("hdr"):
            process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    assert seen[-1] == "polcap: interrupted; run the same command again to go on\n"


def single_exposures(example: Path, folder: Path) -> Path:
    """The small capture without the shortest and the longest exposures."""
    return Path(shutil.copytree(example, folder, ignore=shutil.ignore_patterns("IMG_000[134679].DNG", "truth.*")))


def broken(example: Path, folder: Path, fault: str) -> Path:
    """The small capture with one thing wrong."""
    if fault == "empty folder":
        folder.mkdir()
        return folder
    single_exposures(example, folder) if fault == "two shots swapped" else shutil.copytree(example, folder)
    middle = folder / "pol045" / "IMG_0005.DNG"
    if fault == "truncated RAW":
        os.truncate(middle, middle.stat().st_size // 2)
    elif fault == "missing angle":
        shutil.rmtree(folder / "pol045")
    elif fault == "missing frame":
        middle.unlink()
    elif fault == "two shots swapped":
        (folder / "pol000").rename(folder / "x")
        (folder / "pol045").rename(folder / "pol000")
        (folder / "x").rename(folder / "pol045")
    elif fault == "mixed cameras":
        for file in (folder / "pol045").iterdir():
            data = file.read_bytes()
            assert b"Synthetic\0" in data
            file.write_bytes(data.replace(b"Synthetic\0", b"Different\0"))
    return folder


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("empty folder", ["no photograph"]),
        ("truncated RAW", ["IMG_0005.DNG"]),
        ("missing angle", ["0, 90", "3"]),
        ("missing frame", ["45"]),
        ("two shots swapped", ["45°, 0°, 90°"]),
        ("mixed cameras", ["Different"]),
    ],
)
def test_faulty_capture_is_one_clear_line_and_leaves_nothing(
    example: Path, tmp_path: Path, polcap: Command, fault: str, words: list[str]
) -> None:
    out = tmp_path / "out"
    done = polcap("process", broken(example, tmp_path / "capture", fault), "--out", out)
    errors = [line for line in done.stderr.splitlines() if line.startswith("polcap:")]
    assert done.returncode == 2 and len(errors) == 1 and done.stdout == "", done.stderr
    assert all(word in errors[0] for word in words), errors[0]
    assert not (out / "maps").exists() and not (out / "asset").exists() and partial(out) == []


def test_full_disk_is_one_clear_line_and_leaves_no_partial_file(tiny: Path, tmp_path: Path, polcap: Command) -> None:
    """A file system of 96 KB where the system lets us mount one, else a limit on the size of files."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=96k", "none", disk], capture_output=True)
    mounted, limits = mount.returncode == 0, resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        if not mounted:
            resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
        done = polcap("process", tiny / "C", "--out", disk / "out", *TINY)
        assert done.returncode == 2, done.stderr
        assert "disk is full" in done.stderr.splitlines()[-1] or "larger than" in done.stderr.splitlines()[-1]
        assert partial(disk) == [] and not (disk / "out" / "work" / "01-hdr").exists()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        if mounted:
            subprocess.run(["umount", disk], check=True)


@pytest.mark.parametrize("part", ["formats.maps.exr.write", "report.page._pictures", "pipeline.asset_export.write"])
def test_an_output_that_cannot_be_written_is_one_clear_line(
    tiny: Path, tiny_result: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise StorageError("cannot write it: the disk is full")

    before = product(tiny_result)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setattr(f"polcap.{part}", refuse)
    done = polcap("process", tiny / "C", "--out", tiny_result, *TINY, "--force", "asset")
    assert done.returncode == StorageError.exit_code
    refused = [line for line in done.stderr.splitlines() if "cannot write" in line]
    assert refused == ["polcap: error: cannot write it: the disk is full"]
    assert partial(tiny_result) == []
    without_exports = {"maps/maps.json": b""}  # it notes none then
    assert product(tiny_result) | without_exports == before | without_exports


def test_read_only_folder_is_one_clear_line(example: Path, tmp_path: Path, polcap: Command) -> None:
    place = tmp_path / "shut"
    place.mkdir()
    place.chmod(0o555)
    if os.access(place, os.W_OK):  # root writes anywhere but here
        place = Path("/sys/kernel")
    done = polcap("process", example, "--out", place / "out")
    assert done.returncode == 2 and not (place / "out").exists()
    assert re.search("may be written|is read-only", done.stderr.splitlines()[-1])


def test_photographs_are_never_touched(tiny: Path, tmp_path: Path, polcap: Command) -> None:
    capture = tiny / "C"
    before = {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in capture.rglob("*.DNG")}
    assert polcap("process", capture, "--out", capture).returncode == 2
    assert polcap("process", capture, "--out", tmp_path, "--until", "hdr").returncode == 0
    assert before == {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in capture.rglob("*.DNG")}
    assert not (capture / "work").exists()


def test_plan_tells_what_is_cached(result: Path, example: Path) -> None:
    found = captures.read(example)
    supplied = UserInput(mask_network=models.load_mask_network())
    states = pipeline.plan(found, supplied, Config(), result)
    assert set(states.values()) == {"cached", "on demand"}
    states = pipeline.plan(found, supplied, Config(), result, force="mask")
    assert states["align"] == "cached" and states["mask"] == states["surface"] == "compute"


def stack(height: int, width: int, scale: float) -> AngleStack:
    empty = np.zeros((3, height, width, 3), np.float32)
    view = View(100.0, (0.0, 0.0), scale)
    return AngleStack(empty, empty, empty[..., 0].astype(np.uint8), np.ones(3), view, single_frames(3))


def test_mask_may_be_drawn_on_either_grid() -> None:
    coarse = np.zeros((4, 6), bool)
    coarse[1:3, 2:5] = True
    fine = coarse.repeat(2, 0).repeat(2, 1)
    for drawn in (coarse, fine):
        placed = on_grid(drawn, stack(4, 6, 2.0))
        assert placed is not None and np.array_equal(placed, coarse)
    with pytest.raises(ObjectError, match="5×4 px"):
        on_grid(np.zeros((4, 5), bool), stack(4, 6, 2.0))


def test_distance_follows_from_the_size_of_the_chart() -> None:
    """Similar triangles: 1 mm per pixel at a focal length of 100 px is 0.1 m away."""
    color = ColorCalibration(np.eye(3), "chart", metres_per_px=1e-3)
    assert distance_m(color, stack(2, 2, 1.0)) == pytest.approx(0.1)


@pytest.fixture
def without_chart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples process the tiny capture, in which no chart is found."""
    monkeypatch.setattr(polcap, "process", functools.partial(polcap.process, chart=ChartRequest("none")), raising=False)
    monkeypatch.setattr(polcap, "ChartRequest", lambda mode: ChartRequest("none"), raising=False)


@pytest.mark.usefixtures("without_chart")
def test_the_example_from_python_runs(tiny: Path, tiny_result: Path, run_example: Callable[..., str]) -> None:
    assert "stillness pass" in run_example("from_python.py", tiny / "C", tiny_result)


@pytest.mark.usefixtures("without_chart")
def test_the_example_of_single_stages_gives_the_cues_of_a_result(tiny: Path, run_example: Callable[..., str]) -> None:
    result = tiny / "C" / "polcap"
    dolp = read_cues(result)["dolp"][maps.read(result / "maps").mask]
    assert f"DoLP, median: {np.median(dolp):.3f}" in run_example("stage_by_stage.py", tiny / "C")


def test_the_example_against_the_truth_runs(result: Path, example: Path, run_example: Callable[..., str]) -> None:
    printed = run_example("against_truth.py", example, result)
    mean = float(printed.split("mean ")[1].split("°")[0])
    assert 0 < mean < 5 and "roughness: RMSE" in printed


def test_the_gallery_shows_each_result_and_stands_alone(
    tiny_result: Path, tmp_path: Path, run_example: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(animation, "FRAMES", 8)
    page = tmp_path / "gallery.html"
    run_example("gallery.py", page, tiny_result, tiny_result)
    text = page.read_text()
    assert text.count("data:image/webp") == 2 and text.count('<a href="tiny/report.html">') == 2
    assert not re.search("https?:", text)  # pictures in base64 may hold the letters
