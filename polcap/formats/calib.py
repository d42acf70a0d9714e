"""Reference colors of charts; color profiles of earlier captures (TOML)."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

from polcap.errors import ChartError, StorageError
from polcap.formats import atomic, text_file
from polcap.images import Bits, ChartReference, ColorCalibration, Floats
from polcap.optics.color import REC709_TO_XYZ, decode_srgb

_SOURCES = ("chart", "corners", "profile", "camera", "none")
_NAMES = {
    "classic": "ColorChecker Classic (since November 2014)",
    "classic_before_2014": "ColorChecker Classic (before November 2014)",
    "classic_srgb": "ColorChecker Classic (the maker's sRGB values)",
    "sg": "ColorChecker SG, block E2 to J5 (since November 2014)",
}
_TABLES = {  # of colour-science
    "classic": "ColorChecker24 - After November 2014",
    "classic_before_2014": "ColorChecker24 - Before November 2014",
    "sg": "ColorCheckerSG - After November 2014",
}
_EDITIONS = ("classic_before_2014", "classic_srgb")  # of a Classic, tried as well
_SG_BLOCK = tuple(f"{column}{row}" for row in (2, 3, 4, 5) for column in "EFGHIJ")
# Between the outer corners of the patches of the full-size card (279 × 216 mm): nominal patches of 40 mm, and a
# pitch of 40 mm / 0.874, the ratio found in photographs of five such cards (0.873–0.876). About 1 %.
_CLASSIC_SIZE_M = (0.269, 0.177)
_PACKAGE = Path(__file__).resolve().parents[1]


def data_path(name: str) -> Path:
    """The file `name` of the shipped calibration data, e.g. "colorchecker/classic_srgb.toml".

    In a checkout it lies in `calib/` beside the package, in an installed wheel in `polcap/_calib/`.

    Raises
    ------
    StorageError
        Neither place has it: the installation is incomplete.
    """
    for root in (_PACKAGE / "_calib", _PACKAGE.parent / "calib"):
        if (root / name).exists():
            return root / name
    raise StorageError(f"calibration data {name} is missing from this installation; install polcap again")


class _SrgbChart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    srgb: list[tuple[int, int, int]]


def colorchecker(kind: str = "classic") -> ChartReference:
    """Reference colors of a kind of ColorChecker: classic, classic_before_2014, classic_srgb or sg.

    The maker's measurements under D50 as tabulated by colour-science, adapted to D65 (Bradford). classic_srgb is
    the maker's sRGB table, a file of ours. Of an SG it is the block E2 to J5, which repeats the Classic's colors.
    """
    from polcap.optics.colour_science import colour

    classic = colour.CCS_COLOURCHECKERS[_TABLES["classic"]].data
    names = tuple(name.partition(" (")[0] for name in classic)
    if kind == "classic_srgb":
        file = _read(data_path("colorchecker/classic_srgb.toml"), _SrgbChart)
        return ChartReference(_NAMES[kind], decode_srgb(np.array(file.srgb) / 255), None, names)
    table = colour.CCS_COLOURCHECKERS[_TABLES[kind]]
    keys = _SG_BLOCK if kind == "sg" else tuple(table.data)
    xyz = colour.chromatic_adaptation(
        colour.xyY_to_XYZ([table.data[key] for key in keys]),
        colour.xy_to_XYZ(table.illuminant),
        colour.xy_to_XYZ(colour.RGB_COLOURSPACES["sRGB"].whitepoint),
        transform="Bradford",
    )
    return ChartReference(
        name=_NAMES[kind],
        rec709=xyz @ np.linalg.inv(REC709_TO_XYZ).T,
        size_m=_CLASSIC_SIZE_M if kind == "classic" else None,
        patches=tuple(f"{key} {name}" for key, name in zip(keys, names, strict=True)) if kind == "sg" else names,
        editions=tuple(map(colorchecker, _EDITIONS)) if kind == "classic" else (),
    )


class _Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    source: str
    cost: float = float("nan")
    delta_e: list[float] | None = None
    metres_per_px: float | None = None
    quads: list[list[list[float]]] | None = None
    corners: list[list[float]] | None = None
    falloff: tuple[float, float] = (0.0, 0.0)
    glare: float = 0.0
    predicted: list[float] | None = None
    patch_use: list[int] | None = None


def write_profile(path: Path, color: ColorCalibration) -> None:
    """Keep a colour calibration for other captures of the same camera, light and exposure."""
    document: dict[str, Any] = {
        "matrix": _rounded(color.matrix, 9),
        "source": color.source,
        "cost": float(color.cost),
        "delta_e": _rounded(color.delta_e, 3),
        "metres_per_px": color.metres_per_px,
        "quads": _rounded(color.quads, 3),
        "corners": _rounded(color.corners, 3),
        "falloff": list(color.falloff),
        "glare": color.glare,
        "predicted": _rounded(color.predicted, 3),
        "patch_use": None if color.patch_use is None else color.patch_use.tolist(),
    }
    text = (
        "# polcap colour profile. matrix: camera radiance (I0 + I90) -> linear Rec.709 reflectance.\n"
        "# quads, corners: px of the grid it was measured on. metres_per_px: at the chart's distance.\n"
    ) + tomli_w.dumps({key: value for key, value in document.items() if value is not None})
    with atomic.path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_profile(path: Path) -> ColorCalibration:
    """What `write_profile` wrote.

    Raises
    ------
    ChartError
        A missing or foreign file, a wrong shape, or a matrix that cannot be inverted.
    """
    profile = _read(path, _Profile)
    matrix = np.array(profile.matrix)
    measures = [*profile.falloff, profile.glare, profile.metres_per_px or 0.0]
    if not np.isfinite(measures).all():
        raise ChartError(f"{path}: falloff, glare or metres_per_px is not a finite number; write the profile again")
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix, rtol=1e-6) < 3:
        raise ChartError(f"{path}: its colour matrix cannot be inverted; write the profile again")
    if profile.source not in _SOURCES:
        raise ChartError(f'{path}: source = "{profile.source}" is none of {", ".join(_SOURCES)}')
    return ColorCalibration(
        matrix=matrix,
        quads=_shaped(profile.quads, (24, 4, 2), path, "quads"),
        corners=_shaped(profile.corners, (4, 2), path, "corners"),
        delta_e=_shaped(profile.delta_e, (24,), path, "delta_e"),
        source=profile.source,
        cost=profile.cost,
        metres_per_px=profile.metres_per_px,
        falloff=profile.falloff,
        glare=profile.glare,
        predicted=_shaped(profile.predicted, (24,), path, "predicted"),
        patch_use=_uses(profile.patch_use, path),
    )


def _read(path: Path, form: Any) -> Any:
    """A TOML file as `form`; ChartError says what is wrong with it."""
    try:
        return msgspec.convert(text_file.read_toml(path, finite=False), form)
    except OSError as error:
        raise ChartError(f"{path}: cannot be read ({error.strerror}); give a profile's path") from error
    except ValueError as error:
        raise ChartError(f"{path}: not a polcap colour file ({error})") from error


def _uses(values: list[int] | None, path: Path) -> Bits | None:
    found = _shaped(values, (24,), path, "patch_use")
    if found is not None and ((found < 0) | (found > 255)).any():
        raise ChartError(f"{path}: patch_use holds no small whole numbers; write the profile again")
    return None if found is None else found.astype(np.uint8)


def _rounded(values: Floats | None, digits: int) -> Any:
    return None if values is None else np.round(np.asarray(values, np.float64), digits).tolist()


def _shaped(values: Any, shape: tuple[int, ...], path: Path, name: str) -> Floats | None:
    if values is None:
        return None
    try:
        return np.array(values, dtype=np.float64).reshape(shape)
    except ValueError as error:
        raise ChartError(f"{path}: {name} has not the shape {shape}; write the profile again") from error
