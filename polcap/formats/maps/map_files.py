"""Content of each file of a result's folder maps/: the channels of an .exr, or the pixels of a .png."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.formats.maps import png
from polcap.image_values import Bools, Floats
from polcap.mesh_values import ReliefMesh
from polcap.optics import color
from polcap.stage_values import Cues, StokesImage, SurfaceMaps

Source = Literal["maps", "mesh", "stokes", "cues"]


def object_depth(maps: SurfaceMaps, mesh: ReliefMesh) -> Floats:
    """Depth map (H, W) of the mesh on the object's pixels, 0 outside."""
    return np.where(maps.mask & np.isfinite(mesh.depth), mesh.depth, 0.0).astype(np.float32)


def depth_range(maps: SurfaceMaps, mesh: ReliefMesh) -> tuple[float, float, float]:
    """Least, median and greatest depth of the mesh on the object; 0, ½ and 1 if it has no pixels."""
    depth = object_depth(maps, mesh)
    inside = depth[depth > 0]
    least, median, greatest = (float(q) for q in np.quantile(inside, (0, 0.5, 1))) if inside.size else (0.0, 0.5, 1.0)
    return least, median, greatest


def _depth_picture(maps: SurfaceMaps, mesh: ReliefMesh) -> NDArray[np.uint16]:
    """Depth as 16 bits from the nearest to the farthest point of the object; 0 outside."""
    near, _, far = depth_range(maps, mesh)
    depth = object_depth(maps, mesh)
    return png.sixteen_bits(np.where(depth > 0, (depth - near) / max(far - near, 1e-9), 0))


def _normal_picture(maps: SurfaceMaps) -> NDArray[np.uint16]:
    """Normals n·½ + ½ as 16 bits; (0, 0, 1) outside the object."""
    flat = np.where(maps.mask[..., None], maps.normal, [0.0, 0.0, 1.0])
    return png.sixteen_bits(flat / 2 + 0.5)


def masked(values: Floats, inside: Bools) -> Floats:
    """A copy of an image (H, W[, C]) with 0 outside the mask `inside`."""
    return np.where(inside if values.ndim == 2 else inside[..., None], values, 0).astype(np.float32)


def _channels(names: str, values: Floats) -> dict[str, Floats]:
    return {name: values[..., k] for k, name in enumerate(names)}


def _stokes_channels(stokes: StokesImage) -> dict[str, Floats]:
    return {f"S{s}.{c}": stokes.stokes[s, ..., k] for s in range(3) for k, c in enumerate("RGB")}


STOKES_PAIRS = ((0, 1), (0, 2), (1, 2))


def _covariance_channels(stokes: StokesImage) -> dict[str, Floats]:
    """1σ of S0, S1 and S2, and their correlations: half floats hold both, but no small variances."""
    s00, s01, s02, s11, s12, s22 = stokes.covariance
    sigma = np.sqrt(np.maximum([s00, s11, s22], 0))
    channels = {f"sigma.S{s}.{c}": _rounded(sigma[s, ..., k]) for s in range(3) for k, c in enumerate("RGB")}
    for (i, j), covariance in zip(STOKES_PAIRS, (s01, s02, s12)):
        correlation = covariance / np.maximum(sigma[i] * sigma[j], 1e-20)
        channels |= {f"correlation.S{i}S{j}.{c}": _rounded(correlation[..., k]) for k, c in enumerate("RGB")}
    return channels


def _rounded(values: Floats) -> Floats:
    """Values (H, W) rounded to 5 bits of mantissa, 1.6 %: enough for an error, and small when compressed."""
    bits = values.astype(np.float16).view(np.uint16)  # with 10 bits of mantissa
    return ((bits + np.uint16(0x10)) & np.uint16(0xFFE0)).view(np.float16)


def _cue_channels(cues: Cues) -> dict[str, Floats]:
    aolp = np.degrees(np.arctan2(cues.normalized_stokes[1], cues.normalized_stokes[0]) / 2) % 180.0
    return {
        "dolp": cues.dolp,
        "aolp": aolp,
        "normalized.S1": cues.normalized_stokes[0],
        "normalized.S2": cues.normalized_stokes[1],
        **{f"diffuse_color.{c}": cues.diffuse_color[..., k] for k, c in enumerate("RGB")},
        **_separated(cues),
    }


def _separated(cues: Cues) -> dict[str, Floats]:
    """Diffuse and specular part of S0 as maps, if a cross-polarized shot separates them; otherwise none."""
    if cues.body is None or cues.body_known is None:
        return {}
    body = masked(cues.body, cues.body_known)
    mirrored = masked(np.maximum(cues.radiance - cues.body, 0), cues.body_known)
    parts = {"scattered": body, "mirrored": mirrored}
    return {f"{name}.{c}": part[..., k] for name, part in parts.items() for k, c in enumerate("RGB")}


SRGB = ("photograph.png", "diffuse.png", "specular.png")  # pictures of colors
DETAIL = "detail.png"  # of twice the size of the other files; only of Bayer cameras
_DETAIL_STEPS = 50  # per unit of the logarithm


def detail_levels(detail: Floats) -> NDArray[np.uint8]:
    """The levels (2H, 2W) of detail.png, 128 + 50 ln, of a logarithm (2H, 2W) float16."""
    half = np.arange(1 << 16, dtype=np.uint16).view(np.float16)  # all: a table is ten times as fast as half floats
    with np.errstate(over="ignore"):
        level = np.rint(np.clip(np.nan_to_num(half) * np.float16(_DETAIL_STEPS), -127, 127)) + 128
    return np.asarray(level.astype(np.uint8)[detail.view(np.uint16)])


def detail_of(levels: NDArray[np.uint8]) -> Floats:
    """The logarithm (2H, 2W) float16 of the levels of detail.png."""
    table = (np.arange(256, dtype=np.float32) - 128) / _DETAIL_STEPS
    return np.asarray(table.astype(np.float16)[levels])


FLOAT_FILES = ("depth", "normal")  # .exr files of 32 bits; the others are half
# inputs of each file, and the function for its content; the slowest first
FILES: Mapping[str, tuple[tuple[Source, ...], Callable[..., Any]]] = {
    "stokes.exr": (("stokes",), _stokes_channels),
    "cues.exr": (("cues",), _cue_channels),
    "stokes_covariance.exr": (("stokes",), _covariance_channels),
    "normal.exr": (("maps",), lambda maps: _channels("RGB", masked(maps.normal, maps.mask))),
    "normal.png": (("maps",), _normal_picture),
    "photograph.png": (("cues",), lambda cues: color.srgb_eight_bits(cues.radiance)),
    "diffuse.png": (("maps",), lambda maps: color.srgb_eight_bits(masked(maps.diffuse, maps.mask))),
    "diffuse.exr": (("maps",), lambda maps: _channels("RGB", masked(maps.diffuse, maps.mask))),
    "specular.png": (("maps",), lambda maps: color.srgb_eight_bits(masked(maps.specular, maps.mask))),
    "specular.exr": (("maps",), lambda maps: _channels("RGB", masked(maps.specular, maps.mask))),
    "depth.exr": (("maps", "mesh"), lambda maps, mesh: {"Z": object_depth(maps, mesh)}),
    "depth.png": (("maps", "mesh"), _depth_picture),
    "roughness.exr": (("maps",), lambda maps: {"Y": masked(maps.roughness, maps.mask)}),
    "roughness.png": (("maps",), lambda maps: png.sixteen_bits(masked(maps.roughness, maps.mask))),
    "confidence.exr": (("maps",), lambda maps: {"Y": masked(maps.confidence, maps.mask)}),
    "diffuse_error.exr": (("maps",), lambda maps: {"Y": masked(maps.diffuse_error, maps.mask)}),
    "roughness_error.exr": (("maps",), lambda maps: {"Y": masked(maps.roughness_error, maps.mask)}),
    DETAIL: (("maps",), lambda maps: detail_levels(maps.detail)),
    "mask.png": (("maps",), lambda maps: np.where(maps.mask, 255, 0).astype(np.uint8)),
}
