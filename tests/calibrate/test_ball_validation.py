"""`polcap validate` on a simulated ball states its true error, and later reports quote it."""

import json
from pathlib import Path

import numpy as np
import pytest

from polcap.calibrate.ball_outline import Ball
from polcap.cli import validate_command
from polcap.formats.maps import result_maps
from polcap.optics import frames
from polcap.synth import scenes, shooting
from tests.conftest import Command

SHOOT = shooting.Shoot(seed=4, width=480, height=360, samples=1, exposures=1)
SCENE = scenes.random_scene(4, "ball")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball") / "white ball"
    shooting.write(folder, SCENE, SHOOT)
    return folder


def true_error_deg(capture: Path) -> float:
    """Mean error of the normals against the ball of the simulation."""
    maps, distance = result_maps.read(capture / "polcap"), float(np.linalg.norm(SCENE.position))
    true = Ball(np.array(SCENE.position) / distance, float(np.arcsin(SCENE.shape.radius / distance)))
    normal, shown = true.normals(maps.view, maps.mask.shape)
    return float(frames.angle_deg(normal, maps.normal)[shown & maps.mask].mean())


def test_a_ball_gives_the_accuracy_that_later_reports_quote(
    capture: Path, polcap: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path / "calib"))
    done = polcap("validate", capture, "--ball", "--diameter", 2000 * SCENE.shape.radius, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["normals"]["mean_deg"] == pytest.approx(true_error_deg(capture), abs=0.3)
    assert sum(one["pixels"] for one in found["by_zenith"]) == found["normals"]["pixels"]
    assert sum(one["pixels"] for one in found["by_expected"]) == found["normals"]["pixels"]
    assert Path(found["record"]).parent == tmp_path / "calib" / "balls"
    assert found["flash"]["mm"] == pytest.approx([1000 * at for at in SCENE.light[:2]], abs=4)
    assert "Mean error of the normals" in Path(found["page"]).read_text(encoding="utf-8")
    assert {"ball.html", "ball.json", "ball.png"} <= {file.name for file in (capture / "polcap").iterdir()}
    (tmp_path / "archive").mkdir()
    for name in ("maps", "report.json"):
        (tmp_path / "archive" / name).symlink_to(capture / "polcap" / name)
    (tmp_path / "archive" / "manifest-sha256.txt").touch()
    refused = polcap("validate", tmp_path / "archive", "--ball")
    assert refused.returncode == 2 and "name a folder for the files with --out" in refused.stderr
    assert len(list((tmp_path / "calib" / "balls").iterdir())) == 1  # an error stores no accuracy
    done = polcap("validate", tmp_path / "archive", "--ball", "--out", tmp_path / "page")
    assert done.returncode == 0 and Path(done.stdout.strip()) == tmp_path / "page" / "ball.html"
    assert {"ball.html", "ball.json", "ball.png"} <= {file.name for file in (tmp_path / "page").iterdir()}
    again = polcap("process", capture)
    assert f"on your ball {found['normals']['mean_deg']:.1f}°" in again.stderr
    page = (capture / "polcap" / "report.html").read_text(encoding="utf-8")
    assert f"On your ball it was {found['normals']['mean_deg']:.1f}°" in page


def test_an_object_that_is_no_ball_is_one_line(result: Path, polcap: Command) -> None:
    done = polcap("validate", result, "--ball")
    assert done.returncode == 2 and done.stdout == ""
    assert "of a ball" in done.stderr and done.stderr.count("\n") == 1


def test_the_object_must_be_named(tmp_path: Path, polcap: Command) -> None:
    done = polcap("validate", tmp_path)
    assert done.returncode == 2
    assert "photograph a ball and add --ball" in done.stderr


def test_a_result_whose_gates_failed_is_not_quoted() -> None:
    gates = [{"name": "mask", "state": "pass"}, {"name": "alignment", "state": "fail"}]
    reason = validate_command._reason_against_record({"gates": gates, "capture": {"camera": "Polcap Synthetic"}})
    assert "gates failed (alignment)" in reason
