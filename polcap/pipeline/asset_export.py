"""Exports the asset of a result in the formats of a preset, with a record of its provenance.

`process` and `polcap export` build the asset from the files in maps/. So the same result gives the same bytes, with any
number of threads.
"""

import glob
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from polcap import parallel, report
from polcap.capture_values import CatalogEntry
from polcap.config import Config, restore
from polcap.errors import SettingError, StorageError
from polcap.formats import atomic, color_profile, own_files
from polcap.formats.export import (
    archive,
    exr_layers,
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
from polcap.formats.export.encoders import TextureEncoder
from polcap.formats.export.presets import PRESETS, ExportPreset, Format
from polcap.formats.export.texture_set import Extra, Key, Texture
from polcap.formats.maps import maps_folder, png
from polcap.formats.raw import file_bytes
from polcap.mesh_values import Asset
from polcap.pipeline import result_folder, result_place, unchanged
from polcap.pipeline.detail_levels import DetailLevel, ExportSource, levels
from polcap.pipeline.export_request import ExportRequest, effective
from polcap.pipeline.manifest import digest
from polcap.stages import asset
from polcap.stages.asset import AssetSettings

C = TypeVar("C", bound=Config)
_Writer = Callable[[], list[Path]]  # returns the files that it has written
# of exported files
_SUFFIXES = {".glb", ".obj", ".mtl", ".ply", ".stl", ".usdc", ".usdz", ".mtlx", ".exr", ".png", ".html"}
_SHARING = {"obj", "usd", "materialx"}  # formats that share texture files


def key(keys: Mapping[str, str], settings: AssetSettings) -> str:
    """Key of the asset of a result with these cache keys; exports of other maps or settings have another one."""
    return digest([asset.build.versions, msgspec.to_builtins(settings), keys["infer"], keys["surface"]])


@dataclass(frozen=True)
class _Files:
    """The files of one export: their folder and names, and the values that they share."""

    folder: Path  # asset/ or asset/PRESET/
    stem: str  # of the names
    asset: Asset
    shared: Mapping[Key, str]  # names of the textures of OBJ, USD and MaterialX
    facts: Mapping[str, str]  # origin and catalog entry, for headers
    entry: Mapping[str, str]  # stated fields of `CatalogEntry`
    comment: str  # unit, axes and catalog entry, for the heads of text files
    glb: gltf.GlbOptions
    encoder: TextureEncoder

    def path(self, ending: str) -> Path:
        """Path of the file with this end of its name."""
        return self.folder / f"{self.stem}{ending}"


def write(out: Path, about: Mapping[str, Any], wanted: ExportRequest, source: ExportSource) -> list[Path]:
    """Write an object's asset and its levels of detail into a result folder; returns the files, the provenance last.

    Without a preset the files go to asset/, with one to asset/PRESET/. `about` is report.json's content. All GLBs have
    the origin of the first level. The records of an earlier export of the same maps into the same folder are merged;
    levels of its GLB are replaced or removed.

    Raises SettingError: no such preset or color space, or an encoder is missing. ObjectError: as `levels`.
    StorageError: somebody has edited a file that it would replace.
    """
    found, record = levels(source, wanted), provenance.record(about, wanted.catalog)
    if found[0].asset.mesh.frame == "camera":  # one view
        turn_deg = about["capture"].get("upright_deg", 0)
        found = [replace(level, asset=asset.turn(level.asset, turn_deg)) for level in found]
    preset, content = effective(wanted), found[0].asset
    name = atomic.safe_name(str(about["capture"].get("name")))  # files stay in the folder, whatever name the report has
    files = _files(out / "asset" / (wanted.preset or ""), name, content, preset, record)
    if wanted.preset:
        _check_edits(files.folder)
    loose = _loose_textures(preset, wanted.extras, content, obj.stem(name), files.shared)
    coarser = {files.path(f"_lod{k}.glb"): level for k, level in enumerate(found[1:], 1)}
    writers = _writers(files, out / "maps", wanted)
    tasks = [writers[one] for one in preset.formats]
    tasks += [partial(_write_glb, files, file, level.asset) for file, level in coarser.items()]
    tasks += [partial(_write_texture, files, files.folder / file, texture) for file, texture in loose.items()]
    written = [file for group in parallel.results(tasks) for file in group]  # pictures are encoded on threads
    writes_glb = "gltf" in preset.formats or wanted.lod  # the GLB or its levels
    if writes_glb:
        _remove_levels(files, coarser)
    if wanted.page is not None:
        written.append(files.path(".html"))
        web_page.write(written[-1], files.path(".glb"), web_page.read_script(wanted.page), files.facts)
    notes = _level_notes({files.path(".glb"): found[0], **coarser}) if wanted.lod else {}
    description = {
        "for": preset.description,
        "unit": files.facts["unit"],
        "glb": {f"{files.stem}_{key}": text for key, text in _embedded(content, preset).items()},
        "mesh": _size(found[0]),
        **({"lods": notes} if writes_glb else {}),
        "textures": {file: texture.meaning for file, texture in sorted(loose.items())},
        **({"facts": files.entry} if files.entry else {}),
    }
    maps_folder.note_export(out / "maps", files.folder.relative_to(out).as_posix(), description)
    if preset.gathers:
        written += [*archive.gather(out, files.folder), *report.archive(out, files.folder, about, files.entry)]
    sidecar = files.path(".provenance.json")
    digests = {file.relative_to(files.folder).as_posix(): file_bytes.digest(file.read_bytes()) for file in written}
    provenance.write(sidecar, record, digests)
    if preset.gathers:
        written.append(archive.write_manifest(files.folder))
    return [*written, sidecar]


def _check_edits(folder: Path) -> None:
    """Refuse an export into a preset's folder in which somebody has edited a file, before it writes the first one.

    Raises StorageError: there is such a file.
    """
    if own := own_files.owner(folder):
        for file in own.below(folder):
            own.check(file)


def _files(folder: Path, name: str, content: Asset, preset: ExportPreset, record: Mapping[str, Any]) -> _Files:
    """The files of an export of the object `name`, with its `record` of provenance."""
    entry = {key: record[key] for key in CatalogEntry.__struct_fields__ if record.get(key)}
    stem = preset.name.format(obj.stem(name) if preset.textures else name)
    unit = "m" if content.mesh.metric else "relative"
    head = f"polcap; unit of length: {unit}; normals +Y (OpenGL); made from: {stem}.provenance.json"
    return _Files(
        folder=folder,
        stem=stem,
        asset=content,
        shared={key: f"{obj.stem(stem)}_{key}.{preset.shared}" for key in texture_set.LOOSE},
        facts={"unit": unit, "normals": "+Y (OpenGL)", **provenance.words(record)},
        entry=entry,
        comment="\n".join([head, *(f"{key}: {' '.join(text.split())}" for key, text in entry.items())]),
        glb=gltf.GlbOptions(preset.images, preset.geometry, gltf.center(content.mesh.vertices)),
        encoder=TextureEncoder(),
    )


def _writers(files: _Files, maps: Path, wanted: ExportRequest) -> dict[Format, _Writer]:
    """The function that writes each format; `maps` is the folder maps/ of the result."""
    content, stem, shared, facts, comment = files.asset, files.stem, files.shared, files.facts, files.comment
    return {
        "gltf": partial(_write_glb, files, files.path(".glb"), content),
        "obj": partial(obj.write, files.path(".obj"), content, stem, shared, comment, files.entry),
        "ply": partial(_write_one, ply_stl.write, files.path(".ply"), content, comment),
        "stl": partial(_write_one, ply_stl.write, files.path(".stl"), content),
        "usd": partial(_write_one, usd.write, files.path(".usdc"), content, stem, shared, facts),
        "usdz": partial(_write_usdz, files),
        "materialx": partial(_write_one, materialx.write, files.path(".mtlx"), content, shared, comment),
        "exr": partial(_write_one, exr_layers.write, files.path("_layers.exr"), maps, wanted.color, facts),
        "sfp": partial(sfp.write, files.path("_sfp"), maps, comment),
        "iiif": partial(_write_iiif, files, wanted.iiif or ""),
    }


def again(
    out: Path, requests: Sequence[ExportRequest], kind: type[C], read_maps: Callable[[Path, C], ExportSource]
) -> list[Path]:
    """Write the asset of a finished result again for each request, from maps/ and report.json; returns the files.

    `kind` is the class of the settings in report.json.
    """
    about = report.read(out)
    with result_folder.locked(out), unchanged.preserved(out):
        source = read_maps(out / "maps", restore(kind, about, out / "report.json"))
        return [file for request in requests for file in write(out, about, request, source)]


def copy(result: Path, out: Path) -> None:
    """Make a result folder with the records of another one, such as an archive, which stays as it is.

    These are maps, report and color profile. A page that another version of polcap wrote is left out.

    Raises SettingError: `out` holds something already, lies in `result`, or as `result_place.check_free`.
    StorageError: `result` is no result, or `out` is not writable.
    """
    if Path(os.path.realpath(out)).is_relative_to(os.path.realpath(result)):
        raise SettingError(f"--out {out} lies in {result}, which is to stay as it is; choose a folder outside")
    result_place.check_free(out)
    if os.path.lexists(out) and (not out.is_dir() or any(out.iterdir())):
        raise SettingError(f"--out {out} is not an empty folder; choose another folder")
    about = report.read(result)
    with result_folder.opened(out):
        with suppress(StorageError):  # by a page of another version
            report.archive(result, out, about, about["capture"].get("catalog", {}), "asset/")
        for file in (result / "report.json", result / color_profile.NAME, *sorted((result / "maps").iterdir())):
            if file.is_file():
                atomic.copy(file, out / file.relative_to(result))


def _loose_textures(
    preset: ExportPreset, extras: Sequence[Extra], content: Asset, stem: str, shared: Mapping[Key, str]
) -> dict[str, Texture]:
    """Textures of a preset, of --extra, and those that OBJ, USD and MaterialX share, by file name.

    `shared` has the file names of the last of these. Displacement, curvature and cavity of a closed mesh are left out.
    """
    names = {f"{pattern.format(stem)}.png": name for pattern, name in preset.textures.items()}
    names |= {f"{stem}_{key.replace('-', '')}.png": key.replace("-", "_") for key in extras}
    of_relief = {"displacement": content.displacement, "curvature": content.curvature, "cavity": content.curvature}
    available = {file: name for file, name in names.items() if name not in of_relief or of_relief[name] is not None}
    found = {file: texture_set.TEXTURES[name](content) for file, name in available.items()}
    if _SHARING.intersection(preset.formats):
        for key, file in shared.items():
            texture = texture_set.LOOSE[key](content)
            found[file] = texture_set.with_linear_meaning(texture) if preset.shared == "exr" else texture
    return found


def sidecars(out: Path) -> list[Path]:
    """The records of provenance of all exports of a result."""
    return sorted((out / "asset").glob("**/*.provenance.json"))


def find_outdated(out: Path, records: Sequence[Path], keys: Mapping[str, str]) -> list[Path]:
    """Exports of other maps than those of the result `out` with these cache keys: folders of presets, and files.

    `records` are sidecars, one of each folder. Files of polcap that no sidecar lists are of an earlier record.
    """
    outdated, unlisted, own = list[Path](), dict[Path, None](), own_files.OwnFiles(out)
    for sidecar in records:
        about, folder = provenance.read(sidecar), sidecar.parent
        if about.get("stages") != keys:
            listed = dict.fromkeys(folder / Path(name).parts[0] for name in about.get("files", ()))
            outdated += [folder] if folder.name in PRESETS else [path for path in listed if path.exists()]
            continue
        for file in own.below(folder):
            name = file.relative_to(os.path.abspath(folder))
            if file.suffix in _SUFFIXES and name.as_posix() not in about["files"] and name.parts[0] not in PRESETS:
                unlisted[folder / name.parts[0]] = None
    return [*outdated, *unlisted]


def _write_one(write_file: Callable[..., None], file: Path, *arguments: Any) -> list[Path]:
    """Write a file by a function that returns nothing; returns the file."""
    write_file(file, *arguments)
    return [file]


def _write_glb(files: _Files, file: Path, content: Asset) -> list[Path]:
    """Write the GLB of one level of detail; returns the file."""
    atomic.write(file, gltf.encode(content, file.stem, files.glb, files.facts, files.encoder))
    return [file]


def _remove_levels(files: _Files, written: Collection[Path]) -> None:
    """Remove the levels of an earlier GLB that polcap wrote in this place, except those just written."""
    own = own_files.owner(files.path(".glb"))
    for old in files.folder.glob(f"{glob.escape(files.stem)}_lod[0-9].glb"):
        if own is not None and old not in written:
            own.remove(old)


def _write_usdz(files: _Files) -> list[Path]:
    """Write a USDZ with PNG textures; returns the file."""
    file = files.path(".usdz")
    textures = {key: files.encoder(make(files.asset), "png") for key, make in texture_set.LOOSE.items()}
    usd.package(file, files.asset, file.stem, textures, files.facts)
    return [file]


def _write_iiif(files: _Files, address: str) -> list[Path]:
    """Write the tiles of a relightable layer and their page; returns the files."""
    folder = files.path("_iiif")
    page = folder / "index.html"
    openlime_page.write(page, files.facts)
    return [page, *iiif.write(folder, relightable_layer.pictures(files.asset), files.facts, address)]


def _write_texture(files: _Files, file: Path, texture: Texture) -> list[Path]:
    """Write a texture as EXR or PNG, with facts for catalogs; returns the file."""
    if file.suffix == ".exr":
        texture_set.write_exr(file, texture, files.entry)
    else:
        encoded = files.encoder(texture, "png")
        atomic.write(file, png.described(encoded, {"Description": texture.meaning, **_keywords(files.entry)}))
    return [file]


def _keywords(entry: Mapping[str, str]) -> dict[str, str]:
    """Facts for catalogs by keyword of a PNG's texts; its Description is that of the texture."""
    keyword_of = {"title": "Title", "creator": "Author", "rights": "Copyright", "description": "Object"}
    return {keyword_of.get(key, key.capitalize().replace("_", " ")): text for key, text in entry.items()}


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
