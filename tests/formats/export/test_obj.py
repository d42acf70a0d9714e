"""OBJ and MTL, checked by a second reader and by their keywords."""

from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
import trimesh

from polcap.formats.export import gltf, obj
from polcap.formats.export.texture_set import LOOSE, Key
from polcap.formats.maps import exr
from polcap.mesh_values import Asset

FILES: dict[Key, str] = {key: f"ball_{key}.png" for key in LOOSE}


def test_second_reader_finds_the_same_geometry_and_v_counts_upwards(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball", FILES)
    read = trimesh.load(tmp_path / "ball.obj", force="mesh", process=False, skip_materials=True)
    assert np.allclose(read.vertices, asset.mesh.vertices - gltf.center(asset.mesh.vertices), atol=1e-6)
    assert np.array_equal(read.faces, asset.mesh.faces)
    lines = (tmp_path / "ball.obj").read_text().splitlines()
    uv = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], dtype=float)
    assert np.allclose(uv, asset.mesh.uv * [1, -1] + [0, 1], atol=1e-6)


def test_material_names_files_that_are_there_and_data_that_no_reader_takes_for_srgb(
    asset: Asset, tmp_path: Path
) -> None:
    written = obj.write(tmp_path / "my ball.obj", asset, "my ball", FILES, "one\ntwo")
    assert set(tmp_path.iterdir()) == set(written) and len(written) == 4  # none is partial
    text = (tmp_path / "my ball.obj").read_text()
    assert text.startswith("# one\n# two\n") and "mtllib my_ball.mtl" in text and "usemtl my_ball\n" in text
    lines = (tmp_path / "my_ball.mtl").read_text().splitlines()
    found = dict(line.split(" ", 1) for line in lines if not line.startswith("#"))
    assert found["newmtl"] == "my_ball"
    for keyword, key in (("map_Kd", "basecolor"), ("map_Ks", "specular"), ("norm", "normal")):
        assert found[keyword] == f"ball_{key}.png"
    assert float(found["Ni"]) == 1.5 and float(found["Ns"]) == pytest.approx(30, rel=0.05)  # α = ¼
    assert np.allclose(exr.read(tmp_path / found["map_Pr"])["Y"], 0.5, atol=1 / 255)
    normal = exr.read(tmp_path / found["map_Bump"].split()[-1])
    assert np.allclose(normal["B"], asset.normal[..., 2] / 255, atol=1e-3)


def test_names_of_linked_files_mean_themselves_in_an_address(asset: Asset, tmp_path: Path) -> None:
    written = obj.write(tmp_path / "pot #3 [a] 50%.obj", asset, "pot", FILES)
    names = [path.name for path in written[1:]]
    assert names == ["pot_3_a_50_.mtl", "pot_3_a_50__roughness.exr", "pot_3_a_50__normal.exr"]
    assert all(quote(name) == name for name in names)
    assert "mtllib pot_3_a_50_.mtl\n" in written[0].read_text()
