"""The whole chain without a board: RAW views of a patterned object become a closed object of its shape."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.distance import pdist

from polcap.fusion import fused_maps
from polcap.fusion.closed_mesh import is_closed
from polcap.image_values import Floats
from polcap.stages.asset import AssetSettings
from polcap.synth import all_around, scenes
from tests.conftest import Command, shell, slow

pytest.importorskip("embreex")


def session(folder: Path, pattern: str, views: int, width: int = 540) -> Path:
    """Views all around, without the one with the chart."""
    scene = scenes.random_scene(1, "bumps")
    materials = tuple(replace(one, pattern=pattern, size=0.006) for one in scene.coat.materials[:1])
    shoot = all_around.AroundShoot(
        width=width, height=width * 2 // 3, samples=1, exposures=1, board="none", focal_mm=110.0
    )
    all_around.write(folder, replace(scene, coat=replace(scene.coat, materials=materials)), shoot, views)
    shutil.rmtree(folder / "view01")
    return folder


@slow
def test_views_without_a_board_become_a_closed_object_of_relative_size(tmp_path: Path) -> None:
    folder = session(tmp_path / "object", "noise", 18, width=400)
    done = shell("fuse", folder, "--no-chart", "--set", "fusion.shape.grid=60", "--estimator", "analytic")
    assert done.returncode == 0, done.stderr
    about = json.loads((folder / "fused" / "report.json").read_text())
    assert len(about["figures"]["views"]) >= 15  # of 17
    assert not about["figures"]["mesh"]["metric"]
    assert json.loads((folder / "fused" / "maps" / "maps.json").read_text())["unit"] == "relative"
    mesh = fused_maps.weld(fused_maps.read(folder / "fused" / "maps", AssetSettings()).atlas.mesh)
    assert is_closed(mesh)
    with np.load(folder / "truth.npz") as truth:
        true = width(truth["vertices"])
    assert width(mesh.vertices) * 0.7 == pytest.approx(true, rel=0.05)  # the lens is 0.7 m from the axis, here 1


def width(vertices: Floats) -> float:
    """Largest horizontal distance between points."""
    return float(pdist(vertices[::11, [0, 2]]).max())


def test_an_object_without_pattern_is_refused_with_the_remedy(tmp_path: Path, polcap: Command) -> None:
    folder = session(tmp_path / "object", "plain", 4, width=180)
    done = polcap("fuse", folder, "--no-chart", "--estimator", "analytic")
    assert done.returncode == 2
    assert "no view shows a board" in done.stderr and "polcap board" in done.stderr
    assert not (folder / "fused" / "report.json").exists()
