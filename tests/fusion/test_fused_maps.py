"""The stored maps of a fused object, and exports made from them."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from polcap.errors import DecodeError, ObjectError, SettingError
from polcap.formats.export import gltf, texture_set
from polcap.formats.maps import maps_folder, result_maps
from polcap.fusion import atlas as atlases
from polcap.fusion import closed_mesh, filling, fuse_run, fused_maps
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.closed_mesh import is_closed
from polcap.fusion.fused_maps import FusedSource
from polcap.fusion.values import ClosedMesh
from polcap.pipeline import detail_levels, export_request
from polcap.pipeline.export_request import ExportRequest
from polcap.stages.asset import AssetSettings
from tests.fusion import ellipsoid


@pytest.fixture(scope="module")
def source(atlas: Atlas, baked: AtlasMaps) -> FusedSource:
    return FusedSource(atlas, filling.fill(baked, atlas), AssetSettings())


def test_maps_and_mesh_come_back_as_written(source: FusedSource, tmp_path: Path) -> None:
    fused_maps.write(tmp_path / "maps", source.atlas, source.maps, {})
    back = fused_maps.read(tmp_path / "maps", AssetSettings())
    assert fused_maps.is_fused(tmp_path) and not fused_maps.is_fused(tmp_path / "maps")
    assert np.array_equal(back.atlas.mesh.vertices, source.atlas.mesh.vertices)
    assert np.array_equal(back.maps.normal, source.maps.normal)
    assert back.maps.diffuse == pytest.approx(source.maps.diffuse, abs=1e-3)  # half floats


def test_coarser_levels_have_the_unit_and_the_margin_of_the_full_mesh(source: FusedSource, tmp_path: Path) -> None:
    atlas = atlases.chart(ellipsoid.mesh(), 256, 16, metric=False)
    fused_maps.write(tmp_path, atlas, fused_maps.transfer(source.atlas, source.maps, atlas), {})
    level = detail_levels.levels(fused_maps.read(tmp_path, AssetSettings()), ExportRequest(lod=1))[1].asset.mesh
    coarse = fused_maps.weld(atlas.mesh)
    again = atlases.chart(closed_mesh.decimate(coarse, round(len(coarse.faces) / 4)), 256, 16)
    assert not level.metric and np.array_equal(level.uv, again.mesh.uv)


def test_a_coarser_level_that_cannot_be_charted_is_reduced_further(
    source: FusedSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, level = (one.asset.mesh for one in detail_levels.levels(source, ExportRequest(lod=1)))
    charted, calls = atlases.chart, list[int]()

    def failing(mesh: ClosedMesh, side: int, margin: int, metric: bool) -> Atlas:
        calls.append(len(mesh.faces))
        if len(calls) == 1:
            raise ObjectError("no texture atlas")
        return charted(mesh, side, margin, metric)

    monkeypatch.setattr(atlases, "chart", failing)
    again = detail_levels.levels(source, ExportRequest(lod=1))[1].asset.mesh
    assert 0.85 < len(again.faces) / len(level.faces) < 0.95 and len(level.faces) < len(whole.faces)


def test_extra_textures_are_of_the_mesh(source: FusedSource, monkeypatch: pytest.MonkeyPatch) -> None:
    half = np.tile(np.linspace(0, 1, 256), (256, 1))
    monkeypatch.setattr(fused_maps, "ambient_occlusion", lambda atlas: half)
    for level in detail_levels.levels(source, ExportRequest(extras=("occlusion",), lod=1)):
        pixels = texture_set.occlusion(level.asset).pixels
        expected = half.reshape(len(pixels), -1, len(pixels), 256 // len(pixels)).mean(axis=(1, 3))
        assert pixels == pytest.approx(255 * expected, abs=1)
    (turned,) = detail_levels.levels(source, ExportRequest(extras=("object-normal",)))
    assert "camera" not in texture_set.object_normal(turned.asset).meaning  # the object has no side of its own
    plain = detail_levels.levels(source, ExportRequest(lod=1))
    assert all((texture_set.occlusion(level.asset).pixels == 255).all() for level in plain)


def test_a_reader_of_one_view_and_an_export_refuse_what_a_fused_object_lacks(
    source: FusedSource, tmp_path: Path
) -> None:
    fused_maps.write(tmp_path / "fused" / "maps", source.atlas, source.maps, {})
    for place in (tmp_path, tmp_path / "fused"):
        with pytest.raises(DecodeError, match=r"textures of a fused object.*give one of its views"):
            result_maps.read(place)
    for kind in ("fused", "material"):
        (tmp_path / "maps.json").write_text(json.dumps({"format": f"polcap {kind} maps 1"}))
        with pytest.raises(DecodeError, match="of a fused object or of a material"):
            maps_folder.read(tmp_path)  # as a comparison does
    with pytest.raises(SettingError, match="--exr is for results of one view"):
        fuse_run.export(tmp_path / "fused", ExportRequest(formats=("exr",)))


def test_an_export_leaves_out_what_a_closed_mesh_lacks_and_writes_the_rest() -> None:
    request = export_request.without(
        ExportRequest(preset="archive", extras=("displacement", "occlusion")), fuse_run.OF_ONE_VIEW
    )
    found = export_request.effective(request)
    assert found.extras == ("occlusion",) and found.formats == ("gltf", "obj", "usd", "materialx")


def test_the_glb_is_closed_when_it_is_read_back(source: FusedSource, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "ball.glb").write_bytes(gltf.encode(source.whole(8, ()), "ball"))
    read = trimesh.load(tmp_path / "ball.glb", force="mesh", process=False)
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight and read.volume > 0
    assert np.ptp(read.vertices, axis=0) == pytest.approx(2 * ellipsoid.AXES, rel=0.01)
    length = int.from_bytes((tmp_path / "ball.glb").read_bytes()[12:16], "little")
    said = json.loads((tmp_path / "ball.glb").read_bytes()[20 : 20 + length])
    assert said["materials"][0]["doubleSided"] is False
    assert "origin_in_board" in said["asset"]["extras"]


def test_coarser_levels_are_closed_and_keep_their_textures(source: FusedSource) -> None:
    full, coarse = detail_levels.levels(source, ExportRequest(lod=1))
    assert len(coarse.asset.mesh.faces) == pytest.approx(len(full.asset.mesh.faces) / 4, rel=0.1)
    assert is_closed(fused_maps.weld(coarse.asset.mesh))
    for textured in (full.asset, coarse.asset):
        color = textured.base_color[textured.normal[..., 2] > 128].reshape(-1, 3).mean(axis=0)
        assert color == pytest.approx(full.asset.base_color.reshape(-1, 3).mean(axis=0), rel=0.1)
    assert coarse.decimated is not None and 0 < coarse.decimated.error < 0.003


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("vertices", lambda array: array.T),
        ("vertices", lambda array: array[:0]),
        ("normals", lambda array: np.full_like(array, np.nan)),
        ("uv", lambda array: array[:, :1]),
        ("tangents", lambda array: array.astype(str)),
        ("faces", lambda array: array + 10**6),
        ("faces", lambda array: -array - 1),
        ("faces", lambda array: array.astype(float)),
        ("faces", lambda array: array[:0]),
        ("faces", lambda array: np.int32(1)),
        ("faces", None),
    ],
)
def test_a_stored_mesh_of_another_shape_is_one_line(
    source: FusedSource, tmp_path: Path, name: str, change: Callable[[np.ndarray], np.ndarray] | None
) -> None:
    fused_maps.write(tmp_path, source.atlas, source.maps, {})
    with np.load(tmp_path / "mesh.npz") as stored:
        arrays = dict(stored)
    arrays |= {name: change(arrays[name])} if change else {}
    np.savez(tmp_path / "mesh.npz", **arrays if change else {"other": arrays["faces"]})
    with pytest.raises(DecodeError, match=r"mesh\.npz"):
        fused_maps.read(tmp_path, AssetSettings())


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("maps.json", b"[]"), ("maps.json", b'{"size": [256], "unit": "m", "margin": 6}'), ("mesh.npz", b""),
        ("maps.json", b'{"size": [512, 512], "unit": "m"}'), ("mesh.npz", b"PK\x05\x06" + b"\0" * 18),
        ("mask.png", b""), ("normal.exr", b""),
    ],
)  # fmt: skip
def test_a_damaged_file_of_fused_maps_is_one_line(
    source: FusedSource, tmp_path: Path, file: str, content: bytes
) -> None:
    fused_maps.write(tmp_path, source.atlas, source.maps, {})
    (tmp_path / file).write_bytes(content)
    with pytest.raises(DecodeError):
        fused_maps.read(tmp_path, AssetSettings())
