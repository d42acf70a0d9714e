"""report.html of a fused object in a browser without network: the object turns all the way round."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from polcap.fusion import fused_page
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps
from polcap.mesh_values import Mesh
from tests.render import devtools

SIDE = 128


def ball() -> Mesh:
    made = trimesh.creation.icosphere(3, radius=0.05)
    x, y, z = made.vertices.T / 0.05
    uv = np.stack([np.arctan2(x, z) / (2 * np.pi) + 0.5, np.arccos(np.clip(y, -1, 1)) / np.pi], axis=-1)
    normals, faces = made.vertex_normals.astype(np.float32), made.faces.astype(np.int32)
    tangents = np.zeros((len(x), 4), np.float32)
    return Mesh(made.vertices.astype(np.float32), normals, uv.astype(np.float32), tangents, faces, True, frame="board")


def textures() -> AtlasMaps:
    """Red in front, blue behind; the right half of the atlas is one chart, the left half another."""
    down, across = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
    around, up = (across - 0.5) * 2 * np.pi, np.cos(down * np.pi)
    normal = np.dstack([np.sin(down * np.pi) * np.sin(around), up, np.sin(down * np.pi) * np.cos(around)])
    front = (np.cos(around) > 0)[..., None]
    diffuse = np.where(front, [0.6, 0.05, 0.05], [0.05, 0.05, 0.6])
    one = np.ones((SIDE, SIDE), np.float32)
    return AtlasMaps(normal, diffuse, np.dstack([0.04 * one] * 3), 0.5 * one, one > 0, one)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fused")
    view = {"name": "view01", "corners": 9, "reprojection_px": 0.1, "pose_sigma_deg": 0.1, "normal_deg": 3.0}
    mesh = {"triangles": 1280, "texture_px": SIDE, "texels_per_mm": 1.0, "metric": True, "extent": [0.1] * 3}
    about = {
        "polcap": "0", "capture": {"name": "ball", "camera": ""}, "verdict": "pass", "gates": [],
        "figures": {"mesh": mesh, "views": {"view01": {**view, "residual": None, "verdict": "pass"}}, "left_out": {}},
    }  # fmt: skip
    maps, none = textures(), np.zeros((0, 3))
    results: Any = SimpleNamespace(atlas=Atlas(ball(), maps.mask, none, none, margin=1), maps=maps)
    fused_page.write(folder, about, results)
    return folder / "report.html"


def test_the_object_turns_all_the_way_round(report: Path) -> None:
    with devtools.opened() as page:
        page.open(report, 1280, 900)
        assert page.evaluate("document.documentElement.dataset.ready") == "yes" and page.complaints == []
        colors = []
        for turn in (0, 3):
            page.evaluate(f"solid.turn = [0, 0]; solid.rotate({turn}, 0)")
            colors.append(page.canvas("solid")[280:320, 460:500].mean(axis=(0, 1)))  # red, green, blue
        assert colors[0][0] > 2 * colors[0][2] and colors[1][2] > 2 * colors[1][0]


def test_the_maps_of_the_atlas_are_shown(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    assert all(f'id="map-{name}"' in text for name in ("normal", "diffuse", "specular", "roughness"))
