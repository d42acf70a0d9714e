"""Data that ship with polcap: files of calib/ (models, camera tables) and the reference colors of charts."""

from pathlib import Path

import msgspec
import numpy as np

from polcap.chart_values import ChartReference
from polcap.errors import StorageError
from polcap.formats import chart_file, text_file
from polcap.image_values import Floats
from polcap.optics.color import decode_srgb

_NAMES = {
    "classic": "ColorChecker Classic (since November 2014)",
    "classic_before_2014": "ColorChecker Classic (before November 2014)",
    "classic_srgb": "ColorChecker Classic (the maker's sRGB values)",
    "sg": "ColorChecker SG (since November 2014)",
}
_TABLES = {  # of colour-science
    "classic": "ColorChecker24 - After November 2014",
    "classic_before_2014": "ColorChecker24 - Before November 2014",
    "sg": "ColorCheckerSG - After November 2014",
}
_EDITIONS = ("classic_before_2014", "classic_srgb")  # of a Classic, tried as well
# Between the outer corners of the patches of the full-size card (279 × 216 mm): nominal patches of 40 mm, and a
# pitch of 40 mm / 0.874, the ratio found in photographs of five such cards (0.873–0.876). About 1 %.
_CLASSIC_SIZE_M = (0.269, 0.177)
_PACKAGE = Path(__file__).resolve().parents[1]


def data_path(name: str) -> Path:
    """The path of a shipped file, e.g. "colorchecker/classic_srgb.toml". Raises StorageError.

    In a checkout it is in `calib/` next to the package, in an installed wheel in `polcap/_calib/`.
    """
    for root in (_PACKAGE / "_calib", _PACKAGE.parent / "calib"):
        if (root / name).exists():
            return root / name
    raise StorageError(f"calibration data {name} is missing from this installation; install polcap again")


def model_files(name: str = "") -> list[Path]:
    """Paths of the shipped network files with names that begin with `name`, the newest last."""
    return sorted(data_path("colorchecker").parent.glob(f"models/{name}*.onnx"))


class _SrgbChart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    srgb: list[tuple[int, int, int]]


def colorchecker(kind: str = "classic") -> ChartReference:
    """Reference colors of a ColorChecker: classic, classic_before_2014, classic_srgb, sg, or a file of measurements.

    The maker's measurements under D50 as tabulated by colour-science, adapted to D65 (Bradford). classic_srgb is
    the maker's sRGB table, a file of ours. Of an SG the block E2 to J5 repeats the Classic's colors; its other patches
    are the reference's `surroundings`.
    """
    if kind not in _NAMES:
        return chart_file.read(Path(kind))
    from polcap.optics.colour_science import colour

    classic = colour.CCS_COLOURCHECKERS[_TABLES["classic"]].data
    names = tuple(name.partition(" (")[0] for name in classic)
    if kind == "classic_srgb":
        file = msgspec.convert(text_file.read_toml(data_path("colorchecker/classic_srgb.toml")), _SrgbChart)
        return ChartReference(_NAMES[kind], decode_srgb(np.array(file.srgb) / 255), None, names)
    table = colour.CCS_COLOURCHECKERS[_TABLES[kind]]
    keys = chart_file.SG_BLOCK if kind == "sg" else tuple(table.data)

    def colors(patches: tuple[str, ...]) -> Floats:
        return chart_file.to_rec709(colour.xyY_to_XYZ([table.data[key] for key in patches]), table.illuminant)

    return ChartReference(
        name=_NAMES[kind],
        rec709=colors(keys),
        size_m=_CLASSIC_SIZE_M if kind == "classic" else None,
        patches=tuple(f"{key} {name}" for key, name in zip(keys, names, strict=True)) if kind == "sg" else names,
        is_block=kind == "sg",
        surroundings=chart_file.surroundings(colors(chart_file.SG_SURROUNDINGS)) if kind == "sg" else None,
        editions=tuple(map(colorchecker, _EDITIONS)) if kind == "classic" else (),
    )
