"""PLY and STL, read by their specifications."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap.formats.export import gltf, ply_stl
from polcap.mesh_values import Asset


@pytest.mark.parametrize(("metric", "unit"), [(True, 1000), (False, 1)])
def test_stl_has_the_corners_of_every_triangle_in_mm(asset: Asset, tmp_path: Path, metric: bool, unit: int) -> None:
    mesh = replace(asset.mesh, metric=metric)
    ply_stl.write(tmp_path / "ball.stl", replace(asset, mesh=mesh))
    data = (tmp_path / "ball.stl").read_bytes()
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
    triangles = np.frombuffer(data, record, offset=84)
    assert int.from_bytes(data[80:84], "little") == len(triangles) == len(mesh.faces)
    corners = (mesh.vertices - gltf.center(mesh.vertices))[mesh.faces] * unit
    assert np.allclose(triangles["corners"], corners, atol=1e-6 * unit)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.sum(normal * triangles["normal"], axis=1) >= 0)  # outwards


@pytest.mark.parametrize("bits", [8, 16])
def test_ply_has_color_and_normal_of_every_vertex(asset: Asset, tmp_path: Path, bits: int) -> None:
    half_red = np.zeros((*asset.normal.shape[:2], 3), np.uint8)
    half_red[:, half_red.shape[1] // 2 :, 0] = 200
    painted = half_red if bits == 8 else half_red.astype(np.uint16) * 257
    ply_stl.write(tmp_path / "ball.ply", replace(asset, base_color=painted))
    head, _, body = (tmp_path / "ball.ply").read_bytes().partition(b"end_header\n")
    assert b"format binary_little_endian 1.0" in head
    words = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    assert " ".join(name for *_, name in words) == "x y z nx ny nz red green blue alpha vertex_indices"
    vertex = np.dtype([("point", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 4)])
    count = len(asset.mesh.vertices)
    vertices = np.frombuffer(body, vertex, count)
    faces = np.frombuffer(body, np.dtype([("count", "u1"), ("corner", "<i4", 3)]), offset=count * vertex.itemsize)
    assert np.allclose(vertices["point"], asset.mesh.vertices - gltf.center(asset.mesh.vertices), atol=1e-6)
    assert np.allclose(vertices["normal"], asset.mesh.normals, atol=1e-5)
    on_the_right = asset.mesh.uv[:, 0] * half_red.shape[1] >= half_red.shape[1] // 2
    assert np.array_equal(vertices["color"][:, 0] == 200, on_the_right)
    assert np.all(vertices["color"][:, 1:] == [0, 0, 255])
    assert np.array_equal(faces["corner"], asset.mesh.faces) and np.all(faces["count"] == 3)
