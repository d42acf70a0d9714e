"""The whole chain on twelve small views: `polcap synth --views 12`, then `polcap fuse`, against the true object."""

import json
from pathlib import Path

import bench_fused_asset
import numpy as np
import pytest

from polcap.fusion import fused_maps
from polcap.fusion.closed_mesh import is_closed
from tests.conftest import shell

pytest.importorskip("embreex")

SMALL = ("width=480", "height=360", "samples=1", "exposures=1")


def synth(folder: Path, views: int) -> Path:
    """A session of small views."""
    made = shell("synth", folder, "--views", views, *(word for one in SMALL for word in ("--set", one)))
    assert made.returncode == 0, made.stderr
    return folder


def test_twelve_raw_views_become_a_closed_object_that_is_like_the_true_one(tmp_path: Path) -> None:
    folder = synth(tmp_path / "object", 12)
    done = shell("fuse", folder)
    assert done.returncode == 0, done.stderr
    about = json.loads((folder / "fused" / "report.json").read_text())
    assert len(about["figures"]["views"]) == 12 and not about["figures"]["left_out"]
    mesh = fused_maps.closed(fused_maps.read(folder / "fused" / "maps").atlas.mesh)
    assert is_closed(mesh)
    with np.load(folder / "truth.npz") as truth:
        extent = np.ptp(truth["vertices"], axis=0)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(extent, rel=0.02)  # true scale; a pixel is 0.7 % of the width
    errors = bench_fused_asset.errors(folder)
    assert errors.distance < 0.01  # of the size; a pixel and a half
    normal, albedo, specular, roughness = errors.fused / errors.single
    assert normal < 1.2 and albedo < 1.0 and specular < 0.8 and roughness < 0.8
