"""Finished pictures as sources: stored values, their meaning, refused files."""

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from polcap.capture_values import FrameReading
from polcap.errors import DecodeError
from polcap.formats.raw import photo, probe
from polcap.optics import color
from tests.formats import headers
from tests.formats.headers import DATA, needs_data

SIXTEEN = np.arange(24 * 32 * 3, dtype=np.uint16).reshape(24, 32, 3) * 20
EIGHT = (np.arange(24 * 32 * 3).reshape(24, 32, 3) % 256).astype(np.uint8)


def save(path, pixels, names=None, **attributes):
    """Write a picture; OpenImageIO would mark a PNG of 16 bits as sRGB by itself."""
    pixels = np.atleast_3d(pixels)
    stored = {"float32": "float", "float16": "half"}.get(str(pixels.dtype), str(pixels.dtype))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.TypeDesc(stored))
    if names:
        spec.channelnames = names
    if path.suffix == ".png" and pixels.dtype == np.uint16:
        spec["oiio:ColorSpace"] = "lin_rec709_scene"
    for name, value in attributes.items():  # a value, or its type and value
        spec.attribute(name.replace("__", ":"), *(value if isinstance(value, tuple) else (value,)))
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(np.ascontiguousarray(pixels)) and out.close()
    return path


@pytest.mark.parametrize(
    ("name", "pixels", "white"),
    [
        ("a.tif", SIXTEEN, 65535),
        ("a.png", SIXTEEN, 65535),
        ("gray.tif", SIXTEEN[..., 0], 65535),
        ("half.exr", np.linspace(0, 2, 24 * 32 * 3).reshape(24, 32, 3).astype(np.float16), 1),
    ],
)
def test_sixteen_bits_and_floats_are_linear_and_gray_fills_all_channels(tmp_path, name, pixels, white):
    image = photo.read(save(tmp_path / name, pixels))
    np.testing.assert_array_equal(image.value, np.broadcast_to(np.atleast_3d(pixels), (24, 32, 3)).astype(np.float32))
    assert (image.white, image.black.tolist(), image.cfa, image.lossy) == (white, [[0]], None, False)


def test_eight_bits_are_srgb_with_a_loss(tmp_path):
    image = photo.read(save(tmp_path / "a.png", EIGHT))
    assert image.lossy and image.white == 1 and image.value.dtype == np.float32
    at = dict(zip(EIGHT.ravel().tolist(), image.value.ravel().tolist()))
    assert at[0] == 0 and at[255] == pytest.approx(1)
    assert at[119] == pytest.approx(0.1845, abs=2e-4)  # grey of 18 %, from the tables of IEC 61966-2-1
    assert at[8] == pytest.approx(8 / 255 / 12.92)  # the linear foot


def test_encoding_and_levels_may_be_stated(tmp_path):
    linear = photo.read(save(tmp_path / "a.png", EIGHT), FrameReading("photo", "linear", 240, 4))
    np.testing.assert_array_equal(linear.value, EIGHT)
    assert (linear.white, linear.black.tolist(), linear.lossy) == (240, [[4]], True)
    encoded = photo.read(save(tmp_path / "b.tif", SIXTEEN), FrameReading("photo", "srgb"))
    np.testing.assert_allclose(encoded.value, color.decode_srgb(SIXTEEN / 65535), atol=1e-6)
    assert encoded.lossy
    floats = photo.read(save(tmp_path / "c.exr", (SIXTEEN / 65535).astype(np.float32)), FrameReading("photo", "srgb"))
    np.testing.assert_allclose(floats.value, encoded.value, atol=1e-6)


def test_alpha_neither_counts_nor_multiplies(tmp_path):
    path = save(tmp_path / "a.png", np.dstack([SIXTEEN, np.full((24, 32), 1000, np.uint16)]), oiio__UnassociatedAlpha=1)
    np.testing.assert_array_equal(photo.read(path).value, SIXTEEN)


def test_jpeg_opens(tmp_path):
    image = photo.read(save(tmp_path / "a.jpg", np.full((24, 32, 3), 128, np.uint8)))
    np.testing.assert_allclose(image.value, 0.2158605, atol=2e-3)
    assert image.lossy


def test_unreadable_pictures_are_one_error_each(tmp_path):
    whole = save(tmp_path / "a.png", SIXTEEN).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "head.png").write_bytes(whole[:12])
    holes = SIXTEEN.astype(np.float32)
    holes[3, 4, 0] = np.nan
    save(tmp_path / "nan.exr", holes)
    save(tmp_path / "layers.exr", SIXTEEN[..., :2].astype(np.float32), ("U", "V"))
    tags = headers.of_picture(SIXTEEN) | {262: (3, (8,))}
    (tmp_path / "lab.tif").write_bytes(headers.tiff(tags, image=SIXTEEN.tobytes()))
    windows(tmp_path / "beyond.exr", (100, 100, 120, 120), (0, 0, 40, 24))
    for name, words in {
        "cut.png": ".*truncated or damaged",
        "head.png": "",
        "nan.exr": ": 1 values are not finite",
        "layers.exr": r".*2 channels \(U, V\)",
        "lab.tif": ": its colors are CIELAB; save it as RGB",
        "beyond.exr": ": its data window lies outside its display window",
    }.items():
        with pytest.raises(DecodeError, match=name + words):
            photo.read(tmp_path / name)


CELLS = {0: (1, 1), 45: (0, 1), 90: (0, 0), 135: (1, 0)}  # row, column of each angle in the usual cell


def mosaic(height=32, width=40, tint=None):
    """I(θ) of S = (2000, 600, 300) under the sensor's four analyzers, each pixel its own."""
    cell = np.empty((2, 2))
    for angle, at in CELLS.items():
        twice = 2 * np.radians(angle)
        cell[at] = (2000 + 600 * np.cos(twice) + 300 * np.sin(twice)) / 2
    levels = np.tile(cell, (height // 2, width // 2))
    if tint is not None:
        levels = levels * np.tile(np.kron(tint, np.ones((2, 2))), (height // 4, width // 4))
    return levels.round().astype(np.uint16)


def test_sensor_planes_obey_malus_law(tmp_path):
    path = save(tmp_path / "a.png", mosaic())
    planes = {angle: photo.read_mosaic(path, cell) for angle, cell in CELLS.items()}
    assert {angle: plane.value.mean() for angle, plane in planes.items()} == {0: 1300, 45: 1150, 90: 700, 135: 850}
    assert planes[0].value.shape == (16, 20, 3) and planes[0].cfa is None


def test_sensor_pixel_is_the_one_of_its_angle(tmp_path):
    counts = np.arange(32 * 40, dtype=np.uint16).reshape(32, 40) + 20000
    path = save(tmp_path / "a.tif", counts)
    for angle, (row, column) in {90: (0, 0), 45: (0, 1), 135: (1, 0), 0: (1, 1)}.items():
        plane = photo.read_mosaic(path, CELLS[angle]).value[..., 0]
        np.testing.assert_array_equal(plane, counts[row::2, column::2])


def test_sensor_frame_may_be_raw(tmp_path):
    path = tmp_path / "a.dng"
    path.write_bytes(headers.dng(mosaic() + 100, photometric=34892, black=[[100]], white=4000))
    plane = photo.read_mosaic(path, CELLS[45], FrameReading("raw"))
    assert (plane.value.mean(), plane.black.tolist(), plane.white) == (1250, [[100]], 4000)


def test_sensors_of_colors_are_refused(tmp_path, rng):
    bayer = np.tile(np.array([[0, 1], [1, 2]]), (96, 120))
    for pixels, words in (
        (SIXTEEN, "has 3 channels"),
        (mosaic(tint=[[0.6, 1], [1, 0.7]]), ".*color polarization sensor"),
        (np.take_along_axis(scene(rng), bayer[..., None], axis=2), "the diagonals of its 2×2 .*mosaic of colors"),
    ):
        path = save(tmp_path / "a.png", pixels)
        with pytest.raises(DecodeError, match=rf"a\.png: {words}"):
            photo.read_mosaic(path, CELLS[0])


@needs_data
def test_real_sensor_frame_balances():
    path = DATA / "real/polarization_mosaic/fruits_IMX250MZR.png"
    planes = {angle: photo.read_mosaic(path, cell).value[..., 0] for angle, cell in CELLS.items()}
    across, between = planes[0] + planes[90], planes[45] + planes[135]  # both are S0
    usable = np.max(list(planes.values()), axis=0) < 250
    blurred = [cv2.GaussianBlur(sum_, (0, 0), 2)[usable] for sum_ in (across, between)]
    assert np.median(abs(blurred[0] - blurred[1]) / blurred[0]) < 0.03


def windows(path, data, display):
    """An EXR whose windows (left, upper, right, lower) differ; each value states its place."""
    left, upper, right, lower = data
    spec = oiio.ImageSpec(right - left, lower - upper, 3, "float")
    spec.x, spec.y, spec.full_x, spec.full_y = left, upper, display[0], display[1]
    spec.full_width, spec.full_height = display[2] - display[0], display[3] - display[1]
    y, x = np.mgrid[upper:lower, left:right].astype(np.float32)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(np.stack([1000 + x, 1000 + y, 1 + 0 * x], -1)) and out.close()
    return path


@pytest.mark.parametrize("data", [(10, 4, 30, 20), (-10, -4, 50, 40), (-10, 4, 20, 40), (10, -4, 60, 20)])
@pytest.mark.parametrize("display", [(0, 0, 40, 24), (5, 2, 35, 30)])
def test_an_exr_is_read_in_its_display_window(tmp_path, data, display):
    path = windows(tmp_path / "a.exr", data, display)
    image, exif = photo.read(path).value, probe.read(path).exif
    y, x = np.mgrid[display[1] : display[3], display[0] : display[2]]
    held = (x >= data[0]) & (x < data[2]) & (y >= data[1]) & (y < data[3])
    np.testing.assert_array_equal(image, np.stack([1000 + x, 1000 + y, 1 + 0 * x], -1) * held[..., None])
    assert (exif.width, exif.height) == (display[2] - display[0], display[3] - display[1])


def scene(rng, height=192, width=240):
    """A smooth colored picture (H, W, 3) with noise, 16 bits."""
    smooth = cv2.resize(rng.uniform(0.1, 0.6, (6, 8, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(smooth * [40000, 60000, 30000] * rng.normal(1, 0.02, smooth.shape), 0, 65535).astype(np.uint16)


@pytest.mark.parametrize("period", [2, 4, 6])
def test_a_mosaic_in_a_gray_file_is_named(tmp_path, rng, period):
    """Bayer, quad Bayer and X-Trans."""
    bayer = np.array([[0, 1], [1, 2]])
    x_trans = np.array([[int(c) for c in row] for row in ("101121", "212110", "101112", "121101", "010112", "121110")])
    cfa = {2: bayer, 4: np.kron(bayer, np.ones((2, 2), int)), 6: x_trans}[period]
    color_at = np.tile(cfa, (192 // period, 240 // period))
    pixels = np.take_along_axis(scene(rng), color_at[..., None], axis=2)
    path = save(tmp_path / "mosaic.tif", pixels)
    with pytest.raises(DecodeError, match=r"mosaic\.tif: is a sensor's mosaic in a gray file; give the camera's RAW"):
        photo.read(path)
    photo.read(save(tmp_path / "gray.tif", scene(rng)[..., 1]))


def test_a_polarization_mosaic_in_a_gray_file_is_named(tmp_path):
    noise = (np.arange(96 * 96).reshape(96, 96) % 7).astype(np.uint16)
    with pytest.raises(DecodeError, match=r'is a sensor\'s mosaic.*sensor = "polarization" in capture\.toml'):
        photo.read(save(tmp_path / "mosaic.tif", mosaic(96, 96) + noise))
