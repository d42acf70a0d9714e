"""In: calibration files (TOML). Out: a chart's reference colours, colour profiles of earlier captures."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

from polcap.errors import ChartError, StorageError
from polcap.formats import atomic, text_file
from polcap.images import Bits, ChartReference, ColorCalibration, Floats

_SOURCES = ("chart", "corners", "profile", "camera", "none")
_PACKAGE = Path(__file__).resolve().parents[1]


def data_path(name: str) -> Path:
    """The file `name` of the shipped calibration data, e.g. "colorchecker/classic.toml".

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


class _Patch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    xyY: tuple[float, float, float]
    rec709: tuple[float, float, float]


class _Chart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    illuminant: tuple[float, float]
    rows: int
    columns: int
    patch: list[_Patch]
    size_m: tuple[float, float] | None = None
    editions: tuple[str, ...] = ()


def colorchecker(kind: str = "classic", path: Path | None = None) -> ChartReference:
    """The reference colours of a shipped kind of ColorChecker (classic, sg), or of a file of the same form.

    Other editions that the file names are read from beside it.

    Raises
    ------
    ChartError
        A file that is not TOML, or does not describe a chart of 4 rows of 6 patches.
    """
    path = path or data_path(f"colorchecker/{kind}.toml")
    chart = _read(path, _Chart)
    if (chart.rows, chart.columns, len(chart.patch)) != (4, 6, 24):
        raise ChartError(
            f"{path}: {chart.rows} rows × {chart.columns} columns with {len(chart.patch)} patches; "
            "polcap reads charts of 4 × 6 = 24 patches"
        )
    return ChartReference(
        name=chart.name,
        rec709=np.array([patch.rec709 for patch in chart.patch]),
        size_m=chart.size_m,
        patches=tuple(patch.name.partition(" (")[0] for patch in chart.patch),
        editions=tuple(colorchecker(path=path.with_name(f"{name}.toml")) for name in chart.editions),
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
