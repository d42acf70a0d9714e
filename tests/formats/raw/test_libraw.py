"""RAW decoding: counts, black, white and colours of the mosaic, against files of known content."""

import struct
from pathlib import Path

import numpy as np
import pytest
import rawpy

from polcap.errors import DecodeError
from polcap.formats.raw import libraw as raw
from polcap.optics import demosaic
from polcap.optics.color import REC709_TO_XYZ
from tests.formats import headers
from tests.formats.headers import DATA, needs_data

RAMP = np.arange(60 * 84, dtype=np.uint16).reshape(60, 84)
PHASES = [((0, 1), (1, 2)), ((2, 1), (1, 0)), ((1, 0), (2, 1)), ((1, 2), (0, 1))]


def written(tmp_path, *args, **options):
    path = tmp_path / "a.dng"
    path.write_bytes(headers.dng(*args, **options))
    return path


@pytest.mark.parametrize("phase", PHASES)
def test_mosaic_comes_back_bit_for_bit_with_black_in_its_phase(tmp_path, phase):
    image = raw.read(written(tmp_path, RAMP, cfa=phase, black=[[510, 511], [512, 513]], white=4000))
    np.testing.assert_array_equal(image.value, RAMP)
    assert image.cfa.tolist() == [list(row) for row in phase] and image.black.tolist() == [[510, 511], [512, 513]]
    assert image.value.dtype == np.uint16 and image.white == 4000 and not image.lossy


@pytest.mark.parametrize("area", [(2, 4, 58, 84), (3, 5, 59, 83), (3, 4, 59, 84), (2, 5, 58, 83)])
def test_masked_border_is_cut_and_the_colours_keep_their_pixels(tmp_path, area):
    top, left, bottom, right = area
    colors = np.tile([[0, 1], [1, 2]], (30, 42))[: bottom - top, : right - left]  # phase of the active area
    level = np.array([900, 2000, 3000], np.uint16)  # of red, green, blue
    mosaic = np.full((60, 84), 7, np.uint16)  # the masked border
    mosaic[top:bottom, left:right] = level[colors]
    image = raw.read(written(tmp_path, mosaic, area=area))
    height, width = image.value.shape
    assert height >= bottom - top - 1 and width >= right - left - 1
    seen = np.tile(image.cfa, (height // 2 + 1, width // 2 + 1))[:height, :width]
    np.testing.assert_array_equal(image.value, level[seen])


@pytest.mark.parametrize(("pixels", "black"), [(np.stack([RAMP, RAMP + 1, RAMP + 2], -1), 0), (RAMP, 7)])
def test_linear_channels_have_no_mosaic_and_a_single_one_fills_all(tmp_path, pixels, black):
    image = raw.read(written(tmp_path, pixels, photometric=34892, black=[[black]] if black else None))
    np.testing.assert_array_equal(image.value, pixels if pixels.ndim == 3 else np.stack([pixels] * 3, -1))
    assert image.cfa is None and image.black.tolist() == [[black]]


FOUR = np.kron([[500, 524, 512, 512], [512, 512, 500, 524]], np.ones((2, 1), int))
AREA = {"area": (2, 4, 58, 80)}  # of 60×84 px


@pytest.mark.parametrize(
    ("black", "options"),
    [
        (FOUR, {}),
        (FOUR, AREA),
        ([[500], [520], [530.4]], {}),
        ([[500, 520], [510, 530]], {"area": (3, 5, 59, 81)}),
        ([[512]], {"rows": [i % 9 for i in range(60)], "columns": [-(i % 5) for i in range(84)]}),
        ([[512]], AREA | {"rows": [i / 2 for i in range(56)], "columns": list(range(76))}),
        ([[500, 520], [510, 530]], {"cfa": "x-trans"}),
        (np.arange(36).reshape(6, 6) + 500, {"cfa": "x-trans"}),
        ([[500, 520]], {"photometric": 34892}),
        ([[[480, 512, 560]]], {"photometric": 34892, "channels": 3}),
        ([[[480, 512, 560]], [[500, 500, 500]]], {"photometric": 34892, "channels": 3}),
    ],
)
def test_light_is_counted_from_the_black_of_each_photosite(tmp_path, black, options):
    """A black level that repeats over more than 2×2, by row or column, or by channel, is taken off everywhere."""
    top, left, bottom, right = options.get("area", (0, 0, 60, 84))
    cfa = X_TRANS if options.get("cfa") == "x-trans" else ((0, 1), (1, 2))
    channels = options.get("channels", 1)
    light = np.arange(60 * 84 * channels).reshape(60, 84, channels) % 1000
    pattern = np.reshape(black, (*np.shape(black)[:2], -1))
    y, x = np.arange(60) - top, np.arange(84) - left
    level = pattern[y[:, None] % len(pattern), x % pattern.shape[1]]
    rows, columns = (np.array(options.get(name, [0])) for name in ("rows", "columns"))
    level = level + rows.take(y, mode="clip")[:, None, None] + columns.take(x, mode="clip")[:, None]
    counts = np.rint(light + level).astype(np.uint16)
    stated = {name: options[name] for name in ("area", "rows", "columns", "photometric") if name in options}
    image = raw.read(written(tmp_path, counts if channels > 1 else counts[..., 0], cfa=cfa, black=black, **stated))
    seen = np.reshape(image.value - float(image.black.item()), (*image.value.shape[:2], -1))
    down, over = (side - got for side, got in zip((bottom - top, right - left), seen.shape))
    expected = light[top + down : bottom, left + over : right]
    np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), atol=1.0)  # both counts are rounded


def test_a_saturated_count_stays_saturated(tmp_path):
    image = raw.read(written(tmp_path, np.full((60, 84), 65535), black=FOUR, white=65535))
    assert image.value.min() == 65535 == image.white


G, R, B = 1, 0, 2
X_TRANS = [[G, G, R, G, G, B], [G, G, B, G, G, R], [B, R, G, R, B, G],
           [G, G, B, G, G, R], [G, G, R, G, G, B], [R, B, G, B, R, G]]  # fmt: skip


@pytest.mark.parametrize("shift", [(0, 0), (2, 1), (4, 5)])
def test_x_trans_comes_back_from_its_first_whole_block_on(tmp_path, shift):
    cfa = np.roll(X_TRANS, shift, (0, 1))
    image = raw.read(written(tmp_path, RAMP, cfa=cfa.tolist()))
    down, right = 60 - image.value.shape[0], 84 - image.value.shape[1]
    assert max(down, right) < 3 and image.superpixel == 3
    np.testing.assert_array_equal(image.value, RAMP[down:, right:])
    np.testing.assert_array_equal(image.cfa, np.roll(cfa, (-down, -right), (0, 1)))
    assert demosaic.x_trans_corner(image.cfa) == (0, 0)


def test_another_mosaic_of_6_by_6_is_refused(tmp_path):
    cfa = np.array(X_TRANS)[[5, 1, 2, 3, 4, 0]]
    with pytest.raises(DecodeError, match=r"a\.dng.*a mosaic of 6×6.*develop"):
        raw.read(written(tmp_path, RAMP, cfa=cfa.tolist()))


@pytest.mark.parametrize("layout", [2, 3, 9])
def test_super_ccd_is_refused_by_name(tmp_path, layout):
    path = written(tmp_path, RAMP)
    rectangular = struct.pack("<HHIHH", 50711, 3, 1, 1, 0)
    assert rectangular in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(rectangular, struct.pack("<HHIHH", 50711, 3, 1, layout, 0)))
    with pytest.raises(DecodeError, match=rf"CFALayout {layout}, SuperCCD.*16-bit TIFF"):
        raw.read(path)
    assert "SuperCCD, turned by 45°" in raw.unsupported((4, 4), rotated=True)


def test_foveon_is_refused_by_name(tmp_path):
    (tmp_path / "a.x3f").write_bytes(b"FOVb" + bytes(4096))
    with pytest.raises(DecodeError, match=r"a\.x3f.*Foveon's layers.*16-bit TIFF"):
        raw.read(tmp_path / "a.x3f")


def test_camera_matrix_takes_the_grey_of_the_shot_to_white_and_agrees_with_libraw(tmp_path):
    path = written(tmp_path, RAMP, neutral=(0.5, 1, 0.8))
    image = raw.read(path)
    np.testing.assert_allclose(image.white_balance, [2, 1, 1.25], rtol=1e-6)
    np.testing.assert_allclose(image.camera_matrix @ [0.5, 1, 0.8], 1, rtol=1e-5)
    with rawpy.imread(str(path)) as reference:
        libraw = reference.color_matrix[:, :3].copy()  # white-balanced camera → Rec.709
    np.testing.assert_allclose(image.camera_matrix / image.white_balance, libraw, atol=2e-3)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_channels_that_see_the_same_give_no_camera_matrix(scale):
    alike = scale * np.array([[0.9, 0.3, 0.1], [0.9, 0.3, 0.1], [-0.09, 0.19, 0.71]])
    assert raw.camera_matrix(alike, None) is None
    alike[0, 0] = np.inf
    assert raw.camera_matrix(alike, None) is None
    assert raw.camera_matrix(scale * np.eye(3), None) is not None


def test_without_a_white_balance_daylight_is_gray_and_green_has_gain_one():
    xyz_to_camera = np.array([[0.8, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]])
    daylight = xyz_to_camera @ REC709_TO_XYZ @ np.ones(3)
    np.testing.assert_allclose(raw.camera_matrix(xyz_to_camera, None) @ daylight, daylight[1])


def cut(path, whole, lengths):
    for length in lengths:
        path.write_bytes(whole[:length])
        with pytest.raises(DecodeError, match=path.name):
            raw.read(path)


def test_cut_file_is_one_error(tmp_path):
    whole = headers.dng(RAMP)
    cut(tmp_path / "cut.dng", whole, (len(whole) - 100, len(whole) - RAMP.nbytes, 300, 9))


@needs_data
def test_real_files_open():
    expected = {  # visible pixels, colours of the first cell, white
        "raw_other/IMG_5952.CR2": ((2348, 3522), [[0, 1], [1, 2]], 4095),
        "raw_chart/CRW_0101.CRW": ((1720, 2312), [[0, 1], [1, 2]], 1023),
        "raw_chart/P003910.KDC": ((976, 848), [[1, 0], [2, 1]], 255),
        "raw_bracket/sample1.dng": ((2868, 4310), [[1, 2], [0, 1]], 3840),
        "raw_other/canon_eos_6d.dng": ((816, 1224, 3), None, 65535),
    }
    for name, (shape, cfa, white) in expected.items():
        image = raw.read(DATA / "real" / name)
        assert (image.value.shape, image.cfa if cfa is None else image.cfa.tolist(), image.white) == (shape, cfa, white)
        assert np.percentile(image.value, 1) >= image.black.min() - 5, name
    assert raw.read(DATA / "real/raw_other/IMG_5952.CR2").black.tolist() == [[128, 128], [127, 128]]


@needs_data
@pytest.mark.parametrize("name", ["raw_other/IMG_5952.CR2", "raw_chart/CRW_0101.CRW", "raw_chart/P003910.KDC"])
def test_real_file_cut_short_is_one_error(tmp_path, name):
    whole = (DATA / "real" / name).read_bytes()
    cut(tmp_path / Path(name).name, whole, (int(share * len(whole)) for share in (0.9, 0.3, 0.01)))
