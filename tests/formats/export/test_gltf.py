"""GLB, checked by the Khronos validator and a second reader."""

import json
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from polcap.errors import SettingError
from polcap.formats.export import glb_geometry, gltf
from polcap.formats.export.encoders import Kind
from polcap.formats.export.glb_geometry import Geometry
from polcap.mesh_values import Asset, Mesh
from tests import surfaces

NODE = Path(__file__).parents[2] / "gltf"


def closed_ball() -> Mesh:
    """A closed mesh, the first of whose vertices no triangle has."""
    ball = trimesh.creation.icosphere(4)  # 2,562 vertices
    faces = np.asarray(ball.faces, np.int32)
    faces = faces[np.argsort(faces.min(axis=1))] + 7
    vertices = np.concatenate([np.zeros((7, 3)), ball.vertices]).astype(np.float32)
    none = np.zeros_like(vertices)
    return Mesh(vertices, none, none[:, :2], np.zeros((len(none), 4), np.float32), faces, metric=True, frame="board")


def document(data: bytes) -> dict[str, Any]:
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    return dict(json.loads(data[20 : 20 + length]))


def packet(asset: Asset, **facts: str) -> dict[str, Any]:
    """The XMP packet of a GLB with these facts."""
    parsed = document(gltf.encode(asset, "ball", provenance=facts))
    number = parsed["asset"]["extensions"]["KHR_xmp_json_ld"]["packet"]
    return dict(parsed["extensions"]["KHR_xmp_json_ld"]["packets"][number])


@pytest.mark.parametrize(
    ("images", "geometry"), [("png", "float"), ("jpeg", "float"), ("webp", "quantized"), ("png", "quantized")]
)
def test_khronos_validator_finds_nothing(asset: Asset, tmp_path: Path, images: Kind, geometry: Geometry) -> None:
    node = shutil.which("node")
    if node is None or not (NODE / "node_modules" / "gltf-validator").is_dir():
        pytest.skip("needs node, and `npm ci` in tests/gltf")
    (tmp_path / "ball.glb").write_bytes(gltf.encode(asset, "ball", gltf.GlbOptions(images, geometry), {"unit": "m"}))
    command = [node, str(NODE / "validate.js"), str(tmp_path / "ball.glb")]
    report = json.loads(subprocess.run(command, capture_output=True, check=True, timeout=300).stdout)
    issues = report["issues"]
    assert (issues["numErrors"], issues["numWarnings"], issues["numHints"]) == (0, 0, 0), issues["messages"]
    known = {"IMAGE_NPOT_DIMENSIONS", "UNSUPPORTED_EXTENSION"}  # fine since WebGL 2; XMP, which it does not know
    assert {message["code"] for message in issues["messages"]} <= known
    assert report["info"]["totalTriangleCount"] == len(asset.mesh.faces)


def test_second_reader_finds_the_same_geometry(asset: Asset, tmp_path: Path) -> None:
    (tmp_path / "ball.glb").write_bytes(gltf.encode(asset, "ball"))
    read = trimesh.load(tmp_path / "ball.glb", force="mesh", process=False, skip_materials=True)
    middle = gltf.center(asset.mesh.vertices)
    assert np.allclose(read.vertices, asset.mesh.vertices - middle, atol=1e-6)
    assert np.array_equal(read.faces, asset.mesh.faces)
    assert np.allclose(read.bounds.sum(axis=0), 0, atol=1e-6)  # the object is at the origin
    assert np.allclose(np.ptp(read.bounds, axis=0)[:2], 2 * surfaces.RADIUS, rtol=0.1)  # metres


def test_extensions_carry_index_and_reflectance(asset: Asset) -> None:
    parsed = document(gltf.encode(asset, "ball"))
    extensions = parsed["materials"][0]["extensions"]
    assert extensions["KHR_materials_ior"] == {"ior": 1.5}
    factor = extensions["KHR_materials_specular"]["specularColorFactor"]
    assert np.allclose(factor, 0.05 / 0.04, rtol=1e-5)  # F0 = 0.04 · factor; may exceed 1
    assert parsed["asset"]["extras"]["unit"] == "metre"
    assert parsed["asset"]["extras"]["origin_in_camera"][2] < -0.5


def test_same_asset_gives_the_same_bytes_and_names_outside_ascii_survive(asset: Asset) -> None:
    data = gltf.encode(asset, "Krug “ø”")
    assert data == gltf.encode(asset, "Krug “ø”") and document(data)["nodes"][0]["name"] == "Krug “ø”"


def test_provenance_is_in_the_packet(asset: Asset) -> None:
    found = packet(asset, settings="{}")
    assert found["polcap:settings"] == "{}" and found["dc:title"]["rdf:_1"]["@value"] == "ball"
    assert found["@context"]["dc"] == "http://purl.org/dc/elements/1.1/"


def test_catalog_entry_is_in_dublin_core_and_in_the_copyright(asset: Asset) -> None:
    stated = {"title": "Krug", "creator": "Haus", "rights": "© Haus", "license": "CC0", "object_number": "7"}
    stated |= {"date": "1897", "institution": "Haus", "description": "Blau"}
    found = packet(asset, **stated)
    assert found["dc:title"]["rdf:_1"]["@value"] == "Krug" and found["dc:creator"] == {"@list": ["Haus"]}
    assert found["dc:rights"]["rdf:_1"]["@value"] == "© Haus"
    assert document(gltf.encode(asset, "ball", provenance=stated))["asset"]["copyright"] == "© Haus"
    assert found["dc:identifier"] == "7" and found["dc:date"] == {"@list": ["1897"]}
    assert found["dc:publisher"] == {"@set": ["Haus"]} and found["dc:description"]["rdf:_1"]["@value"] == "Blau"


def test_only_the_address_of_a_license_is_a_web_statement(asset: Asset) -> None:
    address = "https://museum.example/our"
    assert packet(asset, license=address)["xmpRights:WebStatement"] == address
    assert packet(asset, license=f"{address} terms")["xmpRights:WebStatement"] == f"{address}%20terms"
    named = packet(asset, license="CC BY 4.0")
    assert named["xmpRights:UsageTerms"]["rdf:_1"]["@value"] == "CC BY 4.0" and "xmpRights:WebStatement" not in named


def test_a_lost_triangle_opens_a_surface_and_seams_of_an_atlas_do_not(asset: Asset) -> None:
    """Wherever its vertices are listed; of the atlas, each triangle is a chart of its own."""
    ball = closed_ball()
    corners = ball.vertices[ball.faces].reshape(-1, 3)
    charts = replace(ball, vertices=corners, faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    for mesh in (ball, charts):
        assert not gltf.is_open(mesh)
        for lost in (0, -1):
            assert gltf.is_open(replace(mesh, faces=np.delete(mesh.faces, lost, axis=0)))
    assert document(gltf.encode(asset, "ball"))["materials"][0]["doubleSided"] is True


def test_draco_without_its_package_is_one_line(asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(SettingError, match=r"pip install 'polcap\[draco\]'"):
        gltf.encode(asset, "ball", gltf.GlbOptions(geometry="draco"))


@pytest.mark.parametrize(("geometry", "share"), [("quantized", 0.65), ("draco", 0.2)])
def test_packed_mesh_is_smaller_and_names_its_extension(asset: Asset, geometry: Geometry, share: float) -> None:
    """Its content is tested with the readers three.js and Blender (tests/render, tests/blender)."""
    if geometry == "draco":
        pytest.importorskip("DracoPy")
    held = {}
    for one in (geometry, "float"):
        data = gltf.encode(asset, "ball", gltf.GlbOptions(geometry=one))
        parsed = document(data)
        pictures = [parsed["bufferViews"][image["bufferView"]]["byteLength"] for image in parsed["images"]]
        held[one] = len(data) - sum(pictures)
        assert set(glb_geometry.EXTENSIONS[one]) == set(parsed.get("extensionsRequired", []))
    assert held[geometry] < share * held["float"]


def test_quantized_positions_span_the_mesh(asset: Asset) -> None:
    parsed = document(gltf.encode(asset, "ball", gltf.GlbOptions(geometry="quantized")))
    at = parsed["accessors"][parsed["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    node = next(node for node in parsed["nodes"] if "mesh" in node)
    span = (np.array(at["max"]) - at["min"]) / 65535 * node["scale"]
    np.testing.assert_allclose(span, np.ptp(asset.mesh.vertices, axis=0), rtol=1e-4)
