"""Makes the textures of an asset, with channels packed as each kind of program expects.

Each has a sentence on the meaning of its channels, which goes into the file, into maps.json and into the material.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from polcap.formats.maps import exr
from polcap.image_values import Floats, TexturePixels
from polcap.mesh_values import Asset
from polcap.optics import color, fresnel

SPECULAR_RANGE = 0.08  # F0 of white in the loose specular textures: Disney's, Blender's and Unreal's "specular"

Key = Literal["basecolor", "roughness", "normal", "specular"]  # the texture files of OBJ, USD and MaterialX
Extra = Literal["displacement", "occlusion", "object-normal", "curvature", "cavity"]  # computed on request


@dataclass(frozen=True)
class Texture:
    """A texture image, whether it is color or data, and a sentence on the meaning of its channels."""

    pixels: TexturePixels  # (H, W), (H, W, 3) or (H, W, 4)
    color: bool  # sRGB-encoded color; else numbers
    meaning: str


def base_color(asset: Asset) -> Texture:
    """Base color texture: diffuse color as glTF defines it."""
    return Texture(asset.base_color, color=True, meaning="base color, sRGB-encoded Rec.709")


def normal(asset: Asset) -> Texture:
    """Tangent-space normals with green up (OpenGL)."""
    return Texture(asset.normal, color=False, meaning="tangent-space normal n * 0.5 + 0.5, +Y (OpenGL, green up)")


def normal_directx(asset: Asset) -> Texture:
    """Tangent-space normals with green down (DirectX)."""
    flipped = asset.normal.copy()
    flipped[..., 1] = np.iinfo(flipped.dtype).max - flipped[..., 1]
    return Texture(flipped, color=False, meaning="tangent-space normal n * 0.5 + 0.5, -Y (DirectX, green down)")


def roughness(asset: Asset) -> Texture:
    """Roughness texture in one channel, taken from the packed texture."""
    meaning = "perceptual roughness (GGX alpha = roughness squared), linear"
    return Texture(np.ascontiguousarray(asset.occlusion_roughness_metallic[..., 1]), color=False, meaning=meaning)


def displacement(asset: Asset) -> Texture:
    """Height of the surface towards the camera."""
    assert asset.displacement is not None
    meaning = "height, linear: 0 at depth.far of maps.json, 1 at depth.near"
    return Texture(asset.displacement, color=False, meaning=meaning)


def curvature(asset: Asset) -> Texture:
    """Mean curvature of the surface, for masks of edges and pits."""
    assert asset.curvature is not None
    meaning = "mean curvature, linear: 0.5 flat, 1 convex and 0 concave with a tenth of the object's radius or less"
    return Texture(asset.curvature, color=False, meaning=meaning)


def cavity(asset: Asset) -> Texture:
    """The concave part of the curvature, for dirt and shade in pits."""
    assert asset.curvature is not None
    top = np.iinfo(asset.curvature.dtype).max
    dark = np.minimum(2 * asset.curvature.astype(np.uint32), top).astype(asset.curvature.dtype)
    meaning = "cavities, linear: 1 flat or convex, 0 concave with a tenth of the object's radius or less"
    return Texture(dark, color=False, meaning=meaning)


def occlusion(asset: Asset) -> Texture:
    """The ambient-occlusion channel of the packed texture."""
    meaning = "ambient occlusion, linear: share of a uniform sky that is visible"
    return Texture(np.ascontiguousarray(asset.occlusion_roughness_metallic[..., 0]), color=False, meaning=meaning)


def object_normal(asset: Asset) -> Texture:
    """Normals in the frame of the mesh: that of the camera, or of a fused object."""
    assert asset.object_normal is not None
    axes = "R right, G up, B toward the camera" if asset.mesh.frame == "camera" else "R x, G y (up), B z of the mesh"
    return Texture(asset.object_normal, color=False, meaning=f"object-space normal n * 0.5 + 0.5: {axes}")


def occlusion_roughness_metallic(asset: Asset) -> Texture:
    """Texture of occlusion (R), roughness (G) and metallic (B), as glTF packs them."""
    meaning = f"R {_occlusion(asset)}, G perceptual roughness, B metallic (0); linear"
    return Texture(asset.occlusion_roughness_metallic, color=False, meaning=meaning)


def relative_specular(asset: Asset) -> Texture:
    """Specular color texture for KHR_materials_specular: F0 divided by the asset's specular factor."""
    meaning = f"F0 over {asset.specular_factor[0] * _index_reflectance(asset):.5g}, sRGB-encoded"
    return Texture(asset.specular_color, color=True, meaning=meaning)


def specular(asset: Asset) -> Texture:
    """Color texture of F0 (reflectance at normal incidence) on a fixed scale, the same for all assets."""
    meaning = f"F0 / {SPECULAR_RANGE:g}, sRGB-encoded; F0 beyond {SPECULAR_RANGE:g} is clipped"
    values = np.arange(np.iinfo(asset.specular_color.dtype).max + 1, dtype=asset.specular_color.dtype)
    table = replace(asset, specular_color=np.repeat(values[:, None], 3, axis=1))  # all values of a channel
    encoded = _quantized(color.encode_srgb(_level(table)), values)
    channels = [encoded[asset.specular_color[..., c], c] for c in range(3)]
    return Texture(np.stack(channels, axis=-1), color=True, meaning=meaning)


def specular_level(asset: Asset) -> Texture:
    """Gray texture of the luminance of F0 on a fixed scale, the same for all assets."""
    meaning = f"specular level: F0 / {SPECULAR_RANGE:g}, linear; F0 beyond {SPECULAR_RANGE:g} is clipped"
    return Texture(_quantized(color.luminance(_level(asset)), asset.specular_color), color=False, meaning=meaning)


def unity_mask(asset: Asset) -> Texture:
    """Mask map of Unity's HDRP: metallic, occlusion, detail mask and smoothness."""
    orm = asset.occlusion_roughness_metallic
    top = np.iinfo(orm.dtype).max
    channels = [orm[..., 2], orm[..., 0], np.zeros_like(orm[..., 0]), top - orm[..., 1]]
    smooth = "A smoothness = 1 - perceptual roughness"
    meaning = f"R metallic (0), G {_occlusion(asset)}, B detail mask (0), {smooth}; linear"
    return Texture(np.stack(channels, axis=-1), color=False, meaning=meaning)


def unity_specular(asset: Asset) -> Texture:
    """Specular map for Unity's specular workflow (Standard, URP, HDRP): F0 in RGB, smoothness in alpha."""
    rough = asset.occlusion_roughness_metallic[..., 1:2]
    smooth = 1 - rough / np.float64(np.iinfo(rough.dtype).max)
    reflected = color.encode_srgb(np.clip(reflectance(asset), 0.0, 1.0))
    meaning = "RGB F0, sRGB-encoded; A smoothness = 1 - perceptual roughness, linear"
    packed = _quantized(np.concatenate([reflected, smooth], axis=-1), asset.specular_color)
    return Texture(packed, color=True, meaning=meaning)


LOOSE: Mapping[Key, Callable[[Asset], Texture]] = {  # in files of their own
    "basecolor": base_color,
    "roughness": roughness,
    "normal": normal,
    "specular": specular,
}


_OF_PRESETS = (
    base_color, normal, normal_directx, roughness, displacement, curvature, cavity, occlusion, object_normal,
    occlusion_roughness_metallic, specular_level, unity_mask, unity_specular,
)  # fmt: skip
TEXTURES = {make.__name__: make for make in _OF_PRESETS}  # by the name that presets give


def with_linear_meaning(texture: Texture) -> Texture:
    """The texture with the meaning that its values get in `write_exr`; the values stay encoded."""
    return replace(texture, meaning=texture.meaning.replace("sRGB-encoded", "linear"))


def write_exr(path: Path, texture: Texture, entry: Mapping[str, str] = {}) -> None:
    """Write a texture as an EXR of half floats, in linear Rec.709, with a catalog entry. Raises StorageError."""
    value = texture.pixels / np.float32(np.iinfo(texture.pixels.dtype).max)
    planes = np.moveaxis(np.atleast_3d(color.decode_srgb(value) if texture.color else value), -1, 0)
    names = "Y" if len(planes) == 1 else "RGBA"
    exr.write(path, dict(zip(names, planes)), exr.described({"meaning": texture.meaning, **entry}), half=True)


def reflectance(asset: Asset) -> Floats:
    """F0 (reflectance at normal incidence) of each texel, (H, W, 3), linear."""
    relative = color.decode_srgb(asset.specular_color / np.float64(np.iinfo(asset.specular_color.dtype).max))
    return np.asarray(relative * np.array(asset.specular_factor) * _index_reflectance(asset))


def _occlusion(asset: Asset) -> str:
    return "ambient occlusion" if asset.has_occlusion else "occlusion (1 everywhere)"


def _index_reflectance(asset: Asset) -> float:
    """F0 that follows from the asset's refractive index."""
    return float(fresnel.normal_reflectance(asset.ior))


def _level(asset: Asset) -> Floats:
    """F0 of each texel divided by a fixed full-scale value, 0…1, (H, W, 3)."""
    return np.asarray(np.clip(reflectance(asset) / SPECULAR_RANGE, 0.0, 1.0))


def _quantized(value: Floats, like: TexturePixels) -> TexturePixels:
    """Integers of the type of `like` from values 0…1 of any shape."""
    return np.rint(value * np.iinfo(like.dtype).max).astype(like.dtype)
