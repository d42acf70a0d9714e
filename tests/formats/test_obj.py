"""OBJ and MTL as a second reader and their letters have them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from polcap.formats import gltf, obj, png
from polcap.images import Asset
from tests import surfaces


@pytest.fixture(scope="module")
def asset() -> Asset:
    maps = surfaces.maps(roughness=0.5, specular=0.05)
    return surfaces.built(maps, surfaces.mesh(maps))


def test_texture_counts_v_upwards(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball")
    text = (tmp_path / "ball.obj").read_text()
    uv = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("vt ")], dtype=float)
    assert np.allclose(uv[:, 0], asset.mesh.uv[:, 0], atol=1e-6)
    assert np.allclose(uv[:, 1], 1 - asset.mesh.uv[:, 1], atol=1e-6)


def test_second_reader_finds_the_same_geometry(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball")
    read = trimesh.load(tmp_path / "ball.obj", force="mesh", process=False, skip_materials=True)
    assert np.allclose(read.vertices, asset.mesh.vertices - gltf.center(asset.mesh.vertices), atol=1e-6)
    assert np.array_equal(read.faces, asset.mesh.faces)


def test_material_names_files_that_are_there(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "my ball.obj", asset, "my ball")
    text = (tmp_path / "my ball.obj").read_text()
    assert "mtllib my_ball.mtl" in text and "usemtl my_ball\n" in text
    lines = dict(line.split(" ", 1) for line in (tmp_path / "my_ball.mtl").read_text().splitlines())
    assert lines["newmtl"] == "my_ball"
    for key in ("map_Kd", "map_Ks", "map_Pr", "norm"):
        assert png.read(tmp_path / lines[key]).shape[:2] == (surfaces.HEIGHT, surfaces.WIDTH)
    assert np.allclose([float(v) for v in lines["Ks"].split()], 0.05, rtol=1e-5)
    assert float(lines["Ni"]) == 1.5 and float(lines["Ns"]) == pytest.approx(30, rel=0.05)  # α = ¼


def test_no_file_is_left_half(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball")
    names = {path.name for path in tmp_path.iterdir()}
    textures = {f"ball_{key}.png" for key in ("basecolor", "normal", "roughness", "specular")}
    assert names == {"ball.obj", "ball.mtl"} | textures
