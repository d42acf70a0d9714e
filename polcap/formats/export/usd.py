"""Writes an asset as USD: the mesh, and its material as OpenPBR and as UsdPreviewSurface.

Renderers that read MaterialX use `outputs:mtlx:surface`; all others read the UsdPreviewSurface. Its specular workflow
takes F0 from a texture. Blender reads that texture as a tint of F0 in either workflow. So the mesh is bound twice: for
every purpose to the material in the specular workflow, and for the purpose `full`, which Blender prefers, to a copy
with F0 as a tint. USDZ, for phones, has the first of these materials, without OpenPBR. Needs usd-core (extra [usd]).

References
----------
OpenUSD, UsdPreviewSurface specification (normal maps: scale 2, bias -1, raw); UsdMtlx.
"""

import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polcap.errors import package_for
from polcap.formats import atomic
from polcap.formats.export import gltf, materialx
from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.mesh_values import Asset, Mesh
from polcap.optics import fresnel

_FIXED_TIME = 473_385_600  # s, 1985: times of the files in a USDZ, so that the same asset gives the same bytes


def require() -> None:
    """Raise a SettingError if the package usd-core is not installed."""
    presets = "USD, and with it --preset archive, maya or houdini,"
    with package_for(presets, "usd-core", "usd", ", or name other formats"):
        from pxr import Usd  # noqa: F401


def write(path: Path, asset: Asset, name: str, files: Mapping[Key, str], facts: Mapping[str, str]) -> None:
    """Write an asset as a USD layer (.usdc or .usda); its textures `files` are in the same folder.

    `facts` go into the layer's custom data. Raises SettingError: usd-core is not installed.
    """
    _export(_stage(asset, name, files, facts, phone=False), path)


def package(path: Path, asset: Asset, name: str, textures: Mapping[Key, bytes], facts: Mapping[str, str]) -> None:
    """Write a USDZ, one file that holds the layer and its textures (PNG); otherwise as `write`."""
    require()
    from pxr import Sdf, UsdUtils

    files: dict[Key, str] = {key: f"{key}.png" for key in textures}
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"{materialx.identifier(name)}.usdc"
        for key, file in files.items():
            (layer.parent / file).write_bytes(textures[key])
        _export(_stage(asset, name, files, facts, phone=True), layer)
        for part in layer.parent.iterdir():
            os.utime(part, (_FIXED_TIME, _FIXED_TIME))  # the package holds these times
        with atomic.path(path) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(temporary)):
                raise OSError(f"usd-core could not write {path.name}")


def _export(stage: Any, path: Path) -> None:
    """Write a stage as a layer. Raises StorageError: usd-core cannot, or as `atomic.path`."""
    with atomic.path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"usd-core could not export {path.name}")


def _stage(asset: Asset, name: str, files: Mapping[Key, str], facts: Mapping[str, str], phone: bool) -> Any:
    """The stage with mesh and materials; for a phone, with UsdPreviewSurface in the specular workflow only."""
    require()
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().customLayerData = {"polcap": dict(facts)}
    root = UsdGeom.Xform.Define(stage, f"/{materialx.identifier(name)}")
    Usd.ModelAPI(root).SetKind("component")
    stage.SetDefaultPrim(root.GetPrim())
    root_name = root.GetPath().name
    shape = _mesh(stage, root.GetPath().AppendChild(f"{root_name}_mesh"), asset.mesh)
    binding = UsdShade.MaterialBindingAPI.Apply(shape.GetPrim())
    path = root.GetPath().AppendChild(f"{root_name}_material")
    material = UsdShade.Material.Define(stage, path)
    material.CreateSurfaceOutput().ConnectToSource(_preview(stage, path, asset, files, tint=False))
    binding.Bind(material)
    if not phone:
        _add_openpbr(stage, material, asset, files)
        full = UsdShade.Material.Define(stage, root.GetPath().AppendChild(f"{root_name}_material_full"))
        full.CreateSurfaceOutput().ConnectToSource(_preview(stage, full.GetPath(), asset, files, tint=True))
        _add_openpbr(stage, full, asset, files)
        binding.Bind(full, materialPurpose=UsdShade.Tokens.full)
    return stage


def _mesh(stage: Any, path: Any, mesh: Mesh) -> Any:
    """Define a mesh with texture coordinates on a USD stage; its origin is that of the GLB."""
    from pxr import Sdf, UsdGeom, Vt

    shape = UsdGeom.Mesh.Define(stage, path)
    points = (mesh.vertices - gltf.center(mesh.vertices)).astype(np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, dtype=np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.reshape(-1).astype(np.int32)))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, dtype=np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(gltf.is_open(mesh))
    uv = (mesh.uv * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32)  # USD counts v upwards
    coordinates = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray.FromNumpy(uv))
    return shape


def _add_openpbr(stage: Any, material: Any, asset: Asset, files: Mapping[Key, str]) -> None:
    """Add the OpenPBR surface to a material, for renderers that read MaterialX."""
    from pxr import Sdf

    material.GetPrim().AddAppliedSchema("MaterialXConfigAPI")  # of UsdMtlx, which not every usd-core has
    version = material.GetPrim().CreateAttribute("config:mtlx:version", Sdf.ValueTypeNames.String, custom=False)
    version.Set(materialx.VERSION)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(_openpbr(stage, material.GetPath(), asset, files))


def _openpbr(stage: Any, path: Any, asset: Asset, files: Mapping[Key, str]) -> Any:
    """Add the OpenPBR material (the nodes of the MaterialX document) as USD shaders; returns the surface output."""
    from pxr import Sdf, UsdShade

    kinds = Sdf.ValueTypeNames
    numbers = {"color3": kinds.Color3f, "vector3": kinds.Float3}
    types: dict[str, tuple[Any, Callable[[str], Any]]] = {
        "float": (kinds.Float, float),
        "integer": (kinds.Int, int),
        "string": (kinds.String, str),
        "filename": (kinds.Asset, "./{}".format),
        "surfaceshader": (kinds.Token, str),
        **{name: (kind, lambda text: tuple(map(float, text.split(",")))) for name, kind in numbers.items()},
    }
    outputs: dict[str, Any] = {}
    for node in ElementTree.fromstring(materialx.document(asset, "material", files, "")):
        if node.tag == "surfacematerial":
            break
        name = node.attrib["name"]
        shader = UsdShade.Shader.Define(stage, path.AppendChild(f"mtlx_{name}"))
        shader.CreateIdAttr(node.attrib["nodedef"])
        for source in node:
            kind, parse = types[source.attrib["type"]]
            target = shader.CreateInput(source.attrib["name"], kind)
            if "nodename" in source.attrib:
                target.ConnectToSource(outputs[source.attrib["nodename"]])
            else:
                target.Set(parse(source.attrib["value"]))
            if "colorspace" in source.attrib:
                target.GetAttr().SetColorSpace(source.attrib["colorspace"])
        outputs[name] = shader.CreateOutput("out", types[node.attrib["type"]][0])
    return outputs[name]


def _preview(stage: Any, path: Any, asset: Asset, files: Mapping[Key, str], tint: bool) -> Any:
    """Add a UsdPreviewSurface material; its F0 comes from a texture in the specular workflow.

    With `tint` it is in the metallic workflow, and the texture is F0 divided by the F0 of the index.
    """
    from pxr import Sdf, UsdShade

    kinds = Sdf.ValueTypeNames
    surface = UsdShade.Shader.Define(stage, path.AppendChild("preview"))
    surface.CreateIdAttr("UsdPreviewSurface")
    reader = UsdShade.Shader.Define(stage, path.AppendChild("preview_st"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    st = reader.CreateOutput("result", kinds.Float2)
    f0_scale = SPECULAR_RANGE / (float(fresnel.normal_reflectance(asset.ior)) if tint else 1.0)
    color = "raw" if files["basecolor"].endswith(".exr") else "sRGB"
    textures: tuple[tuple[Key, str, Any, str, str, Any, Any], ...] = (  # file, input, type, channel, space, scale, bias
        ("basecolor", "diffuseColor", kinds.Color3f, "rgb", color, None, None),
        ("specular", "specularColor", kinds.Color3f, "rgb", color, (f0_scale, f0_scale, f0_scale, 1.0), None),
        ("roughness", "roughness", kinds.Float, "r", "raw", None, None),
        ("normal", "normal", kinds.Normal3f, "rgb", "raw", (2.0, 2.0, 2.0, 1.0), (-1.0, -1.0, -1.0, 0.0)),
    )
    for key, target, kind, channel, space, scale, bias in textures:
        texture = UsdShade.Shader.Define(stage, path.AppendChild(f"preview_{key}"))
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(f"./{files[key]}")
        texture.CreateInput("st", kinds.Float2).ConnectToSource(st)
        texture.CreateInput("sourceColorSpace", kinds.Token).Set(space)
        for axis in "ST":
            texture.CreateInput(f"wrap{axis}", kinds.Token).Set("clamp")
        for word, numbers in (("scale", scale), ("bias", bias)):
            if numbers is not None:
                texture.CreateInput(word, kinds.Float4).Set(numbers)
        output = texture.CreateOutput(channel, kinds.Float if channel == "r" else kinds.Float3)
        surface.CreateInput(target, kind).ConnectToSource(output)
    surface.CreateInput("useSpecularWorkflow", kinds.Int).Set(0 if tint else 1)
    surface.CreateInput("ior", kinds.Float).Set(float(asset.ior))
    return surface.CreateOutput("surface", kinds.Token)
