"""Stage 10: turn maps and mesh into what a glTF renderer wants.

References
----------
Khronos, glTF 2.0 §3.9 (materials) and KHR_materials_specular.
"""

from dataclasses import replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy import ndimage

from polcap.images import Asset, Floats, Mesh, SurfaceMaps
from polcap.optics import color, frames, fresnel
from polcap.stages import stage

_LEAST_UP = 0.05  # a tangent-space normal must leave the surface (glTF: blue above one half)


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `asset` of a settings file."""

    ior: Annotated[
        float, Meta(ge=1.1, le=2.5, description="refractive index written to the asset; F0 is kept whatever it is [1]")
    ] = 1.5


@stage(version=2, keep=False)
def build(maps: SurfaceMaps, mesh: Mesh, settings: Settings) -> Asset:
    """Textures on the crop's grid, filled outwards from the object so that no seam shows.

    The outermost pixels, which the backdrop shines into, are filled too, so that it does not run along the limb.

    Ours is a diffuse term behind two Fresnel transmissions, glTF's is base·(1 − F): base =
    ρ_d T₊(0)²/(1 − F0) makes the frontal looks agree. F0 = 0.04-like · factor · texture, the factor
    holding the map's greatest value. The mesh has already bent the light as its own normals do, so
    the normal texture holds what is left: the map's normals in the mesh's interpolated tangent frame.
    """
    nearest = _nearest(_unmixed(maps.mask))
    specular = np.clip(maps.specular, 0.0, 1.0)
    entry, _ = fresnel.transmission(np.float64(1.0), settings.ior)
    base = maps.diffuse * entry**2 / (1 - np.minimum(specular.max(axis=-1, keepdims=True), 0.99))
    top = float(specular[maps.mask].max(initial=0.0))
    roughness = _eight_bits(maps.roughness)
    full, none = np.full_like(roughness, 255), np.zeros_like(roughness)
    return Asset(
        mesh=mesh,
        base_color=_eight_bits(color.encode_srgb(np.clip(base, 0.0, 1.0)))[nearest],
        occlusion_roughness_metallic=np.stack([full, roughness, none], axis=-1)[nearest],
        normal=_eight_bits(tangent_space(maps, mesh) / 2 + 0.5),
        specular_color=_eight_bits(color.encode_srgb(specular / max(top, 1e-9)))[nearest],
        specular_factor=(top / float(fresnel.normal_reflectance(settings.ior)),) * 3,
        ior=settings.ior,
    )


def resized(asset: Asset, size: int) -> Asset:
    """The asset with textures whose longer side is `size` px and whose other is the next power of two that holds it.

    Smaller ones are means over what each pixel covers; a larger one holds no more detail than was photographed.
    """
    height, width = asset.normal.shape[:2]
    shorter = size * min(height, width) / max(height, width)
    other = min(size, 1 << int(np.ceil(np.log2(shorter))))
    wide, tall = (size, other) if width >= height else (other, size)
    base, orm, normal, specular = (
        _scaled(one, wide, tall)
        for one in (asset.base_color, asset.occlusion_roughness_metallic, asset.normal, asset.specular_color)
    )
    return replace(
        asset,
        base_color=_eight_bits(base / 255),
        occlusion_roughness_metallic=_eight_bits(orm / 255),
        normal=_eight_bits(_unit(normal / 127.5 - 1) / 2 + 0.5),
        specular_color=_eight_bits(specular / 255),
    )


def _scaled(texture: NDArray[np.uint8], width: int, height: int) -> Floats:
    """(height, width, 3) of 0…255, by area where both sides shrink, else by cubic interpolation."""
    shrinks = width <= texture.shape[1] and height <= texture.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(texture.astype(np.float32), (width, height), interpolation=how))


def tangent_space(maps: SurfaceMaps, mesh: Mesh) -> Floats:
    """The maps' normals as x t + y b + z n of the mesh's frame at each pixel, (H, W, 3) unit, z > 0."""
    height, width = maps.mask.shape
    frame, covered = _interpolated(mesh, height, width)
    covered &= maps.mask
    there = frame[covered]  # (N, 7)
    n, t = _unit(there[:, :3]), _unit(there[:, 3:6])
    b = frames.cross(n, t) * np.where(there[:, 6:] < 0, -1.0, 1.0)
    # n and t are each interpolated, so not quite square to each other: solve, do not project
    volume = frames.dot(t, frames.cross(b, n))
    m = maps.normal[covered].astype(np.float64)
    local = np.stack([frames.dot(m, frames.cross(*pair)) / volume for pair in ((b, n), (n, t), (t, b))], axis=-1)
    local[:, 2] = np.maximum(local[:, 2], _LEAST_UP)
    whole = np.zeros((height, width, 3))
    whole[..., 2] = 1.0
    whole[covered] = _unit(local)
    return np.asarray(whole[_nearest(covered)])


def _interpolated(mesh: Mesh, height: int, width: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Normals and tangents (H, W, 7) at the pixels that triangles cover in the texture, and which those are."""
    position = mesh.uv.astype(np.float64) * [width, height] - 0.5
    value = np.concatenate([mesh.normals, mesh.tangents], axis=-1).astype(np.float64)
    corner = position[mesh.faces]  # (F, 3, 2)
    first = np.ceil(corner.min(axis=1) - 1e-4).astype(np.int64)
    extent = np.floor(corner.max(axis=1) + 1e-4).astype(np.int64) - first
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    seen = area < 0  # the texture belongs to what faces the camera, not to walls and a back; v runs down
    faces, first, extent, area = mesh.faces[seen], first[seen], extent[seen], area[seen]
    corner, one, two = corner[seen], one[seen], two[seen]
    out, covered = np.zeros((height, width, 7)), np.zeros((height, width), dtype=bool)
    for down in range(int(extent[:, 1].max()) + 1):
        for right in range(int(extent[:, 0].max()) + 1):
            pixel = first + np.array([right, down])
            at = pixel - corner[:, 0]
            w1 = (at[:, 0] * two[:, 1] - at[:, 1] * two[:, 0]) / area
            w2 = (one[:, 0] * at[:, 1] - one[:, 1] * at[:, 0]) / area
            hit = (w1 > -1e-4) & (w2 > -1e-4) & (w1 + w2 < 1 + 1e-4)
            share = np.stack([1 - w1 - w2, w1, w2], axis=-1)[hit]
            column, row = pixel[hit].T
            out[row, column] = np.einsum("fk,fkc->fc", share, value[faces[hit]])
            covered[row, column] = True
    return out, covered


def _unmixed(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without its outermost pixels, but for parts so thin that nothing would be left of them."""
    inner = ndimage.binary_erosion(mask, np.ones((3, 3), dtype=bool))
    return np.asarray(inner | (mask & ~ndimage.binary_dilation(inner, np.ones((5, 5), dtype=bool))))


def _nearest(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column (H, W) of the pixel of the mask that is nearest to each."""
    if not mask.any():
        row, column = np.indices(mask.shape)
    else:
        row, column = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return np.asarray(row), np.asarray(column)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12))


def _eight_bits(value: Floats) -> NDArray[np.uint8]:
    return np.asarray(np.rint(np.clip(value, 0.0, 1.0) * 255), dtype=np.uint8)
