"""The user's choice for an export, its checks, and the preset that follows from it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from polcap.capture_values import CatalogEntry
from polcap.errors import SettingError
from polcap.formats import text_file
from polcap.formats.export import exr_layers, glb_geometry, iiif, usd, web_page
from polcap.formats.export.encoders import Kind
from polcap.formats.export.glb_geometry import Geometry
from polcap.formats.export.presets import EXTRAS, FORMATS, PRESETS, ExportPreset, Format
from polcap.formats.export.texture_set import Extra

_OF_IIIF: tuple[Extra, ...] = ("object-normal",)  # textures that the format `iiif` needs


@dataclass(frozen=True)
class ExportRequest:
    """The user's choice for an export: file formats or a preset, and options."""

    formats: tuple[Format, ...] = ()  # by default the preset's, or gltf and obj
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


def check(wanted: ExportRequest) -> None:
    """Raise a SettingError for an unknown name, a missing package or an option without effect, before any work."""
    _check_values(wanted)
    if wanted.preset and (others := [name for name in wanted.formats if name != "iiif"]):
        raise SettingError(f"--preset {wanted.preset} brings its formats; write {others[0]} by a second export")
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
                if "," in str(name) and option in ("--preset", "--extra"):
                    hint = f"repeat the option: {' '.join(f'{option} {one.strip()}' for one in str(name).split(','))}"
                raise SettingError(f"{option} {name}: there is no such {noun}; {hint}")
    for name, text in wanted.catalog.items():
        if not isinstance(text, str):
            raise SettingError(f"--about {name} = {text!r:.60}: it is no text; put it in quotes")
    numbers = (("texture-size", wanted.texture_size, 16), ("triangles", wanted.triangles, 16), ("lod", wanted.lod, 0))
    for option, number, least in numbers:
        if number is not None and (not isinstance(number, int) or number < least):
            raise SettingError(f"--{option} {number!r}: it is a whole number of at least {least}; give one, or none")


def _has_png(preset: ExportPreset) -> bool:
    """Whether an export writes a PNG texture, next to the GLB or in it."""
    inside = preset.images == "png" and "gltf" in preset.formats
    separate = preset.shared == "png" and not {"obj", "usd", "usdz", "materialx"}.isdisjoint(preset.formats)
    return inside or separate or bool(preset.textures or preset.extras)


def without(request: ExportRequest, extras: Collection[Extra]) -> ExportRequest:
    """The request for a result of several views: without the layered EXR of a preset, and without some textures."""
    formats: tuple[Format, ...] = () if request.preset is None else ("exr",)
    return replace(request, without=formats, extras=tuple(one for one in request.extras if one not in extras))


def effective(wanted: ExportRequest) -> ExportPreset:
    """The preset that an export uses: the requested one, with its values replaced by the request's other options."""
    plain = ExportPreset("normals +Y", wanted.formats or ("gltf", "obj"))
    preset = plain if wanted.preset is None else PRESETS[wanted.preset]
    added: tuple[Format, ...] = () if wanted.iiif is None else ("iiif",)
    formats = tuple(one for one in dict.fromkeys((*preset.formats, *added)) if one not in wanted.without)
    return replace(
        preset,
        images=wanted.images or preset.images,
        geometry=wanted.geometry or preset.geometry,
        triangles=wanted.triangles or preset.triangles,
        bits=wanted.bits or preset.bits,
        formats=formats,
        extras=(*preset.extras, *wanted.extras, *(_OF_IIIF if "iiif" in formats else ())),
    )
