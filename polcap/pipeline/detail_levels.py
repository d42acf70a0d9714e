"""The assets of an export: the first with at most the requested triangles and texture size, then coarser ones."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import msgspec
import numpy as np

from polcap.config import Config
from polcap.formats.export.texture_set import Extra
from polcap.formats.maps import maps_folder
from polcap.mesh_values import Asset, Mesh, ReliefMesh
from polcap.pipeline.export_request import ExportRequest, effective
from polcap.stages import asset, surface

_LARGEST_DEVIATION = 0.01  # of a level of detail from the full mesh, over its size


class ExportSource(Protocol):
    """An object to export: one view's relief, or a fused object."""

    @property
    def triangles(self) -> int: ...  # of the full mesh

    def whole(self, bits: Literal[8, 16], extras: tuple[Extra, ...]) -> Asset:
        """The asset with the full mesh, textures of 8 or 16 bits, and extra textures."""

    def decimated(self, whole: Asset, triangles: int) -> "DetailLevel":
        """The asset `whole` with its mesh decimated to about this number of triangles."""


@dataclass(frozen=True)
class ReliefSource:
    """The maps of a result as stored, and their full mesh."""

    maps: maps_folder.ResultMaps
    mesh: ReliefMesh
    config: Config

    @property
    def triangles(self) -> int:
        """Number of triangles of the full mesh."""
        return len(self.mesh.faces)

    def whole(self, bits: Literal[8, 16], extras: tuple[Extra, ...]) -> Asset:
        """The asset with the full mesh, textures of 8 or 16 bits, and extra textures."""
        maps = self.maps
        built = asset.build(maps, self.mesh, self.config.asset, bits)
        return asset.with_extras(built, maps, maps.depth, "occlusion" in extras) if extras else built

    def decimated(self, whole: Asset, triangles: int) -> "DetailLevel":
        """The asset `whole` with its mesh decimated to about this number of triangles."""
        maps = self.maps
        coarse = surface.decimate(self._front, maps.view, triangles, self.config.surface.back)
        return DetailLevel(asset.with_mesh(whole, maps, coarse.mesh), coarse)

    @cached_property
    def _front(self) -> ReliefMesh:
        """The full mesh without its back."""
        if self.config.surface.back == "open":
            return self.mesh
        settings = msgspec.structs.replace(self.config.surface, back="open")
        return surface.triangulate(self.maps.depth, self.maps, self.maps.metric, settings)


@dataclass(frozen=True)
class DetailLevel:
    """One level of detail of an asset, and its decimated mesh if it has fewer triangles than the full one."""

    asset: Asset
    decimated: surface.DecimatedMesh | None = None
    texel: float = 1.0  # side of a texel of the normal texture, map px

    @property
    def error(self) -> float:
        """Distance of the full mesh from this one, in the mesh's unit."""
        return 0.0 if self.decimated is None else self.decimated.error

    @property
    def screen_px(self) -> int | None:
        """Height on the screen up to which neither a texel nor the distance from the full mesh exceeds a pixel.

        None: the full mesh.
        """
        if self.decimated is None:
            return None
        return int(_extent(self.asset.mesh) / max(self.error, self.texel * self.decimated.pixel))


def read(folder: Path, config: Config, mesh: ReliefMesh | None = None) -> ReliefSource:
    """Read the maps of a result. `mesh` is the mesh from which they were written; None: it is made again.

    Raises DecodeError: a map is missing or damaged. ObjectError: no triangle fits into the mask.
    """
    maps = maps_folder.read(folder)
    return ReliefSource(maps, mesh or surface.triangulate(maps.depth, maps, maps.metric, config.surface), config)


def levels(source: ExportSource, wanted: ExportRequest) -> list[DetailLevel]:
    """Build an export's levels of detail: first the asset with at most the requested triangles and texture size.

    Each further level has a quarter of the triangles and of the texels, for twice the distance. Levels that differ from
    the full mesh by more than 1 % of its size are left out.

    Raises ObjectError: a level has too few triangles.
    """
    preset, full = effective(wanted), source.triangles
    whole = source.whole(preset.bits, preset.extras)
    most = min(preset.triangles or full, full)
    found = [DetailLevel(whole) if most == full else source.decimated(whole, most)]
    for k in range(1, wanted.lod + 1):
        level = source.decimated(whole, round(most * 0.25**k))
        if _deviation(level.asset.mesh, whole.mesh, level.error) > _LARGEST_DEVIATION:
            break
        found.append(level)
    return [_with_texels(level, wanted.texture_size, preset.powers, 2**k) for k, level in enumerate(found)]


def _deviation(coarse: Mesh, full: Mesh, error: float) -> float:
    """Distance of a decimated mesh from the full one, or the change of its bounding box if larger, over the size."""
    shifts = [np.abs(edge(coarse.vertices, axis=0) - edge(full.vertices, axis=0)).max() for edge in (np.min, np.max)]
    return float(max(error, *shifts) / _extent(full))


def _extent(mesh: Mesh) -> float:
    """Longest side of a mesh's bounding box, in its unit."""
    return float(np.ptp(mesh.vertices, axis=0).max())


def _with_texels(level: DetailLevel, size: int | None, powers: bool, factor: int) -> DetailLevel:
    """The level with textures of `size` px, of powers of two, or of their own size, each divided by `factor`."""
    built = level.asset
    if size is not None:
        resized = asset.resize_textures(built, max(size // factor, 1))
    elif powers:
        resized = asset.to_powers_of_two(built, factor)
    else:
        resized = built if factor == 1 else asset.shrink_textures(built, factor)
    return replace(level, asset=resized, texel=max(built.normal.shape) / max(resized.normal.shape))
