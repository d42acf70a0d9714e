"""Stage 10: textures and factors of a glTF material, from maps and mesh.

References
----------
Khronos, glTF 2.0 §3.9 (materials) and KHR_materials_specular.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal, Protocol

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.image_values import Bools, Floats, TexturePixels
from polcap.mesh_values import Asset, Mesh
from polcap.optics import color, frames, fresnel
from polcap.optics.morphology import dilate, erode
from polcap.optics.outline import fill_outward
from polcap.optics.resize import area_mean
from polcap.optics.texture_rasterizer import rasterize_frames
from polcap.stage_values import SurfaceMaps
from polcap.stages import stage
from polcap.stages.asset.ambient_occlusion import ambient_occlusion

Bits = Literal[8, 16]  # of a texture's channel
_EXTRAS = ("displacement", "curvature", "object_normal")
_CURVATURE_SIGMA_PX, _CURVATURE_RANGE = 1.0, 10.0  # 1σ of the smoothing; curvature of white, times object's radius
_LEAST_Z = 0.05  # of a tangent-space normal, which must leave the surface (glTF: blue above one half)


class TextureMaps(Protocol):
    """Appearance of a surface on a pixel grid, as an asset's textures need it: `SurfaceMaps` or an atlas."""

    @property
    def normal(self) -> Floats: ...  # (H, W, 3) unit, in the mesh's frame
    @property
    def diffuse(self) -> Floats: ...  # (H, W, 3) albedo ρ_d, linear Rec.709
    @property
    def specular(self) -> Floats: ...  # (H, W, 3) F0, linear Rec.709
    @property
    def roughness(self) -> Floats: ...  # (H, W) perceptual, α = roughness²
    @property
    def mask(self) -> Bools: ...  # (H, W)
    @property
    def albedo_sigma(self) -> float | None: ...  # relative 1σ of the scale of all albedos; None: unknown
    @property
    def detail(self) -> Floats | None: ...  # (2H, 2W) float16, ln of the albedo of RAW pixels over `diffuse`


class AssetSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `asset`, the section `asset` of a settings file."""

    ior: Annotated[
        float, Meta(ge=1.1, le=2.5, description="refractive index written to the asset; F0 does not depend on it [1]")
    ] = 1.5
    raw_pixels: Annotated[
        bool, Meta(description="base color at the RAW's pixels where they show printed detail, for Bayer cameras")
    ] = True


@stage(version=4, keep=False)
def build(maps: TextureMaps, mesh: Mesh, settings: AssetSettings, bits: Bits = 8) -> Asset:
    """Build the object's glTF textures (H, W, 3) on the maps' grid, filled outwards so that no seam shows.

    In the maps' material, diffuse light passes two Fresnel transmissions; glTF's has base·(1 − F). With base =
    ρ_d T₊(0)²/(1 − F0) both agree for a surface seen from the front. glTF's F0 is that of the index × factor × texture;
    the factor is the greatest value of the map.

    The outermost pixels of the object mix with the backdrop, so they are filled from further inside. If the maps have
    detail of the RAW pixels, the base color has twice their size (2H, 2W, 3).
    """
    specular = np.clip(maps.specular, 0.0, 1.0)
    f0 = specular.max(axis=-1)
    most_f0 = float(f0[maps.mask].max(initial=0.0))
    transmittance, _ = fresnel.transmission(np.float64(1.0), settings.ior)
    roughness, known = _integers(maps.roughness, bits), _without_outline(maps.mask)
    full = np.full_like(roughness, np.iinfo(roughness.dtype).max)  # no occlusion
    detail = maps.detail if settings.raw_pixels else None
    base = maps.diffuse * np.float32(transmittance**2) / (1 - np.minimum(f0, 0.99))[..., None]
    base = fill_outward(base.astype(np.float32), known)
    others = [
        np.stack([full, roughness, np.zeros_like(roughness)], axis=-1),
        _srgb(specular / max(most_f0, 1e-9), bits),
    ]
    filled = fill_outward(np.concatenate(others, axis=-1), known)
    packed, specular_color = (np.ascontiguousarray(filled[..., k : k + 3]) for k in (0, 3))
    return Asset(
        mesh=mesh,
        base_color=_srgb(base, bits) if detail is None else _with_detail(base, detail, bits),
        occlusion_roughness_metallic=packed,
        normal=_integers(tangent_space(maps, mesh) / 2 + 0.5, bits),
        specular_color=specular_color,
        specular_factor=(most_f0 / float(fresnel.normal_reflectance(settings.ior)),) * 3,
        ior=settings.ior,
        albedo_sigma=maps.albedo_sigma,
    )


def _with_detail(albedo: Floats, detail: Floats, bits: Bits) -> TexturePixels:
    """An albedo (H, W, 3), enlarged linearly, times the exponential of its detail (2H, 2W); sRGB."""
    factor = np.exp(detail, dtype=np.float32)
    planes = [_srgb(cv2.resize(plane, detail.shape[::-1]) * factor, bits) for plane in cv2.split(albedo)]
    return np.asarray(cv2.merge(planes))


def with_mesh(asset: Asset, maps: TextureMaps, mesh: Mesh) -> Asset:
    """A copy of the asset with another mesh of the same maps, and the normal texture that fits this mesh."""
    return replace(asset, mesh=mesh, normal=_integers_like(asset.normal, tangent_space(maps, mesh) / 2 + 0.5))


def with_extras(asset: Asset, maps: SurfaceMaps, depth: Floats, occlusion: bool) -> Asset:
    """The asset with displacement, curvature and object-space normals and, if asked for, ambient occlusion.

    `depth` (H, W) is along the optical axis, NaN outside the mask.
    """
    near, far = float(np.nanmin(depth)), float(np.nanmax(depth))
    height = np.where(maps.mask, (far - depth) / max(far - near, 1e-12), 0.0)
    filled = fill_outward(np.concatenate([height[..., None], maps.normal / 2 + 0.5], axis=-1), maps.mask)
    packed = asset.occlusion_roughness_metallic.copy()
    if occlusion:
        packed[..., 0] = _integers_like(packed, ambient_occlusion(maps, depth))
    return replace(
        asset,
        occlusion_roughness_metallic=packed,
        displacement=_integers(np.ascontiguousarray(filled[..., 0]), 16),
        curvature=_integers(curvature(maps), 16),
        object_normal=_integers_like(asset.normal, filled[..., 1:]),
    )


def turn(asset: Asset, angle_deg: int) -> Asset:
    """The asset turned counter-clockwise about the optical axis, by a multiple of 90°, with its object-space normals.

    Textures stay as the maps are: their coordinates and tangents belong to the mesh.
    """
    if angle_deg == 0:
        return asset
    cosine, sine = np.rint([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    mesh, rotation = asset.mesh, np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    tangents = np.concatenate([mesh.tangents[:, :3] @ rotation.T, mesh.tangents[:, 3:]], axis=1)
    turned = {"vertices": mesh.vertices @ rotation.T, "normals": mesh.normals @ rotation.T, "tangents": tangents}
    fields = {name: value.astype(getattr(mesh, name).dtype) for name, value in turned.items()}
    normal = asset.object_normal
    if normal is not None:
        normal = _integers_like(normal, (2 * (normal / np.iinfo(normal.dtype).max) - 1) @ rotation.T / 2 + 0.5)
    return replace(asset, mesh=replace(mesh, **fields), object_normal=normal, turned_deg=asset.turned_deg + angle_deg)


def curvature(maps: SurfaceMaps) -> Floats:
    """Mean curvature (H, W) from the normals: ½ where flat, 1 convex and 0 concave with a tenth of the object's radius.

    The surface is a graph over the picture, so its mean curvature is half the divergence of the normals' x and y. The
    object's radius is half the longer side of its outline.

    References
    ----------
    do Carmo, Differential Geometry of Curves and Surfaces, §3.3 (mean curvature of a graph).
    """
    normal = cv2.GaussianBlur(fill_outward(maps.normal, maps.mask), (0, 0), _CURVATURE_SIGMA_PX)
    across = np.gradient(normal[..., 0], axis=1) - np.gradient(normal[..., 1], axis=0)  # rows count downwards
    radius = max(np.ptp(np.flatnonzero(maps.mask.any(axis=axis))) + 1 for axis in (0, 1)) / 2
    scaled = np.where(_without_outline(maps.mask), across / 2 * radius / _CURVATURE_RANGE, 0)
    return np.asarray(np.clip(0.5 + scaled / 2, 0, 1))


def resize_textures(asset: Asset, size: int) -> Asset:
    """A copy of the asset with textures of `size` px on the longer side, and a power of two on the other.

    Smaller textures are area means. Larger ones are interpolated and have no more detail.
    """
    height, width = asset.normal.shape[:2]
    shorter = max(size * min(height, width) / max(height, width), 1.0)
    other = min(size, 1 << int(np.ceil(np.log2(shorter))))
    shape = (other, size) if width >= height else (size, other)
    return _with_sizes(asset, lambda texture: shape)


def shrink_textures(asset: Asset, factor: int) -> Asset:
    """A copy of the asset whose textures have 1/`factor` of their width and height."""
    return _with_sizes(asset, lambda texture: (-(-texture.shape[0] // factor), -(-texture.shape[1] // factor)))


def to_powers_of_two(asset: Asset, factor: int = 1) -> Asset:
    """A copy of the asset whose textures have powers of two as width and height, divided by `factor`.

    A side becomes the next power of two, or the one below if that is at most 16 % smaller.
    """

    def power(side: int) -> int:
        return max(int(2 ** np.round(np.log2(side) + 0.25)) // factor, 1)

    return _with_sizes(asset, lambda texture: (power(texture.shape[0]), power(texture.shape[1])))


def _with_sizes(asset: Asset, shape: Callable[[TexturePixels], tuple[int, int]]) -> Asset:
    """A copy of the asset with each texture in the size (height, width) that `shape` returns for it."""
    textures: dict[str, Any] = {}
    for name in ("base_color", "occlusion_roughness_metallic", "normal", "specular_color", *_EXTRAS):
        before = getattr(asset, name)
        if before is not None:
            value = _resize(before, shape(before)) / np.iinfo(before.dtype).max
            value = frames.unit(2 * value - 1) / 2 + 0.5 if name.endswith("normal") else value
            textures[name] = _integers_like(before, value)
    return replace(asset, **textures)


def _resize(texture: TexturePixels, shape: tuple[int, int]) -> Floats:
    """Resize a texture (H, W[, 3]): by area means if both sides shrink, else by cubic interpolation."""
    image = texture.astype(np.float32)
    if shape[0] <= image.shape[0] and shape[1] <= image.shape[1]:
        return area_mean(image, shape)
    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_CUBIC))


def _without_outline(mask: Bools) -> Bools:
    """Erode a mask by its outermost pixels, except for parts that would vanish."""
    inner = erode(mask, 1, from_border=True)
    return np.asarray(inner | (mask & ~dilate(inner, 2)))


def tangent_space(maps: TextureMaps, mesh: Mesh) -> Floats:
    """Convert the maps' normals to the tangent space of the mesh: (H, W, 3) unit vectors, z > 0.

    A vector (x, y, z) means the normal x t + y b + z n, with tangent, bitangent and normal of the mesh at this pixel.
    """
    frame, covered = rasterize_frames(mesh, *maps.mask.shape)
    frame, covered = frame[maps.mask[covered]], covered & maps.mask
    # n and t are interpolated separately, so they are neither unit nor orthogonal: solve, do not project
    n, t = frames.unit(frame[:, :3]), frames.unit(frame[:, 3:6])
    b = frames.cross(n, t) * np.where(frame[:, 6:] < 0, np.float32(-1), np.float32(1))
    m = maps.normal[covered]
    across = frames.cross(t, b)
    local = np.stack([frames.dot(m, v) for v in (frames.cross(b, n), frames.cross(n, t), across)], axis=-1)
    local /= frames.dot(n, across)[:, None]
    local[:, 2] = np.maximum(local[:, 2], _LEAST_Z)
    out = np.zeros((*covered.shape, 3), np.float32)
    out[..., 2] = 1.0
    out[covered] = frames.unit(local)
    return np.asarray(fill_outward(out, covered))


def _integers(value: Floats, bits: Bits) -> TexturePixels:
    """Values 0…1 as integers of 8 or 16 bits."""
    return np.asarray(np.rint(np.clip(value, 0.0, 1.0) * (2**bits - 1)), dtype=np.uint8 if bits == 8 else np.uint16)


def _integers_like(texture: TexturePixels, value: Floats) -> TexturePixels:
    """Values 0…1 as integers of the type of `texture`."""
    return _integers(value, 8 if texture.dtype == np.uint8 else 16)


def _srgb(linear: Floats, bits: Bits) -> TexturePixels:
    """Linear Rec.709 as sRGB-encoded integers."""
    return color.srgb_eight_bits(linear) if bits == 8 else _integers(color.encode_srgb(np.clip(linear, 0, 1)), bits)
