"""Meshes and texture folders of other people become a data folder that training reads."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from polcap.errors import InputError, StorageError
from polcap.formats import scene_files
from polcap.training import import_data, traced_views
from tests.training.conftest import write_textures


def save(folder: Path, name: str) -> trimesh.Trimesh:
    folder.mkdir(parents=True, exist_ok=True)
    mesh = trimesh.creation.box((1.0, 2.0, 3.0)).subdivide()
    mesh.export(folder / name)
    return mesh


@pytest.mark.parametrize("suffix", ["obj", "glb", "ply", "stl"])
def test_a_mesh_keeps_its_surface_to_16_bits(tmp_path: Path, suffix: str) -> None:
    """An STL has three vertices per triangle; equal ones are joined, so that normals are smooth across them."""
    mesh = save(tmp_path / "in", f"Box 1.{suffix}")
    import_data.write_mesh(tmp_path / "in" / f"Box 1.{suffix}", tmp_path / "box.npz")
    vertices, faces = scene_files.read_mesh(tmp_path / "box.npz")
    again = trimesh.Trimesh(vertices, faces, process=False)
    assert again.is_watertight and again.volume == pytest.approx(mesh.volume, rel=1e-3)
    assert len(vertices) == len(mesh.vertices)
    assert np.ptp(vertices, axis=0) == pytest.approx(np.ptp(mesh.vertices, axis=0), abs=1e-4)


def test_a_folder_becomes_the_layout_of_training(tmp_path: Path) -> None:
    for number in range(12):
        save(tmp_path / "in" / "a set", f"mesh {number:02d}.ply")
    write_textures(tmp_path / "in" / "Bricks", 1)
    (tmp_path / "in" / "broken.obj").write_text("nothing")
    write_textures(tmp_path / "in" / "Rock", 2)
    next((tmp_path / "in" / "Rock").glob("*ough*")).unlink()
    left_out: list[str] = []
    assert import_data.main(tmp_path / "in", tmp_path / "data", left_out.append) == (12, 1)
    incomplete, broken, single, _ = left_out
    assert incomplete.startswith("left out: ") and "Rock has no picture with roughness" in incomplete
    assert broken.startswith("left out: ") and "broken.obj" in broken
    assert "only texture folder is for training and for tests" in single
    meshes = traced_views.training_meshes(tmp_path / "data")
    tests = sorted((tmp_path / "data" / "meshes" / "test").glob("*.npz"))
    assert import_data.main(tmp_path / "in", tmp_path / "data") == (12, 1)  # its own files are replaced
    meshes[0].write_bytes(b"of others")
    with pytest.raises(StorageError, match="move it away"):
        import_data.main(tmp_path / "in", tmp_path / "data")
    assert meshes[0].read_bytes() == b"of others"
    assert len(meshes) == 10 and len(tests) == 2 and "a_set_mesh_01" in {mesh.stem for mesh in meshes}
    for split in ("train", "test"):  # a single one is for both
        assert scene_files.read_textures(tmp_path / "data" / "materials" / split / "bricks").shape == (6, 256, 256)


@pytest.mark.parametrize(("name", "green"), [("Rock_NormalGL.png", 255 - 200), ("rock_nor_dx.png", 200)])
def test_pictures_are_found_by_name_and_normals_point_down(tmp_path: Path, name: str, green: int) -> None:
    source = tmp_path / "rock"
    source.mkdir()
    for file, color in (
        ("Rock_BaseColor.png", (9, 99, 199)),
        ("rock_rough_2k.png", (50, 50, 50)),
        (name, (128, 200, 128)),
    ):
        cv2.imwrite(str(source / file), np.full((32, 32, 3), color[::-1], np.uint8))
    import_data.write_textures(source, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["albedo.jpg", "normal.jpg", "roughness.jpg"]
    assert cv2.imread(str(tmp_path / "out" / "normal.jpg"))[..., 1].mean() == pytest.approx(green, abs=2)
    assert cv2.imread(str(tmp_path / "out" / "albedo.jpg"))[0, 0] == pytest.approx([199, 99, 9], abs=3)


def test_a_folder_without_anything_usable_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no mesh"):
        import_data.main(tmp_path, tmp_path / "data")
    with pytest.raises(InputError, match="no such folder"):
        import_data.main(tmp_path / "none", tmp_path / "data")
    command = [sys.executable, "-m", "polcap.training.import_data", str(tmp_path), str(tmp_path / "data")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "polcap: error: " in done.stderr
