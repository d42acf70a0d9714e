"""Exports the asset of a result in the formats of a preset, with a record of its provenance.

Both `process` and `polcap export` build the asset from the maps as stored in their files. So the same result gives the
same bytes, with any number of threads.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
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

_Writer = Callable[[], list[Path]]  # returns the files that it has written
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
    """Raise a SettingError for an unknown preset or a missing package, before anything is computed."""
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
    preset, mesh = _preset(wanted), whole.mesh
    name = atomic.safe_name(str(about["capture"].get("name")))  # files stay in the folder, whatever name the report has
    stem = preset.name.format(obj.stem(name) if preset.textures else name)
    shared: dict[Key, str] = {key: f"{obj.stem(stem)}_{key}.png" for key in texture_set.LOOSE}
    loose = {f"{pattern.format(obj.stem(name))}.png": make(whole) for pattern, make in preset.textures.items()}
    if _SHARING.intersection(preset.formats):
        loose |= {file: texture_set.LOOSE[key](whole) for key, file in shared.items()}
    folder, images = out / "asset" / (wanted.preset or ""), wanted.images or preset.images
    unit, record, encoder = "m" if mesh.metric else "relative", provenance.record(about), TextureEncoder()
    words = {"unit": unit, "normals": "+Y (OpenGL)", **provenance.words(record)}
    comment = f"polcap; unit of length: {unit}; normals +Y (OpenGL); made from: {stem}.provenance.json"
    layered = folder / f"{stem}_layers.exr"
    writers: dict[Format, _Writer] = {
        "gltf": partial(_write_glb, folder / f"{stem}.glb", whole, images, words, encoder),
        "obj": partial(obj.write, folder / f"{stem}.obj", whole, stem, shared, comment),
        "usd": partial(_one, usd.write, folder / f"{stem}.usdc", whole, stem, shared, words),
        "materialx": partial(_one, materialx.write, folder / f"{stem}.mtlx", whole, stem, shared, comment),
        "exr": partial(_one, exr_layers.write, layered, out / "maps", wanted.color, words),
    }
    coarser = {folder / f"{stem}_lod{k}.glb": level for k, level in enumerate(levels, 1)}
    tasks = [writers[one] for one in preset.formats]
    tasks += [partial(_write_glb, file, level.asset, images, words, encoder) for file, level in coarser.items()]
    tasks += [partial(_write_texture, folder / file, texture, encoder) for file, texture in loose.items()]
    written = [file for files in parallel.results(tasks) for file in files]  # pictures are encoded on threads
    sidecar = folder / f"{stem}.provenance.json"
    provenance.write(sidecar, record, {file.name: provenance.digest(file) for file in written})
    embedded = gltf.textures(whole) if "gltf" in preset.formats else {}
    description = {
        "for": preset.description,
        "unit": unit,
        "glb": {f"{stem}_{key}": f"{texture.meaning}; {images}" for key, texture in embedded.items()},
        "lods": {file.name: _deviation(level.decimated) for file, level in coarser.items()},
        "textures": {file: texture.meaning for file, texture in sorted(loose.items())},
    }
    maps_folder.note_export(out / "maps", folder.relative_to(out).as_posix(), description)
    return [*written, sidecar]


def _preset(wanted: ExportRequest) -> ExportPreset:
    if wanted.preset is None:
        return ExportPreset(wanted.formats, "normals +Y")
    if wanted.preset not in PRESETS:
        raise SettingError(f"--preset {wanted.preset} is none of {', '.join(PRESETS)}")
    return PRESETS[wanted.preset]


def _one(write_file: Callable[..., None], file: Path, *content: Any) -> list[Path]:
    """Write one file of an export; returns it."""
    write_file(file, *content)
    return [file]


def _write_glb(
    file: Path, content: Asset, images: Kind, words: Mapping[str, str], encoder: TextureEncoder
) -> list[Path]:
    gltf.write(file, content, file.stem, images, words, encoder)
    return [file]


def _write_texture(file: Path, texture: Texture, encoder: TextureEncoder) -> list[Path]:
    with atomic.path(file) as temporary:
        temporary.write_bytes(encoder(texture, "png", text=True))
    return [file]


def _deviation(coarse: surface.DecimatedMesh) -> dict[str, Any]:
    """Size of a coarser mesh, and its distance from the full one, for maps.json."""
    error = f"{1000 * coarse.error:.4g} mm" if coarse.mesh.metric else f"{coarse.error_px:.3g} px"
    return {"triangles": len(coarse.mesh.faces), "error": error}
