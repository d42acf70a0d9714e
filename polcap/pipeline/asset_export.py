"""Exports the asset of a result in the formats of a preset, with a record of its provenance.

Both `process` and `polcap export` build the asset from the maps as stored in their files. So the same result gives the
same bytes, with any number of threads.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from polcap import parallel
from polcap.config import Config
from polcap.errors import SettingError
from polcap.formats import atomic
from polcap.formats.export import exr_layers, gltf, materialx, obj, provenance, texture_set, usd
from polcap.formats.export.encoders import Kind, TextureEncoder
from polcap.formats.export.presets import PRESETS, ExportPreset, Format
from polcap.formats.export.texture_set import Key, Texture
from polcap.formats.maps import maps_folder
from polcap.images import Asset
from polcap.stages import asset, surface

_SHARING = {"obj", "usd", "materialx"}  # formats that share texture files


@dataclass(frozen=True)
class ExportRequest:
    """Content of an export; with a preset, `formats` is ignored."""

    formats: tuple[Format, ...] = ("gltf", "obj")
    preset: str | None = None
    images: Kind | None = None  # inside the GLB; by default the preset's, or PNG
    color: str = exr_layers.LINEAR_REC709  # color space or role of the colors in the layered EXR
    texture_size: int | None = None  # px of the longer side; by default the maps'
    lod: int = 0  # number of further GLBs, each with a quarter of the triangles of the previous one


@dataclass(frozen=True)
class DetailLevel:
    """A coarser asset, and the distance of its surface from the full one."""

    asset: Asset
    decimated: surface.DecimatedMesh


def check(wanted: ExportRequest) -> None:
    """Check that a request can be exported, before anything is computed.

    Raises
    ------
    SettingError
        No such preset, or the package of a format is missing.
    """
    if "usd" in _preset(wanted).formats:
        usd.require()


def from_maps(folder: Path, config: Config, wanted: ExportRequest) -> tuple[Asset, list[DetailLevel]]:
    """The asset of the maps in a folder, and its levels of detail.

    Raises
    ------
    DecodeError
        A map is missing or damaged.
    ObjectError
        No triangle fits into the mask.
    """
    stored = maps_folder.read(folder)
    mesh = surface.triangulate(stored.depth, stored.maps, stored.metric, config.surface)
    whole = asset.build(stored.maps, mesh, config.asset)
    levels = []
    for k in range(1, wanted.lod + 1):
        decimated = surface.decimate(mesh, stored.maps.view, 0.25**k, config.surface.back)
        levels.append(DetailLevel(asset.with_mesh(whole, stored.maps, decimated.mesh), decimated))
    if wanted.texture_size is None:
        return whole, levels
    size = wanted.texture_size
    return asset.resize_textures(whole, size), [
        replace(level, asset=asset.resize_textures(level.asset, size)) for level in levels
    ]


def write(
    out: Path, about: Mapping[str, Any], wanted: ExportRequest, whole: Asset, levels: Sequence[DetailLevel] = ()
) -> list[Path]:
    """Write an asset and its levels of detail into a result folder; returns the files, the record of provenance last.

    Without a preset the files go to asset/, with one to asset/PRESET/. `about` is report.json's content.

    Raises
    ------
    SettingError
        No such preset or color space, or an encoder is missing.
    StorageError
        A file cannot be written.
    """
    preset = _preset(wanted)
    name = atomic.safe_name(str(about["capture"].get("name")))  # files stay in the folder, whatever name the report has
    export = _Export(
        folder=out / "asset" / (wanted.preset or ""),
        maps=out / "maps",
        asset=whole,
        levels=tuple(levels),
        name=name,
        preset=preset,
        images=wanted.images or preset.images,
        color=wanted.color,
        record=provenance.record(about),
    )
    written = export.write()
    maps_folder.note_export(out / "maps", export.folder.relative_to(out).as_posix(), export.description())
    return written


def _preset(wanted: ExportRequest) -> ExportPreset:
    if wanted.preset is None:
        return ExportPreset(wanted.formats, "normals +Y")
    if wanted.preset not in PRESETS:
        raise SettingError(f"--preset {wanted.preset} is none of {', '.join(PRESETS)}")
    return PRESETS[wanted.preset]


@dataclass(frozen=True)
class _Export:
    """One export: its content, and a function for each of its files."""

    folder: Path
    maps: Path
    asset: Asset
    levels: tuple[DetailLevel, ...]
    name: str
    preset: ExportPreset
    images: Kind
    color: str
    record: Mapping[str, Any]

    def write(self) -> list[Path]:
        """Write all files of the export and the record of provenance; pictures are encoded on threads."""
        writers: dict[Format, Callable[[], list[Path]]] = {
            "gltf": self._gltf,
            "obj": self._obj,
            "usd": self._usd,
            "materialx": self._materialx,
            "exr": self._exr,
        }
        tasks = [writers[one] for one in self.preset.formats]
        tasks += [partial(self._level, k) for k in range(1, len(self.levels) + 1)]
        tasks += [partial(self._texture, file, made) for file, made in self.loose.items()]
        written = [file for files in parallel.results(tasks) for file in files]
        sidecar = self.folder / f"{self.stem}.provenance.json"
        provenance.write(sidecar, self.record, {file.name: provenance.digest(file) for file in written})
        return [*written, sidecar]

    def description(self) -> dict[str, Any]:
        """The entry of the export in maps.json."""
        return {
            "for": self.preset.description,
            "unit": self.unit,
            "glb": self._embedded(),
            "lods": {
                f"{self.stem}_lod{k}.glb": {
                    "triangles": len(level.decimated.mesh.faces),
                    "error": f"{1000 * level.decimated.error:.4g} mm"
                    if level.decimated.mesh.metric
                    else f"{level.decimated.error_px:.3g} px",
                }
                for k, level in enumerate(self.levels, 1)
            },
            "textures": {file: texture.meaning for file, texture in sorted(self.loose.items())},
        }

    def _embedded(self) -> dict[str, str]:
        """The GLB's pictures and their meaning; empty without a GLB."""
        if "gltf" not in self.preset.formats:
            return {}
        held = gltf.textures(self.asset)
        return {f"{self.stem}_{key}": f"{texture.meaning}; {self.images}" for key, texture in held.items()}

    @cached_property
    def encoder(self) -> TextureEncoder:
        """Encodes a picture once for all files that contain it."""
        return TextureEncoder()

    @cached_property
    def loose(self) -> dict[str, Texture]:
        """The textures in files of their own, by file name."""
        named = {pattern.format(obj.stem(self.name)): make for pattern, make in self.preset.textures.items()}
        textures = {f"{name}.png": make(self.asset) for name, make in named.items()}
        if _SHARING.intersection(self.preset.formats):
            textures |= {file: texture_set.LOOSE[key](self.asset) for key, file in self.files.items()}
        return textures

    @property
    def stem(self) -> str:
        """Name of the asset's files, spelled like those of its texture files."""
        return self.preset.name.format(obj.stem(self.name) if self.preset.textures else self.name)

    @property
    def files(self) -> dict[Key, str]:
        """Names of the textures that OBJ, USD and MaterialX share."""
        return {key: f"{obj.stem(self.stem)}_{key}.png" for key in texture_set.LOOSE}

    @property
    def unit(self) -> str:
        return "m" if self.asset.mesh.metric else "relative"

    @property
    def words(self) -> dict[str, str]:
        """The record of provenance, for formats with metadata texts."""
        return {"unit": self.unit, "normals": "+Y (OpenGL)", **provenance.words(self.record)}

    @property
    def line(self) -> str:
        """A comment line, for formats with comments."""
        return f"polcap; unit of length: {self.unit}; normals +Y (OpenGL); made from: {self.stem}.provenance.json"

    def _texture(self, name: str, texture: Texture) -> list[Path]:
        file = self.folder / name
        with atomic.path(file) as temporary:
            temporary.write_bytes(self.encoder(texture, "png", text=True))
        return [file]

    def _gltf(self) -> list[Path]:
        file = self.folder / f"{self.stem}.glb"
        gltf.write(file, self.asset, self.stem, self.images, self.words, self.encoder)
        return [file]

    def _level(self, k: int) -> list[Path]:
        name = f"{self.stem}_lod{k}"
        file = self.folder / f"{name}.glb"
        gltf.write(file, self.levels[k - 1].asset, name, self.images, self.words, self.encoder)
        return [file]

    def _obj(self) -> list[Path]:
        file = self.folder / f"{self.stem}.obj"
        return obj.write(file, self.asset, self.stem, self.files, self.line)

    def _usd(self) -> list[Path]:
        file = self.folder / f"{self.stem}.usdc"
        usd.write(file, self.asset, self.stem, self.files, self.words)
        return [file]

    def _materialx(self) -> list[Path]:
        file = self.folder / f"{self.stem}.mtlx"
        materialx.write(file, self.asset, self.stem, self.files, self.line)
        return [file]

    def _exr(self) -> list[Path]:
        file = self.folder / f"{self.stem}_layers.exr"
        exr_layers.write(file, self.maps, self.color, self.words)
        return [file]
