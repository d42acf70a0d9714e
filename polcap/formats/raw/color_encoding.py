"""Color encoding that a finished picture states: by PNG chunks, an ICC profile, TIFF tags or EXR attributes.

All of it runs in the child process of `sandbox`.

References
----------
W3C, Portable Network Graphics (third edition), 4.3. ICC.1:2022. ITU-T H.273, tables 2 and 3. TIFF 6.0, section 20.
ASWF, Color Interop Forum: color space identifiers for OpenEXR.
"""

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from polcap.formats.raw import file_kind
from polcap.image_values import Floats
from polcap.optics.color import REC709_TO_XYZ, decode_srgb

_STATE = 'state encoding = "linear" or "srgb" in capture.toml'
_DEVELOP = "save it as linear 16-bit TIFF"
_SAME = 2e-3  # of white: greatest difference of two equal curves; sRGB and gamma 2.2 differ by 8e-3
_ENDS = 0.02  # of white: greatest error of a curve at its ends 0 and 1
_CONTRADICTION = 0.1  # ln of the ratio of light at half the code
_UNEQUAL = 0.01  # of a color matrix to the identity, above which primaries are not those of Rec.709
_SRGB_GAMMA = 2.1, 2.3  # of a gAMA chunk: 1/2.2 means sRGB (PNG, 13.13)
_ABSOLUTE = b"\3"  # rendering intent of an sRGB chunk; OpenImageIO writes it into linear pictures of 16 bits too
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue and white
_REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
_P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
_H273_PRIMARIES = {1: _REC709, 2: _REC709, 9: _REC2020, 12: _P3}  # 2: not stated
_NAMED_PRIMARIES = {  # by names of color spaces in lower case
    "rec709|bt709|srgb": _REC709,
    "rec2020|bt2020": _REC2020,
    "p3": _P3,
    "adobe": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290),
    "ap0|aces2065": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "ap1|acescg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])  # from XYZ
_D50 = np.array([0.9642, 1.0, 0.8249])  # white of an ICC profile
_EXR_NAMES = ("colorspace", "colorinteropid")  # attributes, without prefix and underscores
_OTHER_CURVES = re.compile(r"pq|2084|hlg|log|acescc")  # of displays with a high range, and of films
_LINEAR_NAMES = re.compile(r"(^|[^a-z])lin(ear)?([^a-z]|$)|aces2065|acescg|ap0|ap1|^raw$|^data$")
_GAMMA_NAME = re.compile(r"(?:g|gamma)[ _-]?(\d)\.?(\d)")

Curve = Callable[[Floats], Floats]  # linear light 0…1 of a stored value 0…1


@dataclass(frozen=True)
class ColorEncoding:
    """Curve and primaries that a picture's file states, with their source; empty values where it states nothing."""

    curve: str = ""  # "linear", "srgb", or the name of another curve
    source: str = ""
    fault: str = ""  # why the statement cannot be used, with the remedy
    to_rec709: tuple[float, ...] = ()  # (9,) color matrix by rows; empty: of Rec.709, or not stated


class _Statement(NamedTuple):
    source: str
    curve: Curve
    to_rec709: Floats | None = None  # (3, 3)
    doubt: str = ""  # why the statement alone does not suffice


class _UnusableError(Exception):
    """The file states an encoding that polcap does not decode; the text names it, with a remedy."""


def read(data: bytes, spec: Any) -> tuple[ColorEncoding, Curve]:
    """The color encoding that a picture states, and its curve; `spec` is OpenImageIO's of the open picture."""
    is_8_bit = spec.format.size() == 1
    try:
        found = list(_statements(data, spec))
        names = [_name(one.source, one.curve) for one in found]
    except _UnusableError as error:
        return ColorEncoding(fault=str(error)), _linear
    if not found:
        return ColorEncoding(), _linear
    first, name = found[0], names[0]
    half_light = [max(float(one.curve(np.array([0.5]))[0]), 1e-6) for one in found]  # light of half the code
    k = next((k for k, light in enumerate(half_light) if abs(np.log(light / half_light[0])) > _CONTRADICTION), None)
    fault = ""
    if k is not None:
        fault = f"its {first.source} states {name}, but its {found[k].source} {names[k]}; {_STATE}"
    elif first.doubt and not is_8_bit:
        fault = f"its {first.source} states {name}, but {first.doubt}; {_STATE}"
    matrix = () if first.to_rec709 is None else tuple(map(float, first.to_rec709.ravel()))
    return ColorEncoding(name, first.source, fault, matrix), first.curve


def _statements(data: bytes, spec: Any) -> Iterator[_Statement]:
    """The statements on the encoding, in order of precedence."""
    profile = spec.getattribute("ICCProfile")
    if data.startswith(file_kind.EXR):
        yield from _exr(spec)
        return
    chunks = file_kind.png_chunks(data)
    if b"cICP" in chunks:
        yield _cicp(chunks[b"cICP"])
    if profile is not None:
        yield _icc(np.asarray(profile, np.uint8).tobytes())
    if b"sRGB" in chunks:
        writer = "programs such as OpenImageIO write it into linear pictures of 16 bits too"
        yield _Statement("sRGB chunk", decode_srgb, doubt=writer * (chunks[b"sRGB"] == _ABSOLUTE))
    if len(chunks.get(b"gAMA", b"")) == 4:
        yield _gama(chunks)
    directories = file_kind.structure(data).directories
    if directories and (table := directories[0].get(file_kind.TRANSFER_FUNCTION)):
        yield _transfer_function(np.array(table), 1 << 8 * spec.format.size())
    if spec.getattribute("Exif:ColorSpace") == 1 and not data.startswith(file_kind.JPEG):
        copied = "a camera's settings are copied into linear pictures too"
        yield _Statement("EXIF ColorSpace", decode_srgb, doubt=copied * bool(spec.getattribute("Make")))


def _linear(value: Floats) -> Floats:
    return value


def _power(gamma: float, value: Floats) -> Floats:
    return np.asarray(np.sign(value) * np.abs(value) ** gamma)


def _table(light: Floats, value: Floats) -> Floats:
    return np.asarray(np.interp(value, np.linspace(0, 1, len(light)), light))


def _parametric(kind: int, numbers: Floats, value: Floats) -> Floats:
    """Curve of ICC's parametric types 0 to 4 (ICC.1:2022, table 68)."""
    g, a, b, c, d, e, f = np.pad(numbers, (0, 7 - len(numbers)))
    if kind == 0:
        return _power(g, value)
    if kind < 3:
        offset = c if kind == 2 else 0.0
        return np.asarray(np.where(value >= -b / a, np.maximum(a * value + b, 0) ** g + offset, offset))
    return np.asarray(np.where(value >= d, np.maximum(a * value + b, 0) ** g + e, c * value + f))


def _rec709(value: Floats) -> Floats:
    """Light of a picture encoded by ITU-R BT.709."""
    return np.asarray(np.where(value < 0.081, value / 4.5, np.maximum((value + 0.099) / 1.099, 0) ** (1 / 0.45)))


def _name(source: str, curve: Curve) -> str:
    """Name of a curve: linear, srgb, or its gamma. Raises _UnusableError for one that does not grow from 0 to 1."""
    code = np.linspace(0, 1, 65)
    light = curve(code)
    if not np.isfinite(light).all() or (np.diff(light) < 0).any() or max(abs(light[0]), abs(light[-1] - 1)) > _ENDS:
        raise _UnusableError(f"the curve of its {source} does not grow from 0 to 1; {_STATE}")
    for name, known in (("linear", _linear), ("srgb", decode_srgb)):
        if np.abs(light - known(code)).max() < _SAME:
            return name
    return f"gamma {np.log(light[32]) / np.log(0.5):.1f}"  # from the light at code ½


def _cicp(chunk: bytes) -> _Statement:
    """Statement of a cICP chunk: code points of ITU-T H.273."""
    if len(chunk) != 4:
        raise _UnusableError(f"its cICP chunk has {len(chunk)} bytes, not 4; {_STATE}")
    primaries, transfer, matrix, full_range = chunk
    curves: dict[int, Curve] = {
        **dict.fromkeys((1, 6, 14, 15), _rec709), 4: partial(_power, 2.2), 5: partial(_power, 2.8),
        8: _linear, 13: decode_srgb,
    }  # fmt: skip
    if transfer not in curves or matrix or full_range != 1 or primaries not in _H273_PRIMARIES:
        raise _UnusableError(
            f"its cICP chunk states the code points {primaries}/{transfer}/{matrix}/{full_range} of H.273, which "
            f"polcap does not decode; {_DEVELOP}"
        )
    return _Statement("cICP chunk", curves[transfer], _from_primaries(_H273_PRIMARIES[primaries]))


def _gama(chunks: dict[bytes, bytes]) -> _Statement:
    """Tone curve and primaries by the chunks gAMA and cHRM of a PNG."""
    gamma = 1e5 / max(int.from_bytes(chunks[b"gAMA"], "big"), 1)
    curve = decode_srgb if _SRGB_GAMMA[0] < gamma < _SRGB_GAMMA[1] else partial(_power, gamma)
    primaries = chunks.get(b"cHRM", b"")
    matrix = None
    if len(primaries) == 32:
        white_x, white_y, *xy = (value / 1e5 for value in struct.unpack(">8I", primaries))
        matrix = _from_primaries((*xy, white_x, white_y))
    return _Statement("gAMA chunk", curve, matrix)


def _transfer_function(table: Floats, codes: int) -> _Statement:
    """Statement of TIFF's TransferFunction: light 0…65535 of each code, for one channel or three."""
    if len(table) not in (codes, 3 * codes):
        raise _UnusableError(f"its TransferFunction has {len(table)} values for {codes} codes; {_STATE}")
    channels = table.reshape(-1, codes) / 65535
    if np.abs(channels - channels[0]).max() > _SAME:
        raise _UnusableError(f"its TransferFunction differs between the channels; {_DEVELOP}")
    return _Statement("TransferFunction", partial(_table, channels[0]))


def _icc(profile: bytes) -> _Statement:
    """Statement of an ICC profile of curves and a matrix. Raises _UnusableError: damaged, of tables, unequal curves."""
    try:
        count = struct.unpack_from(">I", profile, 128)[0]
        table = [struct.unpack_from(">4sII", profile, 132 + 12 * k) for k in range(min(count, 100))]
        tags = {name: profile[offset : offset + size] for name, offset, size in table}
        curves = [_icc_curve(tags[name]) for name in (b"kTRC", b"rTRC", b"gTRC", b"bTRC") if name in tags]
        columns = [struct.unpack_from(">3i", tags[name], 8) for name in (b"rXYZ", b"gXYZ", b"bXYZ") if name in tags]
    except (struct.error, IndexError):
        raise _UnusableError(f"its ICC profile is damaged; {_STATE}") from None
    if not curves:
        raise _UnusableError(f"its ICC profile is of tables, not of curves; {_DEVELOP}")
    code = np.linspace(0, 1, 65)
    if any(np.abs(one(code) - curves[0](code)).max() > _SAME for one in curves):
        raise _UnusableError(f"the curves of its ICC profile differ between the channels; {_DEVELOP}")
    matrix = _matrix(np.array(columns).T / 65536, _D50) if len(columns) == 3 else None
    return _Statement("ICC profile", curves[0], matrix)


def _icc_curve(tag: bytes) -> Curve:
    """A curve of an ICC profile, of the types `curv` and `para`."""
    if tag[:4] == b"curv":
        count = struct.unpack_from(">I", tag, 8)[0]
        values = np.array(struct.unpack_from(f">{count}H", tag, 12), np.float64)
        if count < 2:
            return partial(_power, float(values[0]) / 256) if count else _linear
        return partial(_table, values / 65535)
    kind = struct.unpack_from(">H", tag, 8)[0]
    count = (1, 3, 4, 5, 7)[kind]
    return partial(_parametric, kind, np.array(struct.unpack_from(f">{count}i", tag, 12)) / 65536)


def _exr(spec: Any) -> Iterator[_Statement]:
    """Statements of an EXR: its attributes that name a color space; else its chromaticities, with linear values."""
    chromaticities = spec.getattribute("chromaticities")
    matrix = None if chromaticities is None else _from_primaries(chromaticities)
    named = False
    for attribute in spec.extra_attribs:
        name = re.split("[:/.]", attribute.name)[-1].replace("_", "").lower()
        if name not in _EXR_NAMES or not isinstance(attribute.value, str):
            continue
        space = attribute.value.lower()
        if _OTHER_CURVES.search(space):
            raise _UnusableError(f"its attribute {attribute.name} states {attribute.value}; write linear values")
        if (curve := _named_curve(space)) is None:
            continue
        xy = next((xy for names, xy in _NAMED_PRIMARIES.items() if re.search(names, space)), None)
        if chromaticities is not None and xy is not None and np.abs(np.subtract(xy, chromaticities)).max() > _UNEQUAL:
            raise _UnusableError(f"its attribute {attribute.name} contradicts its chromaticities; {_STATE}")
        named = True
        yield _Statement(f"attribute {attribute.name}", curve, matrix if xy is None else _from_primaries(xy))
    if matrix is not None and not named:  # with neither, it is linear Rec.709 (OpenEXR, standard attributes)
        yield _Statement("chromaticities", _linear, matrix)


def _named_curve(text: str) -> Curve | None:
    """Curve of a color space by its name in lower case; None if the name states none."""
    if _LINEAR_NAMES.search(text):
        return _linear
    if "srgb" in text:
        return decode_srgb
    if gamma := _GAMMA_NAME.search(text):
        return partial(_power, float(f"{gamma[1]}.{gamma[2]}"))
    return _rec709 if "709" in text else None


def _from_primaries(xy: Sequence[float]) -> Floats | None:
    """Color matrix (3, 3) to linear Rec.709 from primaries: x, y of red, green, blue, white; None for Rec.709's own."""
    if np.shape(xy) != (8,) or not np.isfinite(xy).all() or not np.all(xy[1::2]):
        raise _UnusableError(f"its primaries are not colors; {_DEVELOP}")
    x, y = np.reshape(xy, (4, 2)).astype(np.float64).T
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])  # (3, 4)
    return _matrix(xyz[:, :3], xyz[:, 3])


def _matrix(primaries: Floats, white: Floats) -> Floats | None:
    """Color matrix (3, 3) to linear Rec.709 from XYZ of primaries (columns) of any scale, adapted to D65 (Bradford)."""
    if np.linalg.matrix_rank(primaries, rtol=1e-3) < 3:
        raise _UnusableError(f"its primaries are not three different colors; {_DEVELOP}")
    to_xyz = primaries * np.linalg.solve(primaries, white)
    cones, target = _BRADFORD @ white, _BRADFORD @ REC709_TO_XYZ.sum(axis=1)
    adapted = np.linalg.solve(_BRADFORD, (target / cones)[:, None] * (_BRADFORD @ to_xyz))
    matrix = np.linalg.solve(REC709_TO_XYZ, adapted)
    return None if np.abs(matrix - np.eye(3)).max() < _UNEQUAL else np.asarray(matrix)
