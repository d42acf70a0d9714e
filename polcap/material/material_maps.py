"""The folder maps/ of a material, and the exports made from it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import DecodeError, ObjectError
from polcap.formats import atomic, text_file
from polcap.formats.export.texture_set import Extra
from polcap.formats.maps import maps_folder, png
from polcap.material.height_map import MaterialMaps
from polcap.material.texel_grid import TexelGrid
from polcap.mesh_values import Asset, Mesh
from polcap.pipeline.detail_levels import DetailLevel
from polcap.stages import asset
from polcap.stages.asset import AssetSettings

FORMAT = "polcap material maps 1"
_MEANINGS = {
    "normal": ("RGB", "unit vectors, x right, y up the page, z out of it (+Y, OpenGL)"),
    "diffuse": ("RGB", "diffuse albedo rho_d, linear Rec.709"),
    "specular": ("RGB", "specular albedo F0, linear"),
    "roughness": ("Y", "perceptual roughness, alpha = roughness squared"),
    "height": ("Y", "metres, mean 0"),
    "occlusion": ("Y", "share of a uniform sky that the relief leaves visible"),
    "normal_sigma": ("Y", "1 sigma of the normal, degrees"),
    "diffuse_sigma": ("Y", "1 sigma of the diffuse albedo, with that of its scale"),
    "specular_sigma": ("Y", "1 sigma of F0"),
    "roughness_sigma": ("Y", "1 sigma of the roughness"),
}
_FLOAT = ("normal", "height")  # 32 bit in EXR; the others have 16
_Side = Annotated[int, Meta(ge=1, le=1 << 14)]


class _MaterialFile(maps_folder.MapsFile, frozen=True, kw_only=True):
    """The keys of a material's maps.json that `read` needs."""

    size: tuple[_Side, _Side]
    texel_m: Annotated[float, Meta(gt=0, le=1)]
    thickness_m: float = 0.0
    tiles: bool = False


def write(folder: Path, grid: TexelGrid, maps: MaterialMaps, keys: Mapping[str, str], tiles: bool) -> None:
    """Write the maps as EXR and PNG, seen.png and maps.json. Raises StorageError."""
    height, width = maps.seen.shape
    low, high = float(maps.height.min()), float(maps.height.max())
    about = {
        "format": FORMAT,
        "keys": dict(keys),
        "size": [width, height],
        "texel_m": grid.texel,
        "extent_m": [width * grid.texel, height * grid.texel],
        "origin_m": list(grid.origin),
        "height_png_m": [low, high],
        "thickness_m": maps.thickness,
        "tiles": tiles,
        "albedo": maps_folder.albedo_scale(maps.albedo_sigma),
        "frame": "x right, y up the printed page, z out of it; origin_m: x and z (down the page) of the first texel",
        "maps": {
            **{f"{name}.exr": meaning for name, (_, meaning) in _MEANINGS.items()},
            "height.png": "16 bit, from the first to the second value of height_png_m",
            "seen.png": "8 bit, 255 where three views or more measured the texel; elsewhere values are filled",
        },
    }
    with atomic.folder_of_files(folder, "maps.json") as place:
        maps_folder.write_textures(place, maps, {name: letters for name, (letters, _) in _MEANINGS.items()}, _FLOAT)
        png.write(place / "occlusion.png", png.sixteen_bits(maps.occlusion))
        png.write(place / "height.png", png.sixteen_bits((maps.height - low) / max(high - low, 1e-12)))
        png.write(place / "seen.png", np.where(maps.seen, 255, 0).astype(np.uint8))
        atomic.write_json(place / "maps.json", about)


def is_material(out: Path) -> bool:
    """Whether a result folder is that of `polcap material`."""
    return maps_folder.read_format(out / "maps") == FORMAT


@dataclass(frozen=True)
class MaterialSource:
    """The stored maps of a material, as an export needs them: on a plane of its size."""

    maps: MaterialMaps
    texel: float  # m
    settings: AssetSettings

    @property
    def triangles(self) -> int:
        """Number of triangles of the plane."""
        return 2

    def whole(self, bits: Literal[8, 16], extras: tuple[Extra, ...]) -> Asset:
        """The plane with its textures; displacement and ambient occlusion are always known."""
        height = self.maps.height
        built = asset.build(self.maps, plane(height.shape[0], height.shape[1], self.texel), self.settings, bits)
        packed = built.occlusion_roughness_metallic.copy()
        packed[..., 0] = np.rint(self.maps.occlusion * np.iinfo(packed.dtype).max)
        share = (height - height.min()) / max(float(np.ptp(height)), 1e-12)
        displacement = np.rint(65535 * share).astype(np.uint16)
        built = replace(built, occlusion_roughness_metallic=packed, displacement=displacement)
        return replace(built, object_normal=built.normal) if "object-normal" in extras else built

    def decimated(self, whole: Asset, triangles: int) -> DetailLevel:
        """A plane has no coarser levels. Raises ObjectError."""
        raise ObjectError(f"a plane of 2 triangles cannot have {triangles}; leave out --lod and --triangles")


def read(folder: Path, settings: AssetSettings) -> MaterialSource:
    """Read the folder maps/ of a material. Raises DecodeError: a file is missing or damaged."""
    try:
        about = msgspec.convert(text_file.read_json(folder / "maps.json"), _MaterialFile)
    except (OSError, ValueError) as error:
        raise DecodeError(
            f"{folder} holds no material of this polcap ({error}); run `polcap material` again"
        ) from error
    values = {name: maps_folder.read_map(folder, name, letters, about.size) for name, (letters, _) in _MEANINGS.items()}
    seen = maps_folder.read_mask(folder / "seen.png", about.size)
    maps = MaterialMaps(**values, seen=seen, thickness=about.thickness_m, albedo_sigma=about.albedo.sigma)
    return MaterialSource(maps, about.texel_m, settings)


def plane(height: int, width: int, texel: float) -> Mesh:
    """A rectangle of the sample's size [m], x right, y up, facing z."""
    x, y = width * texel / 2, height * texel / 2
    return Mesh(
        vertices=np.array([[-x, y, 0], [x, y, 0], [-x, -y, 0], [x, -y, 0]], np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32),
        tangents=np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1)),
        faces=np.array([[0, 2, 1], [1, 2, 3]], np.int32),
        metric=True,
        frame="board",
    )
