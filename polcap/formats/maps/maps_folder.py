"""Writes and reads the folder maps/ of a result (docs/reference/result.md)."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from polcap import parallel
from polcap.errors import DecodeError
from polcap.formats import atomic, text_file
from polcap.formats.maps import exr, map_files, png
from polcap.image_values import Bools, Floats, View
from polcap.optics import color
from polcap.results import Results
from polcap.stage_values import SurfaceMaps

CONVENTIONS = {
    "frame": "camera: x right, y up, z toward the camera; a normal facing the camera is (0, 0, 1)",
    "normals": "+Y (OpenGL)",
    "pixels": "row 0 on top; pixel centres on whole numbers",
    "raw_pixel": "map pixel (i, j) is centred on visible RAW pixel crop[0:2] + scale * (i, j) + (scale - 1) / 2",
    "point": "map pixel (i, j) at depth d is d * ((i - cx) / f, -(j - cy) / f, -1), f and (cx, cy) of camera",
    "angles": "polarizer and AoLP from image x toward image up, counter-clockwise as the photographer sees it",
    "color": "linear Rec.709, D65; PNG of colors is sRGB-encoded",
    "outside": "values outside mask.png mean nothing; they are 0, and (0, 0, 1) in normal.png",
}

_DETAIL_MEANING = (
    "8 bit, 128 + 50 ln(a / b): albedo a of RAW pixels, crop[0:2] + (i, j), over diffuse b, enlarged linearly; "
    "0 where shading or noise explains the photograph's detail"
)

_ERROR_MEANINGS = {
    "diffuse_error.exr": "expected error of diffuse, 1 sigma, mean of the channels, if chart and object had the same "
    "light; half",
    "roughness_error.exr": "expected error of roughness, 1 sigma; half",
}

_Side = Annotated[int, Meta(ge=1, le=1 << 16)]
_Positive = Annotated[float, Meta(ge=1e-6, le=1e9)]
_Place = Annotated[float, Meta(ge=-1e9, le=1e9)]


class _Camera(Struct, frozen=True):
    focal_px: _Positive
    center_px: tuple[_Place, _Place]
    focal_known: bool


class _Depth(Struct, frozen=True):
    unit: Literal["m", "relative"]


class _Albedo(Struct, frozen=True):
    uncertainty_percent: Annotated[float, Meta(ge=0)] | None = None

    @property
    def sigma(self) -> float | None:
        """Relative 1σ of the scale of all albedos; None: unknown."""
        return None if self.uncertainty_percent is None else round(self.uncertainty_percent / 100, 3)


class LevelNote(Struct, frozen=True):
    """Record of a level of detail in maps.json."""

    triangles: int
    error: str = ""  # distance from the full mesh, with its unit
    screen_px: int | None = None  # greatest height on the screen at which the level equals the full mesh
    bytes: int = 0


class _Export(Struct, frozen=True):
    """Facts of exports in maps.json; later exports add to these."""

    glb: dict[str, str] = {}
    lods: dict[str, LevelNote] = {}
    textures: dict[str, str] = {}


class MapsFile(Struct, frozen=True):
    """Keys that the maps.json of every result has."""

    albedo: _Albedo = _Albedo()
    exports: dict[str, _Export] = {}


class _Description(MapsFile, frozen=True, kw_only=True):
    """The keys of maps.json (crop, size, camera, depth unit…) that `read` needs."""

    crop: tuple[_Place, _Place, _Place, _Place]
    size: tuple[_Side, _Side]
    scale: _Positive
    camera: _Camera
    depth: _Depth
    estimator: str
    sizes: dict[str, tuple[_Side, _Side]] = {}
    maps: dict[str, str] = {}


@dataclass(frozen=True, kw_only=True, repr=False)
class ResultMaps(SurfaceMaps):
    """All maps of a result, with its depth."""

    depth: Floats  # (H, W) along the optical axis, growing away from the camera; NaN outside the mask
    metric: bool  # depth is in metres; otherwise its median is 1


def write(folder: Path, results: Results) -> None:
    """Write the folder maps/ of a result: every map as EXR, the main ones as PNG too, and maps.json.

    Of the mesh, only the depth (H, W) is written. All images are on the crop (H, W) of the maps. Files are encoded on
    threads. If one cannot be written, all files of an earlier run stay.
    """
    maps, mesh = results.maps, results.mesh
    near, median, far = map_files.depth_range(maps, mesh)
    depth = {"unit": "m" if mesh.metric else "relative", "near": near, "median": median, "far": far}
    description = _description(maps, depth)
    with atomic.folder_of_files(folder, "maps.json") as temporary:
        parallel.results(
            partial(_write, temporary / name, partial(encode, *(getattr(results, source) for source in sources)))
            for name, (sources, encode) in map_files.FILES.items()
            if name in description["maps"]
        )
        atomic.write_json(temporary / "maps.json", {**description, "keys": dict(results.keys)})


def _write(file: Path, content: Callable[[], Any]) -> None:
    """Write one file of the folder maps/: an .exr of channels, or a .png of pixels."""
    if file.suffix == ".exr":
        exr.write(file, content(), half=file.stem not in map_files.FLOAT_FILES)
    else:
        png.write(file, content(), srgb=file.name in map_files.SRGB)


def read(folder: Path) -> ResultMaps:
    """Read the folder maps/ of a result that `write` wrote: EXRs, mask.png and maps.json.

    Raises DecodeError: a file is missing, damaged, or not of the size in maps.json, or as `require_picture`.
    """
    folder = Path(folder)
    require_picture(folder)
    try:
        about = msgspec.convert(text_file.read_json(folder / "maps.json"), _Description)
    except OSError as error:
        raise DecodeError(
            f"{folder / 'maps.json'}: cannot be read ({error.strerror}); give a result's folder"
        ) from error
    except ValueError as error:
        raise DecodeError(f"{folder / 'maps.json'} is not a maps.json of polcap ({error}); process again") from error
    origin = (about.crop[0] / about.scale, about.crop[1] / about.scale)
    view = View(about.camera.focal_px, about.camera.center_px, about.scale, origin, about.camera.focal_known)
    inside = read_mask(folder / "mask.png", about.size)
    normal, diffuse, specular = (
        read_map(folder, name, "RGB", about.size) for name in ("normal", "diffuse", "specular")
    )
    roughness, confidence = (read_map(folder, name, "Y", about.size) for name in ("roughness", "confidence"))
    with_errors = "diffuse_error.exr" in about.maps
    return ResultMaps(
        normal=normal,
        diffuse=diffuse,
        specular=specular,
        roughness=roughness,
        depth_prior=None,
        confidence=confidence,
        mask=inside,
        view=view,
        estimator=about.estimator,
        albedo_sigma=about.albedo.sigma,
        detail=_read_detail(folder, about.size) if map_files.DETAIL in about.sizes else None,
        diffuse_error=read_map(folder, "diffuse_error", "Y", about.size) if with_errors else None,
        roughness_error=read_map(folder, "roughness_error", "Y", about.size) if with_errors else None,
        depth=np.where(inside, read_map(folder, "depth", "Z", about.size), np.nan).astype(np.float32),
        metric=about.depth.unit == "m",
    )


def _read_detail(folder: Path, size: tuple[int, int]) -> Floats:
    """The logarithm (2H, 2W) in detail.png."""
    levels = png.read(folder / map_files.DETAIL)
    if levels.dtype != np.uint8 or levels.shape != (2 * size[1], 2 * size[0]):
        raise DecodeError(f"{folder / map_files.DETAIL} is not {2 * size[0]} × {2 * size[1]} of 8 bits; process again")
    return map_files.detail_of(np.asarray(levels, np.uint8))


def note_export(folder: Path, where: str, about: Mapping[str, Any]) -> None:
    """Add the record `about` of an export into the folder `where` to maps.json; facts on its earlier files stay."""
    file = folder / "maps.json"
    content = text_file.read_json(file)  # as `read` has checked it
    exports = content.get("exports", {})
    earlier = exports.get(where, {})
    replaced = ("mesh", "facts", "lods")
    note = {
        key: {**earlier.get(key, {}), **value} if isinstance(value, dict) and key not in replaced else value
        for key, value in about.items()
    }
    note.setdefault("lods", earlier.get("lods", {}))  # of a GLB that this export does not write
    content["exports"] = dict(sorted({**exports, where: note}.items()))
    atomic.write_json(file, content)


def read_exports(folder: Path) -> dict[str, _Export]:
    """Records of the exports of a result by folder, from maps.json; empty where it cannot be read."""
    try:
        return msgspec.convert(text_file.read_json(folder / "maps.json"), MapsFile).exports
    except (OSError, ValueError):
        return {}


def require_picture(folder: Path) -> None:
    """Raise a DecodeError unless a folder maps/ is that of one view: a fused object or a material has textures."""
    if read_format(folder).startswith(("polcap fused", "polcap material")):
        raise DecodeError(
            f"{folder} holds the textures of a fused object or of a material, not the maps of a picture; give one "
            "of its views, or read the files listed in its maps.json"
        )


def read_format(folder: Path) -> str:
    """The format that maps.json of a folder maps/ states, which names the kind of result; empty without one."""
    try:
        return str(text_file.read_json(folder / "maps.json")["format"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def write_textures(folder: Path, maps: Any, letters: Mapping[str, str], full: Collection[str]) -> None:
    """Write maps (H, W[, C]), attributes of `maps`, as EXRs with the channels `letters`; those not in `full` as half.

    Normal, albedo, F0 and roughness are written as PNG too.
    """
    for name, channels in letters.items():
        value = np.atleast_3d(getattr(maps, name))
        planes = {letter: np.ascontiguousarray(value[..., k]) for k, letter in enumerate(channels)}
        exr.write(folder / f"{name}.exr", planes, half=name not in full)
    png.write(folder / "normal.png", png.sixteen_bits(maps.normal / 2 + 0.5))
    png.write(folder / "diffuse.png", color.srgb_eight_bits(maps.diffuse), srgb=True)
    png.write(folder / "specular.png", color.srgb_eight_bits(maps.specular), srgb=True)
    png.write(folder / "roughness.png", png.sixteen_bits(maps.roughness))


def read_mask(file: Path, size: tuple[int, int]) -> Bools:
    """Read a mask (H, W) that has this size (W, H). Raises DecodeError: it is missing, damaged, or of another size."""
    levels = png.read(_existing(file))
    if levels.shape != size[::-1]:
        raise DecodeError(f"{file} is not {size[0]} × {size[1]}; process again")
    return np.asarray(levels > 127)


def _existing(file: Path) -> Path:
    """The path of a file that exists. Raises DecodeError."""
    if not file.exists():
        raise DecodeError(f"{file} is missing; make the result again from the photographs")
    return file


def read_map(folder: Path, name: str, letters: str, size: tuple[int, int]) -> Floats:
    """Read the channels `letters` of one map's EXR as an array (H, W, C), or (H, W) for one channel.

    Raises DecodeError: the file is missing, damaged, not of this size (W, H), or a value is not finite.
    """
    file = _existing(folder / f"{name}.exr")
    found = exr.read(file)
    planes = [found[letter] for letter in letters if letter in found]
    if len(planes) != len(letters) or planes[0].shape != size[::-1]:
        raise DecodeError(f"{file} is not {size[0]} × {size[1]} of {letters}; process again")
    values = np.stack(planes, axis=-1) if len(letters) > 1 else planes[0]
    if not np.isfinite(values).all():
        raise DecodeError(f"{file}: {(~np.isfinite(values)).sum()} values are not finite numbers; process again")
    return values


def _description(maps: SurfaceMaps, depth: Mapping[str, str | float]) -> dict[str, Any]:
    """The content of maps.json."""
    view = maps.view
    height, width = maps.mask.shape
    unit = depth["unit"]
    linear, encoded = "linear Rec.709", "8 bit, sRGB"
    return {
        "format": "polcap maps 1",
        "crop": raw_crop(view, width, height),
        "size": [width, height],
        "sizes": {} if maps.detail is None else {map_files.DETAIL: [2 * width, 2 * height]},
        "scale": _plain(view.scale),
        "camera": {
            "focal_px": float(view.focal),
            "center_px": [float(v) for v in view.center],
            "focal_known": view.known,
            "unit": "map pixels",
        },
        "depth": dict(depth),
        "estimator": maps.estimator,
        "albedo": albedo_scale(maps.albedo_sigma),
        "conventions": CONVENTIONS,
        "maps": {
            "normal.exr": "unit vectors: R x, G y, B z; float",
            "normal.png": "16 bit, n * 0.5 + 0.5",
            "depth.exr": f"Z: distance along the optical axis, growing away from the camera, {unit}; float",
            "depth.png": "16 bit, (depth - near) / (far - near)",
            "diffuse.exr": f"diffuse albedo rho_d, {linear}; half",
            "diffuse.png": encoded,
            "specular.exr": f"specular albedo F0, {linear}; half",
            "specular.png": encoded,
            "roughness.exr": "perceptual roughness, alpha = roughness squared, linear; half",
            "roughness.png": "16 bit, linear",
            "photograph.png": "S0 of the whole crop, linear Rec.709 with chart white = its reflectance; 8 bit, sRGB",
            "mask.png": "8 bit, 255 on the object",
            **({} if maps.detail is None else {map_files.DETAIL: _DETAIL_MEANING}),
            "confidence.exr": "expected error of the normal, degrees; half",
            **({} if maps.diffuse_error is None else _ERROR_MEANINGS),
            "stokes.exr": "S0.R ... S2.B in camera channels, linear, sensor white at the reference exposure = 1; half",
            "stokes_covariance.exr": "sigma.S0.R ... sigma.S2.B, 1 sigma of each channel of stokes.exr; their "
            "correlations, correlation.S0S1.R ... correlation.S1S2.B; photon and read noise; half",
            "cues.exr": "dolp; aolp in degrees, 0 ... 180; normalized.S1, normalized.S2; diffuse_color.R, .G, .B; "
            "with a cross-polarized shot the two parts of S0 as photograph.png has it, linear: scattered.R, .G, .B and "
            "mirrored.R, .G, .B; half",
        },
    }


def albedo_scale(sigma: float | None) -> dict[str, Any]:
    """Whether the scale of all albedos is known, and its 1σ, for maps.json and the GLB; None: no chart."""
    return {
        "scale": "relative" if sigma is None else "known",
        "uncertainty_percent": None if sigma is None else round(100 * sigma, 1),
    }


def raw_crop(view: View, width: int, height: int) -> list[int | float]:
    """x0, y0, x1, y1 of a crop in visible RAW pixels of the reference shot, end exclusive."""
    x, y = view.origin
    return [_plain(edge * view.scale) for edge in (x, y, x + width, y + height)]


def _plain(value: float) -> int | float:
    return int(value) if float(value).is_integer() else float(value)
