"""A cross-polarized shot, from its folder to the albedo under a clipped highlight."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import CaptureError
from polcap.formats.capture import reader as captures
from polcap.formats.maps import maps_folder
from polcap.image_values import Quality
from polcap.pipeline import check
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.quality import gates
from polcap.results import Results
from polcap.synth import shooting
from polcap.synth.distance_fields import Cluster
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.shooting import Shoot

GLOSSY = Coat((Material((0.12, 0.08, 0.06), (0.45, 0.4, 0.3), "chequer", size=0.012, roughness=(0.3, 0.3)),))
BALL = Scene(
    shape=Cluster(((0, 0, 0, 0.08),)), coat=GLOSSY, position=(0.0, 0.0, -0.7), light=(0.0, 0.05, 0.0), chart=None
)


def no_networks() -> tuple[None, None]:
    return None, None


SHOOT = Shoot(width=320, height=240, exposures=1, samples=1, cross=True, exposure_factor=2.0, gain_jitter=0.002)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("crossed") / "c"
    shooting.write(folder, BALL, SHOOT)
    return captures.read(folder)


def solved(capture: Capture) -> Results:
    with np.load(Path(capture.folder) / "truth.npz") as truth:
        mask = truth["mask"].astype(bool)
    return path(capture, UserInput(chart=ChartRequest("none"), mask=mask), Config(), MemoryCache(), Results)


@pytest.fixture(scope="module")
def results(capture: Capture) -> tuple[Results, Results]:
    return solved(replace(capture, crossed=None)), solved(capture)


def test_the_folder_cross_is_a_shot_of_its_own(capture: Capture) -> None:
    assert len(capture.shots) == 3 and capture.crossed is not None
    assert capture.crossed_angle == 0 and [frame.role for frame in capture.crossed.frames] == ["cross"]
    assert "cross" in captures.table(capture) and "cross" not in " ".join(capture.notes)


def test_two_crossed_shots_are_refused(tmp_path: Path) -> None:
    shooting.write(tmp_path / "c", BALL, structs.replace(SHOOT, width=128, height=96))
    (tmp_path / "c" / "cross045").mkdir()
    with pytest.raises(CaptureError, match="cross000 holds a cross-polarized shot too"):
        captures.read(tmp_path / "c")


def test_what_is_scattered_and_what_is_mirrored_are_told_apart(results: tuple[Results, Results]) -> None:
    cues = results[1].cues
    assert cues.body is not None and cues.body_known is not None
    mirrored = np.clip(1 - cues.body.sum(-1) / cues.radiance.sum(-1), 0, 1)
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    rim = cues.mask & (np.hypot(*results[1].cues.ratio) > 0.08)
    assert clipped.sum() > 30 and cues.body_known[clipped].mean() > 0.95
    assert np.median(mirrored[clipped]) > 0.3 and np.median(mirrored[rim]) < 0.05


def test_the_albedo_in_clipped_highlights_is_at_least_twice_as_right(
    capture: Capture, results: tuple[Results, Results]
) -> None:
    """Up to one factor: no chart tells the scale."""
    with np.load(Path(capture.folder) / "truth.npz") as truth:
        fine = truth["diffuse"].astype(np.float64)
    albedo = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]) / 4
    x0, y0, x1, y1 = results[1].object_.crop
    albedo = albedo[y0:y1, x0:x1]
    clipped = results[1].cues.mask & ((results[1].cues.quality & Quality.CLIPPED) > 0)
    around = results[1].cues.mask & ~clipped & (np.hypot(*results[1].cues.ratio) < 0.03)
    errors = []
    for found in results:
        diffuse = found.maps.diffuse
        scale = np.median(albedo[around] / np.maximum(diffuse[around], 1e-3))
        errors.append(float(np.abs(scale * diffuse - albedo)[clipped].mean()))
    assert errors[1] < errors[0] / 2


def test_both_parts_of_the_light_are_written(
    results: tuple[Results, Results], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: dict[str, set[str]] = {}
    keep: Callable[..., None] = lambda file, channels, **_: written.update({file.name: set(channels)})  # noqa: E731
    monkeypatch.setattr("polcap.formats.maps.maps_folder.exr.write", keep)
    found = results[1]
    maps_folder.write(tmp_path, found)
    assert {"scattered.R", "mirrored.B"} <= written["cues.exr"]


def test_process_and_check_say_what_the_crossed_shot_shows(capture: Capture, results: tuple[Results, Results]) -> None:
    lines = {line.name: line for line in check.inspect(capture, Config(), ChartRequest("none"), no_networks).lines}
    assert lines["crossed"].state == "pass" and "mirrored" in lines["crossed"].message


def test_a_filter_that_was_not_crossed_is_reported(capture: Capture) -> None:
    """The first shot once more for the crossed one: its highlights clip as well."""
    shown = replace(capture, crossed=replace(capture.shots[0], frames=capture.shots[0].frames))
    lines = {line.name: line for line in check.inspect(shown, Config(), ChartRequest("none"), no_networks).lines}
    assert lines["crossed"].state == "warn" and "clipped" in lines["crossed"].message
    assert gates.verdict(lines.values()) != "pass"
