"""`polcap export`: the asset of a result again, in other formats or for one program."""

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from typer import Context, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Json, Result, choice
from polcap.errors import SettingError
from polcap.formats.export.presets import EXTRAS, FORMATS, PRESETS

if TYPE_CHECKING:
    from polcap.formats.export.texture_set import Extra

_PRESET = f"Files for one program in asset/NAME/: {', '.join(PRESETS)}; repeatable."
_EXTRA = f"A further texture: {', '.join(EXTRAS)}; repeatable."
_FACTS = ("title", "creator", "rights", "license", "object_number", "date", "institution", "description")
_ABOUT = f"A fact for catalogs: {', '.join(_FACTS)}; repeatable."
_IIIF = "asset/NAME_iiif/, a relightable layer for museums; URL is where this folder will be served."
_PAGE = "Web page that shows the GLB with this model-viewer.min.js, without a network."
_COLOR = "Color space or OCIO role of the colors in the EXR, such as ACEScg."
_SIZE = "Longer side of the textures, px; by default each keeps its own size."
_TRIANGLES = "Most triangles of the mesh; engines have 20,000, web 50,000."
_GEOMETRY = "Mesh in the GLB: 32-bit floats, integers, or Draco (extra [draco])."
_OUT = "New result folder for the files, with a copy of the maps; an archive stays as it is."
_LEVEL = re.compile(r"_lod\d\.glb$")  # end of the name of a level of detail
Images = Annotated[Literal["png", "jpeg", "webp", "ktx2"] | None, choice("Picture format in the GLB.")]
Geometry = Annotated[Literal["float", "quantized", "draco"] | None, choice(_GEOMETRY)]
Bits = Annotated[Literal["8", "16"] | None, choice("Bits of a channel in PNG textures.", "8|16")]


def _names(meaning: str, names: Collection[str]) -> Any:
    """An option that may be repeated, with the names that the shell completes."""
    return Option(metavar="NAME", help=meaning, autocompletion=options.completion(names))


def export(
    context: Context,
    result: Result,
    gltf: Annotated[bool, Option("--gltf", help="asset/NAME.glb")] = False,
    obj: Annotated[bool, Option("--obj", help="asset/NAME.obj, .mtl and textures")] = False,
    ply: Annotated[bool, Option("--ply", help="asset/NAME.ply, the mesh with a color per vertex")] = False,
    stl: Annotated[bool, Option("--stl", help="asset/NAME.stl, the mesh alone, for printing")] = False,
    usd: Annotated[bool, Option("--usd", help="asset/NAME.usdc and textures (extra [usd])")] = False,
    usdz: Annotated[bool, Option("--usdz", help="asset/NAME.usdz, one file for phones (extra [usd])")] = False,
    materialx: Annotated[bool, Option("--materialx", help="asset/NAME.mtlx and textures")] = False,
    exr: Annotated[bool, Option("--exr", help="asset/NAME_layers.exr, every map as a layer")] = False,
    sfp: Annotated[bool, Option("--sfp", help="asset/NAME_sfp/, for codes of shape from polarization")] = False,
    preset: Annotated[list[str] | None, _names(_PRESET, PRESETS)] = None,
    images: Images = None,
    geometry: Geometry = None,
    triangles: Annotated[int | None, Option(min=16, help=_TRIANGLES)] = None,
    color: Annotated[str, Option(metavar="SPACE", help=_COLOR)] = "lin_rec709",
    texture_size: Annotated[int | None, Option(min=16, max=16384, help=_SIZE)] = None,
    page: Annotated[Path | None, Option(metavar="JS", help=_PAGE)] = None,
    iiif: Annotated[str | None, Option(metavar="URL", help=_IIIF)] = None,
    about: Annotated[list[str] | None, Option(metavar="K=V", help=_ABOUT)] = None,
    extra: Annotated[list[str] | None, _names(_EXTRA, EXTRAS)] = None,
    bits: Bits = None,
    out: Annotated[Path | None, Option(metavar="DIR", help=_OUT)] = None,
    lod: Annotated[int, Option(min=0, max=6, help="Further GLBs, each with a quarter of triangles and texels.")] = 0,
    json: Json = False,
) -> None:
    """Write the asset again from a result's maps; without a flag as GLB and OBJ."""
    from polcap import api
    from polcap.pipeline.export_request import ExportRequest

    formats = tuple(name for name in FORMATS if context.params[name] not in (None, False))
    plain = ExportRequest(
        formats=formats,
        images=images,
        geometry=geometry,
        triangles=triangles,
        color=color,
        texture_size=texture_size,
        bits=None if bits is None else 8 if bits == "8" else 16,
        extras=cast("tuple[Extra, ...]", tuple(dict.fromkeys(extra or []))),  # checked by the export
        page=page,
        iiif=None if iiif is None else options.utf8("--iiif", iiif),
        catalog=_catalog_fields(about or []),
        lod=lod,
    )
    wanted = [replace(plain, preset=name) for name in dict.fromkeys(map(str.lower, preset) if preset else [None])]
    options.warn_of_altered_archive(result)
    files = api.write_exports(result, *wanted, out=out)
    result = out or result
    options.warn_of_outdated_exports(result, [file for file in files if file.name.endswith(".provenance.json")])
    if triangles is None:
        _print_reduced(result, [one.preset for one in wanted])
    if (missing := lod * len(wanted) - sum(bool(_LEVEL.search(file.name)) for file in files)) > 0:
        stated = f"{missing} of {lod * len(wanted)} levels of --lod"
        terminal.print_message(f"polcap: {stated} would differ by over 1 % of the size: not written")
    for name in plain.extras:
        if not any(file.name.endswith(f"_{name.replace('-', '')}.png") for file in files):
            terminal.print_message(f"polcap: --extra {name} is left out: this kind of result has none", "WARNING")
    if texture_size is not None:
        _warn_of_upsampling(result, texture_size)
        _warn_of_odd_size(texture_size, [one.preset for one in wanted])
    terminal.print_written(files, json)


def _print_reduced(result: Path, presets: Sequence[str | None]) -> None:
    """Print the number of triangles of presets that reduce the mesh, and the option that changes it."""
    from polcap.formats import text_file

    exports = text_file.read_json(result / "maps" / "maps.json")["exports"]
    for folder in (f"asset/{preset}" for preset in presets if preset is not None):
        mesh = exports[folder]["mesh"]
        if "error" in mesh:
            terminal.print_progress(
                f"polcap: {folder} has {mesh['triangles']:,} triangles; 99 % of the full mesh are within "
                f"{mesh['error']}, its detail is in the normal texture; --triangles N changes the number"
            )


def _warn_of_upsampling(result: Path, size: int) -> None:
    """Print a warning if the textures are larger than the maps, with the setting that gives more detail."""
    from polcap.formats import text_file
    from polcap.fusion import fused_maps

    map_px = max(text_file.read_json(result / "maps" / "maps.json").get("size", [size]))
    if size > map_px:
        setting = "fusion.atlas.size" if fused_maps.is_fused(result) else "hdr.demosaic=full"
        terminal.print_message(
            f"polcap: textures of {size} px are {size / map_px:.2g} times as wide as the maps ({map_px} px); "
            f"for more detail use --set {setting}, or photograph from nearer",
            "WARNING",
        )


def _warn_of_odd_size(size: int, presets: Sequence[str | None]) -> None:
    """Print a warning if an engine, which needs sides that are powers of two, gets textures of another size."""
    power = 2 ** round(math.log2(size))
    if size != power and (engines := [name for name in presets if name is not None and PRESETS[name].powers]):
        terminal.print_message(
            f"polcap: --texture-size {size} is no power of two, as {', '.join(engines)} compresses and mipmaps it; "
            f"use {power}",
            "WARNING",
        )


def _catalog_fields(stated: Sequence[str]) -> dict[str, str]:
    """Parse --about K=V: fields of `CatalogEntry` by name, not yet checked. Raises SettingError for another form."""
    found: dict[str, str] = {}
    for text in stated:
        key, equals, value = options.utf8("--about", text).partition("=")
        if not equals:
            raise SettingError(f'--about {text}: write FACT=TEXT, for example title="Vase with handles"')
        if key in found:
            raise SettingError(f"--about {key} is stated twice: {found[key]!r} and {value!r}; give it once")
        found[key] = value
    return found
