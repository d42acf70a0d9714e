"""In: the maps of a result. Out: its asset in the formats of a program or purpose, and what it was made from.

Everything comes from the stored maps and report.json, for `process` as for `polcap export`: the same
result gives the same bytes, whenever and with however many threads. A GLB of an earlier export that was made from these
maps, as its sidecar says, holds mesh and textures already: a further export encodes what is new and writes. `process`
leaves the files that stand.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import msgspec

from polcap.config import restored
from polcap.errors import DecodeError, SettingError
from polcap.formats import atomic, text_file
from polcap.formats.export import exr_layers, glb_reader, gltf, materialx, obj, provenance, texture_set, usd
from polcap.formats.export.encoders import Encoder, Kind
from polcap.formats.export.presets import PRESETS, Format, Preset
from polcap.formats.export.texture_set import Key, Texture
from polcap.formats.maps import maps_folder
from polcap.formats.written import Written
from polcap.images import Asset, SurfaceMaps
from polcap.pipeline.cache import Derived, digest
from polcap.pipeline.path import Results
from polcap.stages import asset, surface

_SIDECAR = ".provenance.json"
_SHARING = {"obj", "usd", "materialx"}  # formats whose textures lie beside them, and are the same


@dataclass(frozen=True)
class Wanted:
    """What an export is to hold; a preset excludes formats."""

    formats: tuple[Format, ...] = ("gltf", "obj")
    preset: str | None = None
    images: Kind | None = None  # inside the GLB; by default the preset's, or PNG
    color: str = exr_layers.LINEAR_REC709  # colour space or role of the colours in the layered EXR
    texture_size: int | None = None  # px of the longer side; by default the maps'
    lod: int = 0  # further GLBs, each in a quarter of the triangles of the one before


def export(
    out: Path,
    about: Mapping[str, Any],
    wanted: Wanted,
    standing: Written | None = None,
    made: Results | None = None,
) -> list[Path]:
    """Write the asset of a result folder again; returns the files, the sidecar last.

    Parameters
    ----------
    out
        The result folder.
    about
        report.json's content.
    wanted
        Without a preset the files go to asset/, with one to asset/PRESET/.
    standing
        Which files stand already; without it none does.
    made
        What maps/ was written from, where that is known: it is not read back then.

    Raises
    ------
    SettingError
        No such preset or colour space, or a package or an encoder is missing.
    """
    preset = _preset(wanted)
    if "usd" in preset.formats:
        usd.require()
    config = restored(about, out / "report.json")
    settings = _Settings(config.surface, config.asset)
    maps = Derived(maps_folder.digest(out / "maps"), maps_folder.read, (out / "maps",))
    if made is not None:
        maps = Derived(maps.key, maps_folder.as_read, (made.maps, made.mesh))
    source = _source(maps, settings)
    standing = standing or Written(out, anew=True)
    usual = made is not None and wanted == Wanted()
    if usual and (stood := _described(out / "asset", about, source, standing)):
        return stood
    encoder = Encoder()
    albedo = Derived(maps.key, _stored_maps, (maps,))
    if made is not None:
        albedo = Derived(maps.key, maps_folder.albedo_as_read, (made.maps,))
    earlier = _earlier(out / "asset", source, standing, partial(_indexed, albedo, settings.asset))
    if earlier is None:
        built = assembled(maps.value, settings)
    else:
        built = earlier.asset
        for key, texture in gltf.textures(built).items():
            if key in earlier.pngs:
                encoder.know(texture, "png", earlier.pngs[key])
    lods, levels = [], []
    if wanted.lod:
        stored, mesh = maps.value.maps, replace(built.mesh, depth=maps.value.depth)
        levels = [surface.decimated(mesh, stored.view, 0.25**k, config.surface.back) for k in range(1, wanted.lod + 1)]
        lods = [asset.on_mesh(built, stored, level.mesh) for level in levels]
    if wanted.texture_size is not None:
        built, *lods = (asset.resized(one, wanted.texture_size) for one in (built, *lods))
    job = _Job(
        folder=out / "asset" / (wanted.preset or ""),
        maps=out / "maps",
        asset=built,
        lods=tuple(zip(lods, levels)),
        name=atomic.safe_name(str(about["capture"].get("name"))),  # whatever the report says, files stay in the folder
        preset=preset,
        images=wanted.images or preset.images,
        color=wanted.color,
        record=provenance.record(about),
        source=source if wanted.texture_size is None else None,
        encoder=encoder,
        standing=standing,
    )
    written = job.write()
    if usual:
        standing.note(job.folder / f"{job.stem}.glb", msgspec.to_builtins(source))
    maps_folder.note_export(out / "maps", job.folder.relative_to(out).as_posix(), job.said())
    return written


class _Settings(msgspec.Struct, frozen=True):
    surface: surface.Settings
    asset: asset.Settings


def assembled(stored: maps_folder.Stored, settings: _Settings) -> Asset:
    """The mesh of stored maps, and their textures on it."""
    mesh = surface.triangulate(stored.depth, stored.maps, stored.metric, settings.surface)
    return asset.build(stored.maps, mesh, settings.asset)


class _Source(msgspec.Struct, frozen=True):
    """Digests of all that an asset is made from."""

    mesh: str  # and the normals on it
    colors: str


def _source(maps: Derived[maps_folder.Stored], settings: _Settings) -> _Source:
    made_by = [provenance.versions(), surface.integrate.version, asset.build.version]
    sections = (msgspec.to_builtins(section) for section in (settings.surface, settings.asset))
    return _Source(*(digest([made_by, section, maps.key]) for section in sections))


def _described(folder: Path, about: Mapping[str, Any], source: _Source, standing: Written) -> list[Path]:
    """The files of the last run's export, where only what is said of it has changed; none where more may have.

    Mesh and pictures stand; the GLB and the sidecar tell the run that they are from.
    """
    name = atomic.safe_name(str(about["capture"].get("name")))
    glb, sidecar = folder / f"{name}.glb", folder / f"{name}{_SIDECAR}"
    made_from, record = msgspec.to_builtins(source), provenance.record(about)
    try:
        digests = dict(text_file.read_json(sidecar)["files"])
        written = [folder / file for file in digests]
        if not standing.stand([glb, sidecar, folder.parent / "maps" / "maps.json", *written], made_from):
            return []
    except (OSError, ValueError, LookupError, TypeError):
        return []
    data = gltf.described(glb.read_bytes(), provenance.words(record))
    with atomic.path(glb) as temporary:
        temporary.write_bytes(data)
    provenance.write(sidecar, {**record, "made_from": made_from}, {**digests, glb.name: provenance.digest(glb)})
    return [*written, sidecar]


def _stored_maps(stored: maps_folder.Stored) -> SurfaceMaps:
    return stored.maps


def _indexed(maps: Derived[SurfaceMaps], settings: asset.Settings) -> asset.Indexed:
    return asset.indexed(maps.value, settings)


def _earlier(
    folder: Path, source: _Source, standing: Written, indexed: Callable[[], asset.Indexed]
) -> glb_reader.Stored | None:
    """The asset of an export in asset/ or one of its folders whose mesh was made from `source`, or None.

    Where its colors were made from another index of the same maps, with those that are `indexed` now instead, which is
    found out while the file is read.
    """
    for whole, glb, made_from, told in _alike(folder, source):
        try:
            with ThreadPoolExecutor(1) as beside:
                reading = beside.submit(glb_reader.read, glb, told, standing.stand([glb], made_from))
                changed = {} if whole else vars(indexed())
                found = reading.result()
        except (OSError, ValueError, DecodeError):
            continue  # touched since: as if it were not there
        if whole:
            return found
        pngs = {key: data for key, data in found.pngs.items() if key != "basecolor"}
        return glb_reader.Stored(replace(found.asset, **changed), pngs)
    return None


def _alike(folder: Path, source: _Source) -> list[tuple[bool, Path, Any, str]]:
    """Whether colors too, file, what its sidecar tells that it was made from, its digest; the wholly alike first."""
    found = []
    for sidecar in sorted([*folder.glob(f"*{_SIDECAR}"), *folder.glob(f"*/*{_SIDECAR}")]):
        glb = sidecar.with_name(f"{sidecar.name.removesuffix(_SIDECAR)}.glb")
        try:
            told = text_file.read_json(sidecar)
            made_from = msgspec.convert(told["made_from"], _Source)
            digest_then = msgspec.convert(told["files"][glb.name], str)
        except (OSError, ValueError, LookupError, TypeError):
            continue  # of another program, or touched since
        if made_from.mesh == source.mesh:
            found.append((made_from == source, glb, told["made_from"], digest_then))
    return sorted(found, key=lambda one: not one[0])


def _preset(wanted: Wanted) -> Preset:
    if wanted.preset is None:
        return Preset(wanted.formats, "normals +Y")
    if wanted.preset not in PRESETS:
        raise SettingError(f"--preset {wanted.preset} is none of {', '.join(PRESETS)}")
    return PRESETS[wanted.preset]


@dataclass(frozen=True)
class _Job:
    """One export under way."""

    folder: Path
    maps: Path
    asset: Asset
    lods: tuple[tuple[Asset, surface.Decimated], ...]
    name: str
    preset: Preset
    images: Kind
    color: str
    record: Mapping[str, Any]
    source: _Source | None  # of the asset; None where its textures were made larger or smaller
    encoder: Encoder
    standing: Written

    def write(self) -> list[Path]:
        """Every file of the export, in threads, and the sidecar."""
        writers: dict[Format, Callable[[], list[Path]]] = {
            "gltf": self._gltf,
            "obj": self._obj,
            "usd": self._usd,
            "materialx": self._materialx,
            "exr": self._exr,
        }
        tasks = [writers[one] for one in self.preset.formats]
        tasks += [partial(self._lod, k) for k in range(1, len(self.lods) + 1)]
        tasks += [partial(self._texture, file, made) for file, made in self.loose.items()]
        sidecar = self.folder / f"{self.stem}{_SIDECAR}"
        known = self._digests(sidecar)
        with ThreadPoolExecutor(len(tasks)) as pool:
            running = [pool.submit(self._digested, task, known) for task in tasks]
            written = {file: told for one in running for file, told in one.result().items()}
        whole = self.source and "gltf" in self.preset.formats and self.images == "png"
        made_from = msgspec.to_builtins(self.source) if whole else None
        digests = {file.name: told for file, told in written.items()}
        provenance.write(sidecar, {**self.record, "made_from": made_from}, digests)
        return [*written, sidecar]

    def _digests(self, sidecar: Path) -> dict[str, str]:
        """Of the files that the last run wrote; none where its sidecar was touched since."""
        if not self.standing.left(sidecar):
            return {}
        try:
            return msgspec.convert(text_file.read_json(sidecar)["files"], dict[str, str])
        except (OSError, ValueError, LookupError, TypeError):
            return {}

    def _digested(self, task: Callable[[], list[Path]], known: Mapping[str, str]) -> dict[Path, str]:
        """The files that a task writes, with their digests, which are known of those that stood."""
        written = {}
        for file in task():
            stood = self.standing.left(file) and file.name in known
            written[file] = known[file.name] if stood else provenance.digest(file)
        return written

    @cached_property
    def loose(self) -> dict[str, Texture]:
        """The textures that lie beside the asset, by file name."""
        named = {pattern.format(obj.stem(self.name)): make for pattern, make in self.preset.textures.items()}
        textures = {f"{name}.png": make(self.asset) for name, make in named.items()}
        if _SHARING.intersection(self.preset.formats):
            textures |= {file: texture_set.LOOSE[key](self.asset) for key, file in self.files.items()}
        return textures

    def said(self) -> dict[str, Any]:
        """What maps.json tells of the export."""
        return {
            "for": self.preset.says,
            "unit": self.unit,
            "glb": self._embedded(),
            "lods": {
                f"{self.stem}_lod{k}.glb": {
                    "triangles": len(level.mesh.faces),
                    "error": f"{1000 * level.error:.4g} mm" if level.mesh.metric else f"{level.error_px:.3g} px",
                }
                for k, (_, level) in enumerate(self.lods, 1)
            },
            "textures": {file: texture.says for file, texture in sorted(self.loose.items())},
        }

    def _embedded(self) -> dict[str, str]:
        """The GLB's pictures and what they hold, where there is a GLB."""
        if "gltf" not in self.preset.formats:
            return {}
        held = gltf.textures(self.asset)
        return {f"{self.stem}_{key}": f"{texture.says}; {self.images}" for key, texture in held.items()}

    @property
    def stem(self) -> str:
        """The asset's name, spelled as those of the textures beside it."""
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
        """For formats that hold texts."""
        return {"unit": self.unit, "normals": "+Y (OpenGL)", **provenance.words(self.record)}

    @property
    def line(self) -> str:
        """For formats that hold a comment."""
        return f"polcap; unit of length: {self.unit}; normals +Y (OpenGL); made from: {self.stem}.provenance.json"

    def _texture(self, name: str, texture: Texture) -> list[Path]:
        file = self.folder / name
        made_from = [texture.pixels, texture.color, texture.says]
        self.standing.make(file, made_from, partial(self._encoded, file, texture))
        return [file]

    def _encoded(self, file: Path, texture: Texture) -> None:
        with atomic.path(file) as temporary:
            temporary.write_bytes(self.encoder(texture, "png", text=True))

    def _gltf(self) -> list[Path]:
        file = self.folder / f"{self.stem}.glb"
        gltf.write(file, self.asset, self.stem, self.images, self.words, self.encoder)
        return [file]

    def _lod(self, level: int) -> list[Path]:
        file = self.folder / f"{self.stem}_lod{level}.glb"
        gltf.write(file, self.lods[level - 1][0], f"{self.stem}_lod{level}", self.images, self.words, self.encoder)
        return [file]

    def _obj(self) -> list[Path]:
        file = self.folder / f"{self.stem}.obj"
        return obj.write(file, self.asset, self.stem, self.files, self.line, self.standing)

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
