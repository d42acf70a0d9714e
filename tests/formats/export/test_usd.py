"""USD and MaterialX, checked by OpenUSD's validators and the MaterialX library."""

import sys
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from polcap.errors import SettingError
from polcap.formats.export import encoders, gltf, materialx, texture_set, usd
from polcap.formats.export.texture_set import LOOSE, Key
from polcap.formats.maps import exr
from polcap.mesh_values import Asset
from polcap.optics import color

FILES: dict[Key, str] = {key: f"ball_{key}.png" for key in LOOSE}


@pytest.fixture(scope="module")
def folder(asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ball.usdc, ball.mtlx and their textures."""
    pytest.importorskip("pxr", reason="needs usd-core")
    where = tmp_path_factory.mktemp("usd")
    write(where, asset)
    return where


def write(where: Path, asset: Asset) -> None:
    usd.write(where / "ball.usdc", asset, "ball", FILES, {"unit": "m"})
    (where / "ball.mtlx").write_text(materialx.document(asset, "ball", FILES, "a ball"))
    textures: dict[Key, bytes] = {key: encoders.encode(LOOSE[key](asset), "png") for key in FILES}
    for key, file in FILES.items():
        (where / file).write_bytes(textures[key])
    usd.package(where / "ball.usdz", asset, "ball", textures, {"unit": "m"})


def opened(folder: Path, name: str = "ball.usdc") -> Any:
    from pxr import Usd

    return Usd.Stage.Open(str(folder / name))


@pytest.mark.parametrize("name", ["ball.usdc", "ball.usdz"])
def test_usd_validators_find_nothing(folder: Path, name: str) -> None:
    """Those of OpenUSD's usdchecker; a usd-core without UsdMtlx cannot know MaterialX' nodes."""
    validation = pytest.importorskip("pxr.UsdValidation", reason="needs usd-core 25.11 or later")
    every = validation.ValidationRegistry().GetOrLoadAllValidators()
    found = validation.ValidationContext(every).Validate(opened(folder, name))
    assert len(every) > 20
    assert [one.GetMessage() for one in found if "shaderId 'ND_" not in one.GetMessage()] == []


def test_stage_is_upright_in_metres_and_names_its_root(folder: Path, asset: Asset) -> None:
    from pxr import UsdGeom

    stage = opened(folder)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/ball"
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/ball/ball_mesh"))
    points = np.array(shape.GetPointsAttr().Get())
    assert np.allclose(points, asset.mesh.vertices - gltf.center(asset.mesh.vertices), atol=1e-6)
    st = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get())
    assert np.allclose(st[:, 1], 1 - asset.mesh.uv[:, 1], atol=1e-6)
    assert shape.GetDoubleSidedAttr().Get()


def test_linear_textures_are_declared_linear(asset: Asset, tmp_path: Path) -> None:
    UsdShade = pytest.importorskip("pxr.UsdShade", reason="needs usd-core")

    files: dict[Key, str] = {key: f"ball_{key}.exr" for key in LOOSE}
    usd.write(tmp_path / "ball.usdc", asset, "ball", files, {})
    stage = opened(tmp_path)
    spaces = [UsdShade.Shader(prim).GetInput("sourceColorSpace") for prim in stage.Traverse()]
    assert {str(one.Get()) for one in spaces if one} == {"raw"}
    assert "srgb_texture" not in materialx.document(asset, "ball", files, "a ball")
    for key, file in files.items():
        texture_set.write_exr(tmp_path / file, LOOSE[key](asset))
    channels = exr.read(tmp_path / "ball_basecolor.exr")
    linear = color.decode_srgb(asset.base_color / 255)
    assert np.allclose(np.stack([channels[c] for c in "RGB"], axis=-1), linear, atol=1e-3)


def test_usdz_is_one_file_with_one_material_that_phones_know(folder: Path) -> None:
    from pxr import UsdShade

    with zipfile.ZipFile(folder / "ball.usdz") as package:
        held = package.infolist()
    assert {one.filename for one in held} == {"ball.usdc", *(f"{key}.png" for key in FILES)}
    assert held[0].filename == "ball.usdc" and all(one.compress_type == zipfile.ZIP_STORED for one in held)
    stage = opened(folder, "ball.usdz")
    (material,) = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]
    surface = UsdShade.Material(material).ComputeSurfaceSource()[0]
    assert surface.GetShaderId() == "UsdPreviewSurface"
    assert not UsdShade.Material(material).GetSurfaceOutput("mtlx")


def test_every_reader_finds_a_surface_with_measured_reflectance(folder: Path) -> None:
    """F0 from a texture: by its own scale in the specular workflow, as a tint of F0(1.5) for Blender."""
    from pxr import UsdShade

    stage = opened(folder)
    bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/ball/ball_mesh"))
    scales = []
    for purpose in (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full):
        material, _ = bound.ComputeBoundMaterial(purpose)
        assert material.GetSurfaceOutput("mtlx").HasConnectedSource()
        preview = material.ComputeSurfaceSource()[0]
        source = preview.GetInput("specularColor").GetConnectedSources()[0][0].source
        unit = 1 if preview.GetInput("useSpecularWorkflow").Get() else 0.04
        scales.append(source.GetInput("scale").Get()[0] * unit)
    assert np.allclose(scales, 0.08)


def test_materialx_library_finds_the_document_valid(folder: Path) -> None:
    mx = pytest.importorskip("MaterialX", reason="needs materialx")
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(folder / "ball.mtlx"))
    document.importLibrary(library)
    assert document.validate() == (True, "")
    for node in document.getNodes():
        definition = node.getNodeDef()
        assert definition is not None, node.getName()
        for one in node.getInputs():
            assert definition.getActiveInput(one.getName()).getType() == one.getType(), one.getName()


def test_nodes_follow_the_nodes_of_their_inputs(asset: Asset) -> None:
    seen: set[str] = set()
    for node in ElementTree.fromstring(materialx.document(asset, "ball", FILES, "a ball")):
        assert {one.attrib["nodename"] for one in node if "nodename" in one.attrib} <= seen
        seen.add(node.attrib["name"])


def test_same_asset_gives_the_same_bytes(folder: Path, asset: Asset, tmp_path: Path) -> None:
    write(tmp_path, asset)
    for name in ("ball.usdc", "ball.usdz", "ball.mtlx"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_without_usd_core_one_line_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(SettingError, match=r"usd-core; pip install 'polcap\[usd\]'"):
        usd.require()


@pytest.mark.parametrize(("name", "identifier"), [("Krug “ø” 1", "Krug_____1"), ("3 cups", "_3_cups")])
def test_names_become_identifiers(name: str, identifier: str) -> None:
    assert materialx.identifier(name) == identifier
