"""Presets of `polcap export`: file formats, file names, channel packing and normal-map direction for a program."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:  # the command line needs the names before NumPy is imported
    from polcap.formats.export.encoders import Kind
    from polcap.formats.export.glb_geometry import Geometry
    from polcap.formats.export.texture_set import Extra

Format = Literal["gltf", "obj", "ply", "stl", "usd", "usdz", "materialx", "exr", "iiif", "sfp"]
FORMATS: tuple[Format, ...] = get_args(Format)
EXTRAS: tuple[Extra, ...] = ("displacement", "curvature", "cavity", "occlusion", "object-normal")
_OF_ENGINES = 20_000  # triangles; the full mesh is within a map pixel: docs/benchmarks/exports.md


@dataclass(frozen=True)
class ExportPreset:
    """The files that one export writes for one program; in file names, {} is replaced by the asset's name."""

    description: str
    formats: tuple[Format, ...] = ("gltf",)
    name: str = "{}"  # of the asset itself
    images: Kind = "png"  # inside the GLB
    geometry: Geometry = "float"  # inside the GLB
    powers: bool = False  # sides of the textures are powers of two, as engines compress and mipmap them
    gathers: bool = False  # maps, report and color profile too, with a list of digests
    triangles: int | None = None  # at most; by default those of the full mesh
    bits: Literal[8, 16] = 8  # of a texture's channel
    shared: Literal["png", "exr"] = "png"  # files of the textures of OBJ, USD and MaterialX
    extras: tuple[Extra, ...] = ()  # channels to compute; `--extra` also writes each as a file
    textures: Mapping[str, str] = field(default_factory=dict)  # PNG files next to the asset: `texture_set.TEXTURES`


_OF_FILMS = ExportPreset(
    "", ("usd", "materialx"), bits=16, shared="exr", extras=("displacement",),
    textures={"{}_displacement": "displacement"},
)  # fmt: skip
PRESETS: Mapping[str, ExportPreset] = {
    "blender": ExportPreset(
        description="File > Import > glTF, or polcap's extension for camera, flash and photograph; normals +Y",
    ),
    "unreal": ExportPreset(
        description="Interchange imports the GLB (normals +Y); the loose T_*_N is -Y, as Unreal's materials need it",
        name="SM_{}",
        powers=True,
        triangles=_OF_ENGINES,
        textures={
            "T_{}_BC": "base_color",
            "T_{}_N": "normal_directx",
            "T_{}_ORM": "occlusion_roughness_metallic",
            "T_{}_S": "specular_level",
        },
    ),
    "unity": ExportPreset(
        description="glTFast imports the GLB; loose maps for HDRP and for the specular set-ups of URP; normals +Y",
        powers=True,
        triangles=_OF_ENGINES,
        textures={
            "{}_BaseMap": "base_color",
            "{}_Normal": "normal",
            "{}_MaskMap": "unity_mask",
            "{}_SpecularMap": "unity_specular",
        },
    ),
    "godot": ExportPreset(
        description="import the GLB, then set Specular; loose maps for an ORMMaterial3D; normals +Y (OpenGL)",
        powers=True,
        triangles=_OF_ENGINES,
        textures={"{}_albedo": "base_color", "{}_orm": "occlusion_roughness_metallic", "{}_normal": "normal"},
    ),
    "web": ExportPreset(
        description="one small GLB: quantized mesh; colors lossy, data lossless WebP (EXT_texture_webp); normals +Y",
        images="webp",
        geometry="quantized",
        triangles=50_000,
    ),
    "substance": ExportPreset(
        description="import the GLB as the mesh, and the loose maps into a material; normals +Y (OpenGL)",
        bits=16,
        extras=("displacement", "occlusion"),
        textures={
            "{}_basecolor": "base_color",
            "{}_normal": "normal",
            "{}_roughness": "roughness",
            "{}_specularlevel": "specular_level",
            "{}_height": "displacement",
            "{}_ambientocclusion": "occlusion",
        },
    ),
    "maya": replace(
        _OF_FILMS,
        description="File > Import > USD, or LookdevX for the MaterialX document; linear EXR textures; normals +Y",
    ),
    "houdini": replace(
        _OF_FILMS,
        description="Sublayer or Reference LOP for Karma and other renderers; linear EXR textures; normals +Y",
    ),
    "archive": ExportPreset(
        formats=("gltf", "obj", "usd", "materialx", "exr"),
        description="every format, maps and report, with digests; textures of 16 bits; normals +Y",
        gathers=True,
        bits=16,
    ),
}
