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
from tests import surfaces


@pytest.fixture(scope="module")
def asset() -> Asset:
    maps = surfaces.maps(roughness=0.5, specular=0.05)
    return surfaces.built(maps, surfaces.mesh(maps))


FILES: dict[Key, str] = {key: f"ball_{key}.png" for key in LOOSE}


def test_texture_counts_v_upwards(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball", FILES)
    text = (tmp_path / "ball.obj").read_text()
    uv = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("vt ")], dtype=float)
    assert np.allclose(uv[:, 0], asset.mesh.uv[:, 0], atol=1e-6)
    assert np.allclose(uv[:, 1], 1 - asset.mesh.uv[:, 1], atol=1e-6)


def test_second_reader_finds_the_same_geometry(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball", FILES)
    read = trimesh.load(tmp_path / "ball.obj", force="mesh", process=False, skip_materials=True)
    assert np.allclose(read.vertices, asset.mesh.vertices - gltf.center(asset.mesh.vertices), atol=1e-6)
    assert np.array_equal(read.faces, asset.mesh.faces)


def test_material_names_files_that_are_there(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "my ball.obj", asset, "my ball", FILES)
    text = (tmp_path / "my ball.obj").read_text()
    assert "mtllib my_ball.mtl" in text and "usemtl my_ball\n" in text
    lines = dict(line.split(" ", 1) for line in (tmp_path / "my_ball.mtl").read_text().splitlines())
    assert lines["newmtl"] == "my_ball"
    assert (lines["map_Kd"], lines["map_Ks"], lines["norm"]) == (
        "ball_basecolor.png",
        "ball_specular.png",
        "ball_normal.png",
    )
    assert float(lines["Ni"]) == 1.5 and float(lines["Ns"]) == pytest.approx(30, rel=0.05)  # α = ¼


def test_names_of_linked_files_mean_themselves_in_an_address(asset: Asset, tmp_path: Path) -> None:
    written = obj.write(tmp_path / "pot #3 [a] 50%.obj", asset, "pot", FILES)
    names = [path.name for path in written[1:]]
    assert names == ["pot_3_a_50_.mtl", "pot_3_a_50__roughness.exr", "pot_3_a_50__normal.exr"]
    assert all(quote(name) == name for name in names)
    assert "mtllib pot_3_a_50_.mtl\n" in written[0].read_text()


def test_data_are_in_files_that_no_reader_takes_for_srgb(asset: Asset, tmp_path: Path) -> None:
    obj.write(tmp_path / "ball.obj", asset, "ball", FILES)
    lines = dict(line.split(" ", 1) for line in (tmp_path / "ball.mtl").read_text().splitlines())
    roughness, _ = exr.read(tmp_path / lines["map_Pr"])
    assert np.allclose(roughness["Y"], 0.5, atol=1 / 255)
    normal, _ = exr.read(tmp_path / lines["map_Bump"].split()[-1])
    assert np.allclose(normal["B"], asset.normal[..., 2] / 255, atol=1e-3)


def test_written_files_are_listed_and_none_is_partial(asset: Asset, tmp_path: Path) -> None:
    written = obj.write(tmp_path / "ball.obj", asset, "ball", FILES, "one\ntwo")
    assert set(tmp_path.iterdir()) == set(written) and len(written) == 4
    assert (tmp_path / "ball.obj").read_text().startswith("# one\n# two\n")
