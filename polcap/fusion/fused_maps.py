"""The folder maps/ of a fused result: atlas textures, seen texels, and the mesh; and the exports made from it."""

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polcap.errors import DecodeError
from polcap.formats import atomic, text_file
from polcap.formats.export.texture_set import Extra
from polcap.formats.maps import maps_folder, png
from polcap.fusion import atlas as atlases
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, on_atlas
from polcap.fusion.mesh_occlusion import ambient_occlusion
from polcap.fusion.values import ClosedMesh
from polcap.image_values import Floats
from polcap.mesh_values import Asset, Mesh
from polcap.pipeline.detail_levels import DetailLevel
from polcap.stages import asset
from polcap.stages.asset import AssetSettings
from polcap.stages.surface import DecimatedMesh

FORMAT = "polcap fused maps 1"
_ARRAYS = {"vertices": 3, "normals": 3, "uv": 2, "tangents": 4, "faces": 3}  # columns of the arrays of mesh.npz
_CHANNELS = {"normal": "RGB", "diffuse": "RGB", "specular": "RGB", "roughness": "Y", "weight": "Y"}
_MEANINGS = {
    "normal": "unit vectors in the board's frame; float",
    "diffuse": "diffuse albedo rho_d, linear Rec.709; half",
    "specular": "specular albedo F0, linear Rec.709; half",
    "roughness": "perceptual roughness, alpha = roughness squared; half",
    "weight": "total weight of the views, 1: one view along the normal; half",
}
_Side = Annotated[int, Meta(ge=1, le=8192)]
_NEIGHBORS = 4  # texels of which a coarser level's texel is the mean


class _FusedMapsFile(maps_folder.MapsFile, frozen=True, kw_only=True):
    """The keys of a fused object's maps.json that `read` needs."""

    size: tuple[_Side, _Side]
    unit: Literal["m", "relative"]
    margin: Annotated[int, Meta(ge=0, le=64)] = atlases.AtlasSettings().margin


def write(folder: Path, atlas: Atlas, maps: AtlasMaps, keys: Mapping[str, str]) -> None:
    """Write the maps as EXR and PNG, seen.png, mask.png, mesh.npz and maps.json. Raises StorageError."""
    about = {
        "format": FORMAT,
        "keys": dict(keys),
        "size": list(maps.mask.shape[::-1]),
        "margin": atlas.margin,
        "albedo": maps_folder.albedo_scale(maps.albedo_sigma),
        "frame": "y up; origin in the middle of the board, or on the axis of the turn where there was none",
        "unit": "m" if atlas.mesh.metric else "relative",
        "maps": {
            **{f"{name}.exr": meaning for name, meaning in _MEANINGS.items()},
            "seen.png": "8 bit, 255 where a view saw the surface; elsewhere values are filled",
            "mask.png": "8 bit, 255 on the charts and their margins",
            "mesh.npz": "vertices, normals, uv (v down), tangents, faces",
        },
    }
    with atomic.folder_of_files(folder, "maps.json") as place:
        maps_folder.write_textures(place, maps, _CHANNELS, ("normal",))
        for name, mask in (("seen", maps.seen & maps.mask), ("mask", maps.mask)):
            png.write(place / f"{name}.png", np.where(mask, 255, 0).astype(np.uint8))
        with (place / "mesh.npz").open("wb") as file:
            np.savez(file, **{name: getattr(atlas.mesh, name) for name in _ARRAYS})
        atomic.write_json(place / "maps.json", about)


def is_fused(out: Path) -> bool:
    """Whether a result folder is that of `polcap fuse`."""
    return maps_folder.read_format(out / "maps") == FORMAT


@dataclass(frozen=True)
class FusedSource:
    """The stored maps and mesh of a fused object, as an export needs them."""

    atlas: Atlas
    maps: AtlasMaps
    settings: AssetSettings

    @property
    def triangles(self) -> int:
        """Number of triangles of the full mesh."""
        return len(self.atlas.mesh.faces)

    def whole(self, bits: Literal[8, 16], extras: tuple[Extra, ...]) -> Asset:
        """The asset with the full mesh; a closed mesh has no displacement."""
        return _asset(self.atlas, self.maps, self.settings, bits, extras)

    def decimated(self, whole: Asset, triangles: int) -> DetailLevel:
        """The asset with about so many triangles, an atlas of its own, and the textures of the full mesh."""
        side, margin, metric = self.maps.mask.shape[0], self.atlas.margin, self.atlas.mesh.metric
        atlas = atlases.chart_reduced(
            weld(self.atlas.mesh), triangles, lambda coarse: atlases.chart(coarse, side, margin, metric)
        )
        maps = transfer(self.atlas, self.maps, atlas)
        bits: Literal[8, 16] = 8 if whole.normal.dtype == np.uint8 else 16
        extras: tuple[Extra, ...] = ("occlusion",) if whole.has_occlusion else ()
        extras += () if whole.object_normal is None else ("object-normal",)
        error = _distance(self.atlas.mesh.vertices, atlas)
        return DetailLevel(
            _asset(atlas, maps, self.settings, bits, extras), DecimatedMesh(atlas.mesh, error, self.atlas.texel)
        )


def read(folder: Path, settings: AssetSettings) -> FusedSource:
    """Read the folder maps/ of a fused result; `settings` are those of its assets.

    Raises DecodeError: a file is missing or damaged.
    """
    try:
        about = msgspec.convert(text_file.read_json(folder / "maps.json"), _FusedMapsFile)
    except (OSError, ValueError) as error:
        raise DecodeError(f"{folder} holds no fused maps of this polcap ({error}); run `polcap fuse` again") from error
    maps = AtlasMaps(
        **{name: maps_folder.read_map(folder, name, letters, about.size) for name, letters in _CHANNELS.items()},
        mask=maps_folder.read_mask(folder / "mask.png", about.size),
        albedo_sigma=about.albedo.sigma,
    )
    mesh = Mesh(**_mesh_arrays(folder / "mesh.npz"), metric=about.unit == "m", frame="board")
    return FusedSource(atlases.of_mesh(mesh, about.size[0], about.margin), maps, settings)


def _mesh_arrays(file: Path) -> dict[str, Any]:
    """The arrays of a stored mesh by name. Raises DecodeError: missing, damaged, or of another shape or type."""
    try:
        with text_file.opened(file) as stream, zipfile.ZipFile(stream) as stored:
            arrays = {name: np.lib.format.read_array(stored.open(f"{name}.npy")) for name in _ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise DecodeError(f"{file} cannot be read ({error}); run `polcap fuse` again") from error
    faces, count = arrays["faces"], len(np.atleast_1d(arrays["vertices"]))
    for name, columns in _ARRAYS.items():
        rows, kind = (len(np.atleast_1d(faces)), "i") if name == "faces" else (count, "f")
        array = arrays[name]
        if array.shape != (rows, columns) or array.dtype.kind != kind or not np.isfinite(array).all():
            raise DecodeError(f"{file}: {name} is not {rows} × {columns} finite numbers; run `polcap fuse` again")
    if not len(faces) or faces.min() < 0 or faces.max() >= count:
        raise DecodeError(f"{file}: faces name vertices that it does not have; run `polcap fuse` again")
    return arrays


def weld(mesh: Mesh) -> ClosedMesh:
    """The mesh without the seams of its charts: vertices at the same position become one."""
    vertices, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces: NDArray[np.int32] = place.reshape(-1)[mesh.faces].astype(np.int32)
    return ClosedMesh(vertices, faces)


def transfer(source: Atlas, maps: AtlasMaps, target: Atlas) -> AtlasMaps:
    """The maps of one atlas on the texels of another of the same object: means of the nearest texels."""
    distance, nearest = cKDTree(source.position).query(target.position, k=_NEIGHBORS)
    share: Floats = 1 / (np.asarray(distance) + 0.1 * source.texel)  # finite at distance 0
    share /= share.sum(axis=1, keepdims=True)
    mixed = np.einsum("nk,nkc->nc", share, maps.texels(source.covered)[nearest])
    return replace(on_atlas(target, mixed), albedo_sigma=maps.albedo_sigma)


def _asset(
    atlas: Atlas, maps: AtlasMaps, settings: AssetSettings, bits: Literal[8, 16], extras: tuple[Extra, ...]
) -> Asset:
    """The glTF asset of an atlas, with the extra textures that a closed mesh has."""
    built = asset.build(maps, atlas.mesh, settings, bits)
    largest, kind = np.iinfo(built.normal.dtype).max, built.normal.dtype
    if "object-normal" in extras:
        built = replace(built, object_normal=np.rint((maps.normal / 2 + 0.5) * largest).astype(kind))
    if "occlusion" in extras:
        packed = built.occlusion_roughness_metallic.copy()
        packed[..., 0] = np.rint(ambient_occlusion(atlas) * largest)
        built = replace(built, occlusion_roughness_metallic=packed)
    return built


def _distance(vertices: Floats, coarse: Atlas) -> float:
    """99th percentile of the distances of a mesh's vertices from a coarser mesh's texels, m."""
    distance, _ = cKDTree(coarse.position).query(vertices[:: max(1, len(vertices) // 20_000)])  # a sample
    return float(np.percentile(distance, 99))
