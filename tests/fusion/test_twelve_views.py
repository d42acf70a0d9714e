"""The whole chain on small views, `polcap synth --views` and `polcap fuse`: against the true object; after kills."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import bench_fused_asset
import numpy as np
import pytest

import polcap
from polcap.fusion import fused_maps
from polcap.fusion.closed_mesh import is_closed
from polcap.stages.asset import AssetSettings
from tests.conftest import ROOT, shell, slow

pytest.importorskip("embreex")

STAGES = "**/manifest.json"  # stored results of stages
SMALL = ("width=480", "height=360", "samples=1", "exposures=1")


def synth(folder: Path, views: int) -> Path:
    """A session of small views."""
    made = shell("synth", folder, "--views", views, *(word for one in SMALL for word in ("--set", one)))
    assert made.returncode == 0, made.stderr
    return folder


@slow
def test_twelve_raw_views_become_a_closed_object_that_is_like_the_true_one(tmp_path: Path) -> None:
    folder = synth(tmp_path / "object", 12)
    done = shell("fuse", folder, "--set", "fusion.shape.grid=90")
    assert done.returncode == 0, done.stderr
    about = json.loads((folder / "fused" / "report.json").read_text())
    assert len(about["figures"]["views"]) == 12 and not about["figures"]["left_out"]
    stored = json.loads((folder / "fused" / "maps" / "maps.json").read_text())["albedo"]
    charted = [polcap.read_maps(view).albedo_sigma for view in sorted(folder.glob("view*"))]  # by one chart
    assert None not in charted and stored["uncertainty_percent"] == pytest.approx(100 * np.median(charted), abs=0.1)
    mesh = fused_maps.weld(fused_maps.read(folder / "fused" / "maps", AssetSettings()).atlas.mesh)
    assert is_closed(mesh)
    with np.load(folder / "truth.npz") as truth:
        extent = np.ptp(truth["vertices"], axis=0)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(extent, rel=0.02)  # true scale; a pixel is 0.7 % of the width
    errors = bench_fused_asset.errors(folder)
    assert errors.distance < 0.01  # of the size; a pixel and a half
    normal, albedo, _, roughness = errors.fused.mean(axis=0) / errors.single.mean(axis=0)
    assert normal < 1.2 and albedo < 1.1 and roughness < 0.6
    assert errors.fused[:, 2].mean() < 0.008  # F0 of .049, which the single views happen to read right to .003


def killed(folder: Path, *options: str, after: str) -> None:
    """Start a fusion and kill it a moment after it has printed a line that begins with `after`."""
    command = [sys.executable, "-m", "polcap", "fuse", str(folder), *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr is not None
        assert any(line.startswith(after) for line in running.stderr)
        time.sleep(0.3)
        running.kill()


def written(folder: Path, pattern: str) -> dict[str, bytes]:
    """Bytes of the files below a folder, by their paths."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.glob(pattern) if file.is_file()}


def stats(folder: Path, pattern: str) -> dict[Path, int]:
    """When the files below a folder were written, without those that each run writes."""
    files = (file for file in folder.glob(pattern) if file.is_file() and file.name not in ("lock", "owner"))
    return {file: file.stat().st_mtime_ns for file in files}


@slow
def test_a_fusion_that_was_killed_twice_ends_as_one_that_was_not(tmp_path: Path) -> None:
    """And so does one of two views at a time as one of a single one."""
    folder, coarse = synth(tmp_path / "object", 4), ("--set", "fusion.shape.grid=60", "--estimator", "analytic")
    whole = tmp_path / "whole" / "object"
    shutil.copytree(folder, whole)
    assert shell("fuse", whole, *coarse).returncode == 0
    killed(folder, *coarse, "--workers", "2", after="view02: maps")
    assert not (folder / "view04/polcap/report.json").exists()
    before = stats(folder, STAGES)
    killed(folder, *coarse, "--workers", "2", after="shape ")
    assert not (folder / "fused/report.json").exists() and not (folder / "fused/maps/maps.json").exists()
    assert stats(folder, STAGES).items() >= before.items()  # nothing was computed again
    before = stats(folder, STAGES)
    done = shell("fuse", folder, *coarse)
    assert done.returncode == 0, done.stderr
    assert stats(folder, STAGES).items() >= before.items()
    same = shell("fuse", folder, *coarse)
    assert "Nothing has changed" in same.stderr and same.stdout == done.stdout
    record = {str(Path("fused", "work", "unchanged.json"))}  # is not written if the photographs are newer than 3 s
    assert written(folder, "**/*").keys() - record == written(whole, "**/*").keys() - record  # nothing partial is left
    assert written(folder, "view*/polcap/maps/*") == written(whole, "view*/polcap/maps/*")
    again, once = (fused_maps.read(one / "fused/maps", AssetSettings()) for one in (folder, whole))
    assert again.atlas.mesh.vertices == pytest.approx(once.atlas.mesh.vertices, abs=1e-6)  # m
    difference = np.abs(again.maps.normal - once.maps.normal)
    assert np.quantile(difference, 0.999) < 1e-3  # the last bits of a sum could decide which views a few texels see
    views = stats(folder, "view*/polcap/**/*")
    judged = shell("fuse", folder, *coarse, "--set", "fusion.gates.min_seen=0.1")
    assert judged.returncode == 0 and stats(folder, "view*/polcap/**/*") == views  # nothing of a view was written again
