"""Reads a measured color chart: CGATS (.ti3, .cie, .txt) or CSV, with CIE Lab, XYZ or spectral reflectances.

Lab and XYZ are of the 2° observer under D50, as ICC prescribes, and are adapted to D65. Spectra are integrated under
D65.
"""

import csv
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartReference, SurroundingPatches
from polcap.errors import ChartError
from polcap.formats import text_file
from polcap.image_values import Floats
from polcap.optics.color import REC709_TO_XYZ

_SG = [f"{column}{row}" for row in range(1, 11) for column in "ABCDEFGHIJKLMN"]  # patches of an SG, row by row
SG_BLOCK = tuple(f"{column}{row}" for row in (2, 3, 4, 5) for column in "EFGHIJ")  # of an SG: a Classic's colors
SG_SURROUNDINGS = tuple(name for name in _SG if name not in SG_BLOCK)
_MOST_BYTES = 4 << 20  # of a file
_BY_ROW = [f"{row}{column}" for row in "ABCD" for column in range(1, 7)]  # names of a Classic's patches, both ways
_BY_COLUMN = [f"{column}{row}" for row in range(1, 5) for column in "ABCDEF"]
_PATCH = re.compile(r"([A-Na-n])0*(\d{1,2})")
_BAND = re.compile(r"[A-Z_ ]*?(\d{3})(?:\.0+)?\s*(?:NM)?")  # SPEC_400, nm400, SPECTRAL_NM_400, R_400nm, 400
_LEAST_BANDS = 16  # columns of wavelengths that make a spectrum
_NANOMETERS = range(300, 831)  # other numbers in names of columns are no wavelengths

Rows = list[list[str]]


def read(path: Path) -> ChartReference:
    """Colors of a measured ColorChecker Classic, or of an SG, at least its block E2 to J5. Raises ChartError."""
    try:
        text = text_file.read_bytes(path, _MOST_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise ChartError(f"whitebalance.chart = {path}: cannot be read ({error.strerror or error})") from error
    try:
        columns, rows = _cgats(text) if "BEGIN_DATA" in text else _csv(text)
        rec709 = _colors(columns, rows)
        named = _rows_by_patch(columns, rows)
        order, is_block = _order(named, len(rows))
    except ValueError as error:
        raise ChartError(f"whitebalance.chart = {path}: {error}") from None
    names = SG_BLOCK if is_block else tuple(str(number) for number in range(1, 25))
    around = None
    if is_block and all(name in named for name in SG_SURROUNDINGS):
        around = surroundings(rec709[[named[name] for name in SG_SURROUNDINGS]])
    return ChartReference(f"measured chart {path.name}", rec709[order], None, names, (), is_block, around)


def surroundings(rec709: Floats) -> SurroundingPatches:
    """The patches SG_SURROUNDINGS (116, 3) of an SG, with their places around its block, which begins at E2."""
    center = [(ord(name[0]) - ord("E") + 0.5, int(name[1:]) - 1.5) for name in SG_SURROUNDINGS]
    return SurroundingPatches(rec709, np.array(center))


def to_rec709(xyz: Floats, white_xy: Sequence[float]) -> Floats:
    """Convert XYZ (N, 3), Y = 1 for white, under a white of chromaticity `white_xy` to linear Rec.709 (Bradford)."""
    from polcap.optics.colour_science import colour

    white = colour.xy_to_XYZ(white_xy), colour.xy_to_XYZ(colour.RGB_COLOURSPACES["sRGB"].whitepoint)
    return np.asarray(colour.chromatic_adaptation(xyz, *white, transform="Bradford") @ np.linalg.inv(REC709_TO_XYZ).T)


def _cgats(text: str) -> tuple[list[str], Rows]:
    """Names of the columns and rows of the first table of a CGATS file."""
    fields = re.search(r"BEGIN_DATA_FORMAT\s+(.*?)\s+END_DATA_FORMAT", text, re.DOTALL)
    data = re.search(r"BEGIN_DATA\s*\n(.*?)\n\s*END_DATA\b", text, re.DOTALL)
    if fields is None or data is None:
        raise ValueError("no table between BEGIN_DATA and END_DATA; export it as CGATS or CSV again")
    return _table(fields[1].split(), [shlex.split(line) for line in data[1].splitlines() if line.strip()])


def _csv(text: str) -> tuple[list[str], Rows]:
    """Names of the columns and rows of a CSV; decimal commas where semicolons or tabs separate the columns."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((mark for mark in (";", "\t") if lines and mark in lines[0]), ",")
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]
    if separator != ",":
        rows = [[cell.replace(",", ".") for cell in row] for row in rows]
    return _table(rows[0] if rows else [], rows[1:])


def _table(columns: list[str], rows: Rows) -> tuple[list[str], Rows]:
    """Columns in capitals, and rows. Raises ValueError: a row has another number of values."""
    wrong = next((number for number, row in enumerate(rows, 1) if len(row) != len(columns)), None)
    if wrong is not None:
        raise ValueError(f"row {wrong} has {len(rows[wrong - 1])} values for {len(columns)} columns; correct it")
    return [column.strip().upper().replace("*", "") for column in columns], rows


def _colors(columns: list[str], rows: Rows) -> Floats:
    """Linear Rec.709 (N, 3) of all rows: from spectra if there are any, otherwise from XYZ or Lab."""
    bands = {int(match[1]): column for column, name in enumerate(columns) if (match := _BAND.fullmatch(name))}
    bands = {band: bands[band] for band in sorted(bands) if band in _NANOMETERS}
    if len(bands) >= _LEAST_BANDS:
        return _from_spectra(list(bands), _numbers(rows, list(bands.values())))
    column_of = {re.sub(r"^(?:CIE_?)?(?:LAB|XYZ)?_", "", name): column for column, name in enumerate(columns)}
    d50_xy = (0.3457, 0.3585)  # chromaticity
    if {"X", "Y", "Z"} <= column_of.keys():
        xyz = _numbers(rows, [column_of[name] for name in "XYZ"])
        return to_rec709(xyz / (100.0 if xyz.max() > 1.5 else 1.0), d50_xy)  # above 1.5: Y = 100 for white
    if {"L", "A", "B"} <= column_of.keys():
        from polcap.optics.colour_science import colour

        return to_rec709(colour.Lab_to_XYZ(_numbers(rows, [column_of[name] for name in "LAB"]), d50_xy), d50_xy)
    raise ValueError(f"no columns L, a, b or X, Y, Z, or of {_LEAST_BANDS} wavelengths or more; name them so")


def _from_spectra(wavelengths: list[int], reflectance: Floats) -> Floats:
    """Linear Rec.709 (N, 3) of reflectances (N, B) at wavelengths (B,) nm, in percent or as parts of 1."""
    from polcap.optics.colour_science import colour

    grid = np.arange(380.0, 781.0, 5.0)  # nm; beyond the measured wavelengths the outermost value is continued
    observer, light = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], colour.SDS_ILLUMINANTS["D65"]
    matching = np.stack([np.interp(grid, observer.wavelengths, values) for values in observer.values.T])  # (3, 81)
    weights = matching * np.interp(grid, light.wavelengths, light.values)
    curves = np.stack([np.interp(grid, wavelengths, row) for row in reflectance])  # (N, 81)
    xyz = curves @ weights.T / weights[1].sum() / (100.0 if reflectance.max() > 1.5 else 1.0)
    return np.asarray(xyz @ np.linalg.inv(REC709_TO_XYZ).T)


def _numbers(rows: Rows, places: list[int]) -> Floats:
    """Finite numbers (N, C) of the columns at `places`."""
    found = np.array([[float(row[at]) for at in places] for row in rows]).reshape(-1, len(places))
    if not np.isfinite(found).all():
        raise ValueError("not all values are finite; correct them")
    return found


def _rows_by_patch(columns: list[str], rows: Rows) -> dict[str, int]:
    """Row of each patch by its name, such as A1; empty if no column has such names."""
    for at in range(len(columns)):
        found = [_PATCH.fullmatch(row[at].strip()) for row in rows]
        if found and all(found):
            return {f"{match[1].upper()}{int(match[2])}": number for number, match in enumerate(found) if match}
    return {}


def _order(named: Mapping[str, int], count: int) -> tuple[list[int], bool]:
    """Rows of the 24 patches, from dark skin row by row, and whether they are the block of an SG.

    `named` has the row of each patch by its name, `count` is the number of rows.
    """
    for names in (_BY_ROW, _BY_COLUMN, SG_BLOCK):
        if all(name in named for name in names) and (names is SG_BLOCK or count == len(names)):
            return [named[name] for name in names], names is SG_BLOCK
    if count == 24 and not named:
        return list(range(24)), False
    first = f" named {', '.join(list(named)[:3])}, … are not the patches of a chart" if named else " without names"
    raise ValueError(
        f"{count} patches{first}; a Classic has 24, from dark skin or named A1 to D6, an SG at least those named "
        "E2 to J5"
    )
