"""Exports the asset of a result in the formats of a preset, with a record of its provenance.

`process` and `polcap export` build the asset from the files in maps/. So the same result gives the
same bytes, with any number of threads.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, get_args

import msgspec
import numpy as np

from polcap import parallel, report
from polcap.capture_values import CatalogEntry
from polcap.config import Config, restore
from polcap.errors import SettingError
from polcap.formats import atomic, text_file
from polcap.formats.export import (
    archive,
    exr_layers,
    glb_geometry,
    gltf,
    iiif,
    materialx,
    obj,
    openlime_page,
    ply_stl,
    provenance,
    relightable_layer,
    sfp,
    texture_set,
    usd,
    web_page,
)
from polcap.formats.export.encoders import Kind, TextureEncoder
from polcap.formats.export.glb_geometry import Geometry
from polcap.formats.export.presets import EXTRAS, FORMATS, PRESETS, ExportPreset, Format
from polcap.formats.export.texture_set import Extra, Key, Texture
from polcap.formats.maps import maps_folder, png
from polcap.mesh_values import Asset, Mesh, ReliefMesh
from polcap.pipeline import result_folder
from polcap.pipeline.manifest import digest
from polcap.stages import asset, surface
from polcap.stages.asset import AssetSettings

C = TypeVar("C", bound=Config)
_Writer = Callable[[], list[Path]]  # returns the files that it has written
_NEEDED: tuple[Extra, ...] = ("object-normal",)  # by the format `iiif`
# of exported files
_SUFFIXES = {".glb", ".obj", ".mtl", ".ply", ".stl", ".usdc", ".usdz", ".mtlx", ".exr", ".png", ".html"}
_LARGEST_DEVIATION = 0.01  # of a level of detail from the full mesh, over its size
_SHARING = {"obj", "usd", "materialx"}  # formats that share texture files


@dataclass(frozen=True)
class ExportRequest:
    """The user's choice for an export: file formats or a preset, and options; with a preset, `formats` is ignored."""

    formats: tuple[Format, ...] = ("gltf", "obj")
    preset: str | None = None
    images: Kind | None = None  # inside the GLB; by default the preset's, or PNG
    geometry: Geometry | None = None  # inside the GLB; by default the preset's, or floats
    triangles: int | None = None  # at most; by default the preset's, or those of the full mesh
    color: str = exr_layers.LINEAR_REC709  # color space or role of the colors in the layered EXR
    bits: Literal[8, 16] | None = None  # of a texture's channel; by default the preset's, or 8
    extras: tuple[Extra, ...] = ()  # channels to compute, and to write as a file each
    texture_size: int | None = None  # px of the longer side; by default each texture's own
    page: Path | None = None  # file with model-viewer's script, for a web page that shows the GLB
    iiif: str | None = None  # address where the folder of the format `iiif`, which it adds, will be served
    without: tuple[Format, ...] = ()  # formats of a preset that this kind of result does not have
    catalog: Mapping[str, str] = field(default_factory=dict)  # fields of `CatalogEntry` in place of the capture's
    lod: int = 0  # number of further GLBs, each with a quarter of the previous one's triangles and texels


class ExportSource(Protocol):
    """An object to export: one view's relief, or a fused object."""

    @property
    def triangles(self) -> int: ...  # of the full mesh

    def whole(self, bits: Literal[8, 16], extras: tuple[Extra, ...]) -> Asset:
        """The asset with the full mesh, textures of 8 or 16 bits, and extra textures."""

    def decimated(self, whole: Asset, triangles: int) -> "DetailLevel":
        """The asset with about so many triangles."""


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
        """The asset with about so many triangles."""
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
    texel: float = 1.0  # of the normal texture, in map pixels

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


def check(wanted: ExportRequest) -> None:
    """Raise a SettingError for an unknown name, a missing package or an option without effect, before any work."""
    _check_values(wanted)
    preset = effective(wanted)
    if wanted.color != exr_layers.LINEAR_REC709 and "exr" not in preset.formats:
        raise SettingError(
            f"--color {wanted.color} converts the colors of the layered EXR only; add --exr, or choose --preset archive"
        )
    if (wanted.images or wanted.geometry) and "gltf" not in preset.formats and not wanted.lod:
        raise SettingError(
            "--images and --geometry change the GLB, which is not written; leave them out, or add --gltf"
        )
    if wanted.bits == 16 and not _has_png(preset):
        raise SettingError("--bits 16 is for PNG textures, and none is written; add --images png, or leave it out")
    if not {"usd", "usdz"}.isdisjoint(preset.formats):
        usd.require()
    glb_geometry.require(preset.geometry)
    if "iiif" in preset.formats:
        iiif.check(wanted.iiif or "")
        if wanted.texture_size is not None or preset.powers:
            raise SettingError(
                "--iiif keeps the proportions of the photographs; leave out --texture-size and presets for engines"
            )
    if wanted.page is not None:
        web_page.read_script(wanted.page)
        if "gltf" not in preset.formats:
            raise SettingError("--page shows the GLB, which is not written; choose --preset web")
        if preset.geometry == "draco":
            raise SettingError("--page holds no decoder of Draco; leave out --geometry draco")


def _check_values(wanted: ExportRequest) -> None:
    """Raise a SettingError for a name that does not exist, or a number below the least one."""
    names: tuple[tuple[str, str, Collection[Any], Collection[Any]], ...] = (
        ("formats", "format", wanted.formats, FORMATS),
        ("--preset", "preset", [wanted.preset], PRESETS),
        ("--images", "picture format", [wanted.images], get_args(Kind)),
        ("--geometry", "encoding", [wanted.geometry], get_args(Geometry)),
        ("--bits", "depth", [wanted.bits], (8, 16)),
        ("--extra", "texture", wanted.extras, EXTRAS),
        ("--about", "fact", wanted.catalog, CatalogEntry.__struct_fields__),
    )
    for option, noun, stated, known in names:
        for name in stated:
            if name is not None and name not in known:
                hint = text_file.suggestion(str(name), map(str, known))
                raise SettingError(f"{option} {name}: there is no such {noun}; {hint}")
    for name, text in wanted.catalog.items():
        if not isinstance(text, str):
            raise SettingError(f"--about {name} = {text!r:.60}: it is no text; put it in quotes")
    numbers = (("texture-size", wanted.texture_size, 16), ("triangles", wanted.triangles, 16), ("lod", wanted.lod, 0))
    for option, number, least in numbers:
        if number is not None and number < least:
            raise SettingError(f"--{option} {number}: it is at least {least}; give a larger number, or leave it out")


def _has_png(preset: ExportPreset) -> bool:
    """Whether an export writes a PNG texture, next to the GLB or in it."""
    inside = preset.images == "png" and "gltf" in preset.formats
    separate = preset.shared == "png" and not {"obj", "usd", "usdz", "materialx"}.isdisjoint(preset.formats)
    return inside or separate or bool(preset.textures or preset.extras)


def without(request: ExportRequest, extras: Collection[Extra]) -> ExportRequest:
    """The request for a result of several views: without the layered EXR of a preset, and without some textures."""
    formats: tuple[Format, ...] = () if request.preset is None else ("exr",)
    return replace(request, without=formats, extras=tuple(one for one in request.extras if one not in extras))


def read(folder: Path, config: Config, mesh: ReliefMesh | None = None) -> ReliefSource:
    """Read the maps of a result. `mesh` is the mesh from which they were written; None: it is made again.

    Raises DecodeError: a map is missing or damaged. ObjectError: no triangle fits into the mask.
    """
    maps = maps_folder.read(folder)
    return ReliefSource(maps, mesh or surface.triangulate(maps.depth, maps, maps.metric, config.surface), config)


def key(keys: Mapping[str, str], settings: AssetSettings) -> str:
    """Key of the asset of a result with these cache keys, to recognize exports of other maps or settings."""
    return digest([asset.build.versions, msgspec.to_builtins(settings), keys["infer"], keys["surface"]])


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
    moved = [np.abs(edge(coarse.vertices, axis=0) - edge(full.vertices, axis=0)).max() for edge in (np.min, np.max)]
    return float(max(error, *moved) / _extent(full))


def _extent(mesh: Mesh) -> float:
    """Longest side of a mesh's bounding box, in its unit."""
    return float(np.ptp(mesh.vertices, axis=0).max())


def _with_texels(level: DetailLevel, size: int | None, powers: bool, factor: int) -> DetailLevel:
    """The level with textures of `size` px, powers of two near their own size, or their own size, over `factor`."""
    built = level.asset
    if size is not None:
        resized = asset.resize_textures(built, max(size // factor, 1))
    elif powers:
        resized = asset.to_powers_of_two(built, factor)
    else:
        resized = built if factor == 1 else asset.shrink_textures(built, factor)
    return replace(level, asset=resized, texel=max(built.normal.shape) / max(resized.normal.shape))


def write(out: Path, about: Mapping[str, Any], wanted: ExportRequest, source: ExportSource) -> list[Path]:
    """Write an object's asset and its levels of detail into a result folder; returns the files, the provenance last.

    Without a preset the files go to asset/, with one to asset/PRESET/. `about` is report.json's content. All GLBs have
    the origin of the first level. The records of an earlier export of the same maps into the same folder are merged.

    Raises SettingError: no such preset or color space, or an encoder is missing. ObjectError: as `levels`.
    """
    found = levels(source, wanted)
    whole = found[0].asset
    preset, mesh = effective(wanted), whole.mesh
    name = atomic.safe_name(str(about["capture"].get("name")))  # files stay in the folder, whatever name the report has
    stem = preset.name.format(obj.stem(name) if preset.textures else name)
    shared: dict[Key, str] = {key: f"{obj.stem(stem)}_{key}.{preset.shared}" for key in texture_set.LOOSE}
    loose = _loose_textures(preset, wanted.extras, whole, obj.stem(name), shared)
    folder = out / "asset" / (wanted.preset or "")
    options = gltf.GlbOptions(preset.images, preset.geometry, gltf.center(mesh.vertices))
    unit, encoder = "m" if mesh.metric else "relative", TextureEncoder()
    record = provenance.record(about, wanted.catalog)
    facts = {"unit": unit, "normals": "+Y (OpenGL)", **provenance.words(record)}
    entry = {key: record[key] for key in CatalogEntry.__struct_fields__ if record.get(key)}
    comment = f"polcap; unit of length: {unit}; normals +Y (OpenGL); made from: {stem}.provenance.json"
    comment = "\n".join([comment, *(f"{key}: {' '.join(text.split())}" for key, text in entry.items())])
    writers: dict[Format, _Writer] = {
        "gltf": partial(_write_named, gltf.encode, folder / f"{stem}.glb", whole, options, facts, encoder),
        "obj": partial(obj.write, folder / f"{stem}.obj", whole, stem, shared, comment),
        "ply": partial(_write_one, ply_stl.write, folder / f"{stem}.ply", whole, comment),
        "stl": partial(_write_one, ply_stl.write, folder / f"{stem}.stl", whole),
        "usd": partial(_write_one, usd.write, folder / f"{stem}.usdc", whole, stem, shared, facts),
        "usdz": partial(_write_usdz, folder / f"{stem}.usdz", whole, facts, encoder),
        "materialx": partial(_write_named, materialx.document, folder / f"{stem}.mtlx", whole, shared, comment),
        "exr": partial(_write_one, exr_layers.write, folder / f"{stem}_layers.exr", out / "maps", wanted.color, facts),
        "sfp": partial(sfp.write, folder / f"{stem}_sfp", out / "maps"),
        "iiif": partial(_write_iiif, folder / f"{stem}_iiif", whole, facts, wanted.iiif or ""),
    }
    coarser = {folder / f"{stem}_lod{k}.glb": level for k, level in enumerate(found[1:], 1)}
    tasks = [writers[one] for one in preset.formats]
    write_glb = partial(_write_named, gltf.encode)
    tasks += [partial(write_glb, file, level.asset, options, facts, encoder) for file, level in coarser.items()]
    tasks += [partial(_write_texture, folder / file, texture, encoder, entry) for file, texture in loose.items()]
    written = [file for files in parallel.results(tasks) for file in files]  # pictures are encoded on threads
    if wanted.page is not None:
        page, glb = folder / f"{stem}.html", folder / f"{stem}.glb"
        web_page.write(page, glb, web_page.read_script(wanted.page), facts)
        written.append(page)
    description = {
        "for": preset.description,
        "unit": unit,
        "glb": {f"{stem}_{key}": text for key, text in _embedded(whole, preset).items()},
        "mesh": _size(found[0]),
        "lods": _level_notes({folder / f"{stem}.glb": found[0], **coarser}) if wanted.lod else {},
        "textures": {file: texture.meaning for file, texture in sorted(loose.items())},
    }
    maps_folder.note_export(out / "maps", folder.relative_to(out).as_posix(), description)
    if preset.gathers:
        written += [*archive.gather(out, folder), *report.archive(out, folder, about, entry)]
    sidecar = folder / f"{stem}.provenance.json"
    digests = {file.relative_to(folder).as_posix(): provenance.digest(file) for file in written}
    provenance.write(sidecar, record, digests)
    if preset.gathers:
        written.append(archive.write_manifest(folder))
    return [*written, sidecar]


def again(
    out: Path, requests: Sequence[ExportRequest], kind: type[C], read_maps: Callable[[Path, C], ExportSource]
) -> list[Path]:
    """Write the asset of a finished result again for each request, from maps/ and report.json; returns the files.

    `kind` is the class of the settings in report.json.
    """
    about = report.read(out)
    with result_folder.locked(out):
        source = read_maps(out / "maps", restore(kind, about, out / "report.json"))
        return [file for request in requests for file in write(out, about, request, source)]


def _loose_textures(
    preset: ExportPreset, extras: Sequence[Extra], whole: Asset, stem: str, shared: Mapping[Key, str]
) -> dict[str, Texture]:
    """Texture files of a preset, of --extra, and those that OBJ, USD and MaterialX share, by file name.

    Textures whose values the asset lacks are left out: displacement and curvature of a closed mesh.
    """
    names = {f"{pattern.format(stem)}.png": name for pattern, name in preset.textures.items()}
    names |= {f"{stem}_{key.replace('-', '')}.png": key.replace("-", "_") for key in extras}
    of_relief = {"displacement": whole.displacement, "curvature": whole.curvature, "cavity": whole.curvature}
    held = {file: name for file, name in names.items() if name not in of_relief or of_relief[name] is not None}
    found = {file: texture_set.TEXTURES[name](whole) for file, name in held.items()}
    if _SHARING.intersection(preset.formats):
        made = {file: texture_set.LOOSE[key](whole) for key, file in shared.items()}
        found |= {file: texture_set.linear(one) for file, one in made.items()} if preset.shared == "exr" else made
    return found


def sidecars(out: Path) -> list[Path]:
    """The records of provenance of all exports of a result."""
    return sorted((out / "asset").glob("**/*.provenance.json"))


def find_outdated(records: Sequence[Path], keys: Mapping[str, str]) -> list[Path]:
    """Exports of other maps than those of the result with these cache keys: whole folders, then single files.

    `records` are sidecars. A folder has one; a file that it does not list was exported with another record.
    """
    folders, files = [], []
    for sidecar in records:
        about, folder = provenance.read(sidecar), sidecar.parent
        if about.get("stages") != keys:
            folders.append(folder)
        else:
            known = {folder / name for name in about.get("files", {})} | {sidecar}
            files += [file for file in sorted(folder.iterdir()) if file.suffix in _SUFFIXES and file not in known]
    return folders + files


def effective(wanted: ExportRequest) -> ExportPreset:
    """The preset that an export uses: the requested one, with its values replaced by the request's other options."""
    preset = ExportPreset(wanted.formats, "normals +Y") if wanted.preset is None else PRESETS[wanted.preset]
    added: tuple[Format, ...] = () if wanted.iiif is None else ("iiif",)
    formats = tuple(one for one in dict.fromkeys((*preset.formats, *added)) if one not in wanted.without)
    return replace(
        preset,
        images=wanted.images or preset.images,
        geometry=wanted.geometry or preset.geometry,
        triangles=wanted.triangles or preset.triangles,
        bits=wanted.bits or preset.bits,
        formats=formats,
        extras=(*preset.extras, *wanted.extras, *(_NEEDED if "iiif" in formats else ())),
    )


def _write_one(write_file: Callable[..., None], file: Path, *arguments: Any) -> list[Path]:
    write_file(file, *arguments)
    return [file]


def _write_named(make: Callable[..., str | bytes], file: Path, content: Asset, *arguments: Any) -> list[Path]:
    atomic.write(file, make(content, file.stem, *arguments))
    return [file]


def _write_usdz(file: Path, content: Asset, facts: Mapping[str, str], encoder: TextureEncoder) -> list[Path]:
    """Write a USDZ with PNG textures; returns the file."""
    textures = {key: encoder(make(content), "png") for key, make in texture_set.LOOSE.items()}
    usd.package(file, content, file.stem, textures, facts)
    return [file]


def _write_iiif(folder: Path, content: Asset, facts: Mapping[str, str], address: str) -> list[Path]:
    """Write the tiles of a relightable layer and their page; returns the files."""
    page = folder / "index.html"
    openlime_page.write(page, facts.get("title") or facts["name"], facts.get("rights", ""))
    return [page, *iiif.write(folder, relightable_layer.pictures(content), facts, address)]


def _write_texture(file: Path, texture: Texture, encoder: TextureEncoder, entry: Mapping[str, str]) -> list[Path]:
    """Write a texture as EXR or PNG, with facts for catalogs; returns the file."""
    if file.suffix == ".exr":
        texture_set.write_exr(file, texture)
    else:
        atomic.write(file, png.described(encoder(texture, "png"), {"Description": texture.meaning, **_keywords(entry)}))
    return [file]


def _keywords(entry: Mapping[str, str]) -> dict[str, str]:
    """Facts for catalogs by keyword of a PNG's texts; its Description is that of the texture."""
    known = {"title": "Title", "creator": "Author", "rights": "Copyright", "description": "Object"}
    return {known.get(key, key.capitalize().replace("_", " ")): text for key, text in entry.items()}


def _embedded(content: Asset, preset: ExportPreset) -> dict[str, str]:
    """Meaning, size and file format of the textures in the GLB, for maps.json; none without a GLB."""
    textures = gltf.textures(content) if "gltf" in preset.formats else {}
    sizes = {key: "{1} × {0}".format(*texture.pixels.shape) for key, texture in textures.items()}
    return {key: f"{texture.meaning}; {sizes[key]} px; {preset.images}" for key, texture in textures.items()}


def _level_notes(files: Mapping[Path, DetailLevel]) -> dict[str, dict[str, Any]]:
    """Triangles, distance, height on the screen and bytes of the levels of detail that were written, for maps.json."""
    return {
        file.name: {**_size(level), "screen_px": level.screen_px, "bytes": file.stat().st_size}
        for file, level in files.items()
        if file.exists()
    }


def _size(level: DetailLevel) -> dict[str, Any]:
    """Triangles of a mesh, and its distance from the full one, for maps.json."""
    coarse, count = level.decimated, {"triangles": len(level.asset.mesh.faces)}
    if coarse is None:
        return count
    return {**count, "error": f"{1000 * coarse.error:.4g} mm" if coarse.mesh.metric else f"{coarse.error_px:.3g} px"}
