"""Stage 10: turn maps and mesh into what a glTF renderer wants.

References
----------
Khronos, glTF 2.0 §3.9 (materials) and KHR_materials_specular.
"""

from typing import Annotated

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
    ior: Annotated[
        float, Meta(ge=1.1, le=2.5, description="refractive index written to the asset; F0 is kept whatever it is [1]")
    ] = 1.5


@stage(version=1, keep=False)
def build(maps: SurfaceMaps, mesh: Mesh, settings: Settings) -> Asset:
    """Textures on the crop's grid, filled outwards from the object so that no seam shows.

    Ours is a diffuse term behind two Fresnel transmissions, glTF's is base·(1 − F): base =
    ρ_d T₊(0)²/(1 − F0) makes the frontal looks agree. F0 = 0.04-like · factor · texture, the factor
    holding the map's greatest value. The mesh has already bent the light as its own normals do, so
    the normal texture holds what is left: the map's normals in the mesh's interpolated tangent frame.
    """
    nearest = _nearest(maps.mask)
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
            out[row, column] = np.einsum("fk,fkc->fc", share, value[mesh.faces[hit]])
            covered[row, column] = True
    return out, covered


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
