"""Encodings that pictures state: read as stated, or refused where they contradict."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray

from polcap.capture_values import FrameReading
from polcap.errors import DecodeError
from polcap.formats.raw import photo, probe
from polcap.optics.color import encode_srgb
from tests.formats import headers
from tests.formats.raw.test_photo import save

LIGHT = np.linspace(0.02, 0.9, 24 * 32 * 3).reshape(24, 32, 3)
SRGB = encode_srgb(LIGHT)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # ITU-R BT.709
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)  # SMPTE ST 2065-1
D50_SRGB = ((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141))  # of the ICC's profile
D50_ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))

Write = Callable[[Path], object]


def sixteen(value: NDArray[Any]) -> NDArray[np.uint16]:
    return np.round(65535 * value).astype(np.uint16)


def eight(value: NDArray[Any]) -> NDArray[np.uint8]:
    return np.round(255 * value).astype(np.uint8)


def png(pixels: NDArray[Any], *chunks: tuple[bytes, bytes]) -> Write:
    def write(path: Path) -> None:
        cv2.imwrite(str(path), pixels[..., ::-1])
        headers.add_chunks(path, *chunks)

    return write


def picture(pixels: NDArray[Any], **attributes: object) -> Write:
    return lambda path: save(path, pixels, **attributes)


def exr(value: NDArray[Any], **attributes: object) -> Write:
    if "chromaticities" in attributes:
        attributes["chromaticities"] = (oiio.TypeDesc("float[8]"), attributes["chromaticities"])
    return picture(value.astype(np.float32), **attributes)


def profile(*curves: bytes, colors: tuple[tuple[float, ...], ...] = D50_SRGB) -> bytes:
    """A matrix profile of ICC.1 with one curve for all channels, or one for each."""
    tags = list(zip((b"rTRC", b"gTRC", b"bTRC"), curves * 3))
    for name, xyz in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colors):
        tags.append((name, b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(65536 * v) for v in xyz))))
    table, body, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for name, tag in tags:
        table += struct.pack(">4sII", name, start + len(body), len(tag))
        body += tag.ljust((len(tag) + 3) // 4 * 4, b"\0")
    head = struct.pack(">I", start + len(body)) + b"\0\0\0\0\2\0\0\0mntrRGB XYZ ".ljust(32, b"\0") + b"acsp"
    return head.ljust(128, b"\0") + table + body


def curv(*values: int) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(f">I{len(values)}H", len(values), *values)


def para(kind: int, *numbers: float) -> bytes:
    return b"para\0\0\0\0" + struct.pack(f">HH{len(numbers)}i", kind, 0, *(round(65536 * one) for one in numbers))


def icc_attribute(data: bytes) -> tuple[oiio.TypeDesc, NDArray[np.uint8]]:
    return oiio.TypeDesc(f"uint8[{len(data)}]"), np.frombuffer(data, np.uint8)


def iccp(data: bytes) -> tuple[bytes, bytes]:
    return b"iCCP", b"name\0\0" + zlib.compress(data)


def gama(gamma: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(1e5 / gamma))


def transfer_function(pixels: NDArray[np.uint8], gamma: float) -> Write:
    table = tuple(np.round(65535 * (np.arange(256) / 255) ** gamma).astype(int).tolist())
    tags = headers.of_picture(pixels) | {301: (3, table)}
    return lambda path: path.write_bytes(headers.tiff(tags, image=pixels.tobytes()))


SQUARES = np.round(65535 * np.linspace(0, 1, 1025) ** 2).astype(int).tolist()
SRGB_CHUNK, PARAMETRIC = (b"sRGB", b"\0"), para(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


@pytest.mark.parametrize(
    ("name", "write", "curve"),
    [
        ("srgb.png", png(sixteen(SRGB), SRGB_CHUNK), "srgb"),
        ("both.png", png(sixteen(SRGB), SRGB_CHUNK, gama(2.2)), "srgb"),
        ("gamma22.png", png(sixteen(SRGB), gama(2.2)), "srgb"),
        ("gamma18.png", png(sixteen(LIGHT ** (1 / 1.8)), gama(1.8)), "gamma 1.8"),
        ("gamma1.png", png(eight(LIGHT), gama(1.0)), "linear"),
        ("cicp13.png", png(sixteen(SRGB), (b"cICP", bytes((1, 13, 0, 1)))), "srgb"),
        ("cicp8.png", png(eight(LIGHT), (b"cICP", bytes((1, 8, 0, 1)))), "linear"),
        ("iccp.png", png(sixteen(SRGB), iccp(profile(PARAMETRIC))), "srgb"),
        ("iccp_linear.png", png(eight(LIGHT), iccp(profile(curv()))), "linear"),
        ("iccp_table.png", png(sixteen(np.sqrt(LIGHT)), iccp(profile(curv(*SQUARES)))), "gamma 2.0"),
        ("icc.tif", picture(sixteen(SRGB), ICCProfile=icc_attribute(profile(PARAMETRIC))), "srgb"),
        ("icc2.tif", picture(sixteen(LIGHT ** (256 / 563)), ICCProfile=icc_attribute(profile(curv(563)))), "gamma 2.2"),
        ("icc_linear.tif", picture(eight(LIGHT), ICCProfile=icc_attribute(profile(curv(256)))), "linear"),
        ("exif.tif", picture(sixteen(SRGB), oiio__ColorSpace="sRGB"), "srgb"),
        ("transfer.tif", transfer_function(eight(LIGHT ** (1 / 1.8)), 1.8), "gamma 1.8"),
        ("transfer1.tif", transfer_function(eight(LIGHT), 1.0), "linear"),
        ("interop.exr", exr(SRGB, colorInteropID="srgb_rec709_scene"), "srgb"),
        ("name.exr", exr(SRGB, colorspace="sRGB"), "srgb"),
        ("linear_name.exr", exr(LIGHT, colorspace="Utility - Linear - sRGB"), "linear"),
        ("gamma.exr", exr(LIGHT ** (1 / 2.2), colorInteropID="g22_rec709_display"), "gamma 2.2"),
        ("plain.exr", exr(LIGHT), ""),
        ("plain.tif", picture(sixteen(LIGHT)), ""),
    ],
)  # fmt: skip
def test_a_picture_is_read_as_it_states(tmp_path: Path, name: str, write: Write, curve: str) -> None:
    path = tmp_path / name
    write(path)
    assert probe.read(path).encoding.curve == curve
    image, coarse = photo.read(path), probe.read(path).bits == 8
    np.testing.assert_allclose(image.value / image.white, LIGHT, atol=0.0045 if coarse else 2e-4)
    assert image.lossy == (coarse or curve not in ("", "linear"))


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("a.png", png(sixteen(SRGB), SRGB_CHUNK, gama(1.0)), "its sRGB chunk states srgb, but its gAMA chunk linear"),
        ("b.png", png(sixteen(SRGB), iccp(profile(curv())), SRGB_CHUNK), "its ICC profile states linear, but its sRGB"),
        ("c.png", picture(sixteen(SRGB), oiio__ColorSpace="sRGB"), "OpenImageIO write it into linear pictures"),
        ("d.tif", picture(sixteen(SRGB), ICCProfile=icc_attribute(b"x" * 200)), "its ICC profile is damaged"),
        ("e.tif", picture(sixteen(SRGB), oiio__ColorSpace="sRGB", Make="Acme"), "its EXIF ColorSpace states srgb, but"),
        ("f.exr", exr(SRGB, colorspace="sRGB", colorInteropID="lin_rec709_scene"), "states linear, but its attribute"),
        ("g.exr", exr(LIGHT, colorspace="lin_ap1", chromaticities=REC709), "colorspace contradicts its chromaticities"),
    ],
)
def test_contradictory_encodings_are_refused_unless_the_user_decides(
    tmp_path: Path, name: str, write: Write, words: str
) -> None:
    path = tmp_path / name
    write(path)
    remedy = 'state encoding = "linear" or "srgb" in capture.toml'
    with pytest.raises(DecodeError, match=rf"{name}: .*{words}.*{remedy}"):
        photo.read(path)
    assert not photo.read(path, FrameReading("photo", "linear")).lossy
    assert photo.read(path, FrameReading("photo", "srgb")).lossy


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("pq.png", png(sixteen(SRGB), (b"cICP", bytes((9, 16, 0, 1)))), "code points 9/16/0/1"),
        ("narrow.png", png(sixteen(SRGB), (b"cICP", bytes((1, 13, 0, 0)))), "code points 1/13/0/0"),
        ("channels.png", png(sixteen(SRGB), iccp(profile(curv(), curv(563), curv()))), "differ between the channels"),
        ("falling.png", png(sixteen(SRGB), iccp(profile(curv(65535, 0)))), "does not grow from 0 to 1"),
        ("no_color.exr", exr(LIGHT, chromaticities=(*ACES[:7], np.nan)), "its primaries are not colors"),
        ("one_color.exr", exr(LIGHT, chromaticities=(0.3, 0.3) * 4), "not three different colors"),
        ("film.exr", exr(LIGHT, colorspace="ACEScct"), "states ACEScct; write linear values"),
    ],
)
def test_an_encoding_that_is_not_decoded_is_refused(tmp_path: Path, name: str, write: Write, words: str) -> None:
    path = tmp_path / name
    write(path)
    with pytest.raises(DecodeError, match=rf"{name}: .*{words}"):
        photo.read(path)


# to linear sRGB: Lindbloom (Adobe RGB), ITU-R BT.2087 (BT.2020), Bradford adaptation (ACES)
ADOBE_MATRIX = (1.3984, -0.3984, 0, 0, 1, 0, 0, -0.0429, 1.0429)
REC2020_MATRIX = (1.6605, -0.5876, -0.0728, -0.1246, 1.1329, -0.0083, -0.0182, -0.1006, 1.1187)
ACES_MATRIX = (2.5217, -1.1341, -0.3876, -0.2765, 1.3727, -0.0962, -0.0154, -0.1530, 1.1684)


@pytest.mark.parametrize(
    ("name", "write", "expected"),
    [
        ("adobe.png", png(sixteen(LIGHT), iccp(profile(curv(563), colors=D50_ADOBE))), ADOBE_MATRIX),
        ("2020.png", png(sixteen(LIGHT), (b"cICP", bytes((9, 8, 0, 1)))), REC2020_MATRIX),
        ("aces.exr", exr(LIGHT, chromaticities=ACES), ACES_MATRIX),
        ("709.exr", exr(LIGHT, chromaticities=REC709), None),
        ("srgb.png", png(sixteen(SRGB), iccp(profile(PARAMETRIC))), None),
    ],
)
def test_stated_primaries_give_the_color_matrix(
    tmp_path: Path, name: str, write: Write, expected: tuple[float, ...] | None
) -> None:
    path = tmp_path / name
    write(path)
    matrix = photo.read(path).camera_matrix
    assert (matrix is None) is (expected is None)
    if matrix is not None and expected is not None:
        np.testing.assert_allclose(matrix.ravel(), expected, atol=3e-3)
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=2e-3)  # white stays white
