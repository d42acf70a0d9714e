"""Lossless JPEG of a DNG by libjpeg-turbo: what LibRaw decodes, to the count and to the error."""

import io

import numpy as np
import pytest

from polcap.errors import DecodeError
from polcap.formats.raw import dng_jpeg, sniff
from polcap.formats.raw import libraw as raw
from polcap.formats.raw.dng import lossless_jpeg
from tests.formats import headers

imagecodecs = pytest.importorskip("imagecodecs", reason="extra [fast] is not installed")

HEIGHT, WIDTH = 96, 128


def mosaic(bits=14, seed=0):
    """Slopes with noise, some pixels at either end of the range."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    top = 2**bits - 1
    plain = top * (0.2 + 0.5 * x / WIDTH + 0.2 * np.sin(y / 9)) + rng.normal(0, top / 300, (HEIGHT, WIDTH))
    plain[rng.random(plain.shape) < 0.002] = top
    plain[rng.random(plain.shape) < 0.002] = 0
    return np.clip(plain, 0, top).astype(np.uint16)


def predicted_by(number):
    def encode(part, bits):
        return imagecodecs.jpeg8_encode(part, lossless=True, predictor=number, bitspersample=bits)

    return encode


ONE = predicted_by(1)


def two_components(part, bits):
    return lossless_jpeg(part)


def dng(picture, encode=two_components, bits=14, tile=None, area=None, extra=()):
    """A DNG of lossless JPEG: one strip, or tiles, those at the border filled up with its last pixels."""
    height, width = picture.shape
    main = headers.camera() | {
        254: (4, (0,)), 256: (4, (width,)), 257: (4, (height,)), 258: (3, (16,)), 259: (3, (7,)), 262: (3, (32803,)),
        277: (3, (1,)), 284: (3, (1,)), 50706: (1, (1, 4, 0, 0)), 50708: (2, b"Acme Z1"),
        50717: (4, (2**bits - 1,)), 33421: (3, (2, 2)), 33422: (1, (0, 1, 1, 2)), 50710: (1, (0, 1, 2)),
        50711: (3, (1,)), 50713: (3, (2, 2)), 50714: (5, (64, 65, 66, 67)),
        50721: (10, (0.9, -0.3, -0.07, -0.45, 1.24, 0.23, -0.09, 0.19, 0.71)), 50728: (5, (0.5, 1, 0.8)),
        50778: (3, (21,)),
    }  # fmt: skip
    if area is not None:
        main[50829] = (4, area)
    tall, wide = tile or (height, width)
    padded = np.pad(picture, ((0, -height % tall), (0, -width % wide)), mode="edge")
    rows, columns = (range(0, side, step) for side, step in zip(padded.shape, (tall, wide)))
    parts = [encode(np.ascontiguousarray(padded[y : y + tall, x : x + wide]), bits) for y in rows for x in columns]
    parts = [part + b"\0" * (len(part) % 2) for part in parts]
    lengths = tuple(len(part) for part in parts)
    offsets, counts = (324, 325) if tile else (273, 279)
    main |= {322: (4, (wide,)), 323: (4, (tall,))} if tile else {278: (4, (height,))}
    main |= {counts: (4, lengths), offsets: (4, (0,) * len(parts))} | dict(extra)
    start = len(headers.tiff(main, {headers.EXIF_IFD: headers.settings()}))
    main[offsets] = (4, tuple(start + sum(lengths[:n]) for n in range(len(parts))))
    return headers.tiff(main, {headers.EXIF_IFD: headers.settings()}) + b"".join(parts)


def fast(data):
    return dng_jpeg.counts(sniff.structure(io.BytesIO(data)), data)


def answer(path):
    """Meaning and counts, or the error's words."""
    try:
        meta, arrays = raw.decode(str(path))
    except DecodeError as error:
        return str(error)
    return meta, {name: array.copy() for name, array in arrays.items()}


def by_libraw(path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(dng_jpeg, "counts", lambda structure, data: None)
        return answer(path)


def assert_alike(one, other):
    assert type(one) is type(other)
    if isinstance(one, str):
        assert one == other
        return
    assert one[0] == other[0] and one[1].keys() == other[1].keys()
    for name in one[1]:
        np.testing.assert_array_equal(one[1][name], other[1][name])


FORMS = {
    "two components": {},
    "one component": {"encode": ONE},
    "12 bits": {"encode": ONE, "bits": 12},
    "10 bits": {"encode": ONE, "bits": 10},
    "16 bits": {"bits": 16},
    "tiles": {"tile": (32, 32)},
    "tiles beyond the border": {"tile": (40, 48)},
    "tiles of one component": {"tile": (16, 32), "encode": ONE},
    "a masked border": {"area": (3, 6, 93, 126)},
    "tiles and a masked border": {"tile": (40, 48), "area": (2, 5, 96, 128)},
}


@pytest.mark.parametrize("form", FORMS)
def test_counts_and_what_they_mean_are_libraws(tmp_path, monkeypatch, form):
    options = FORMS[form]
    (tmp_path / "a.dng").write_bytes(dng(mosaic(options.get("bits", 14)), **options))
    assert fast((tmp_path / "a.dng").read_bytes()) is not None
    assert_alike(answer(tmp_path / "a.dng"), by_libraw(tmp_path / "a.dng", monkeypatch))


def even_corner(seed=0):
    """A mosaic whose last pixels are alike, as those of a decoder that ran out of data are."""
    plain = mosaic(seed=seed)
    plain[-1, -4:] = plain[-1, -4]
    return plain


@pytest.mark.parametrize("form", ["two components", "one component", "tiles beyond the border"])
def test_an_even_corner_is_no_end_of_data(tmp_path, monkeypatch, form):
    (tmp_path / "a.dng").write_bytes(dng(even_corner(), **FORMS[form]))
    assert fast((tmp_path / "a.dng").read_bytes()) is not None
    assert_alike(answer(tmp_path / "a.dng"), by_libraw(tmp_path / "a.dng", monkeypatch))


@pytest.mark.parametrize("form", ["two components", "one component"])
def test_data_that_end_early_are_left_to_libraw(form):
    for bits_short in range(1, 65):
        whole = dng(even_corner(bits_short), **FORMS[form])
        (window,) = dng_jpeg._windows(dng_jpeg._sensor(sniff.structure(io.BytesIO(whole))))
        start = dng_jpeg._scan(whole, window).start
        end = whole.index(b"\xff\xd9", start)
        coded = whole[start:end].replace(b"\xff\0", b"\xff")
        bits = "".join(f"{byte:08b}" for byte in coded)
        filling = min(7, len(bits) - len(bits.rstrip("1")))
        bits = bits[: -filling - bits_short]
        bits += -len(bits) % 8 * "1"
        cut = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
        bad = whole[:start] + cut + b"\xff\xd9" + whole[end + 2 :] + bytes(max(0, len(whole[start:end]) - len(cut)))
        assert fast(bad) is None


@pytest.mark.parametrize(
    "tag",
    [
        (50712, (3, tuple(range(0, 65536, 16)))),  # a linearization table
        (50830, (4, (0, 0, 90, 8))),  # masked areas
        (50706, (1, (1, 0, 0, 0))),  # DNG 1.0
    ],
)
def test_what_changes_the_counts_is_left_to_libraw(tmp_path, monkeypatch, tag):
    (tmp_path / "a.dng").write_bytes(dng(mosaic(), extra=[tag]))
    assert fast((tmp_path / "a.dng").read_bytes()) is None
    assert_alike(answer(tmp_path / "a.dng"), by_libraw(tmp_path / "a.dng", monkeypatch))


@pytest.mark.parametrize("predictor", range(2, 8))
def test_another_predictor_is_left_to_libraw(tmp_path, monkeypatch, predictor):
    data = dng(mosaic(), encode=predicted_by(predictor))
    assert fast(data) is None
    (tmp_path / "a.dng").write_bytes(data)
    np.testing.assert_array_equal(raw.read(tmp_path / "a.dng").value, mosaic())


def test_without_imagecodecs_libraw_decodes(tmp_path, monkeypatch):
    (tmp_path / "a.dng").write_bytes(dng(mosaic()))
    monkeypatch.setitem(__import__("sys").modules, "imagecodecs", None)
    assert fast((tmp_path / "a.dng").read_bytes()) is None
    assert raw.read(tmp_path / "a.dng").value.shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("form", ["two components", "one component", "16 bits"])
def test_damage_is_told_as_libraw_tells_it(tmp_path, monkeypatch, form):
    whole = dng(mosaic(FORMS[form].get("bits", 14)), **FORMS[form])
    scan = whole.index(b"\xff\xda", whole.index(b"\xff\xd8\xff")) + 16  # of damaged heads LibRaw returns old memory
    rng = np.random.default_rng(7)
    for _ in range(60):
        bad = bytearray(whole)
        for at in rng.integers(scan, len(bad) - 4, rng.integers(1, 4)):
            bad[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "a.dng").write_bytes(bad)
        assert_alike(answer(tmp_path / "a.dng"), by_libraw(tmp_path / "a.dng", monkeypatch))


def test_any_damage_is_a_picture_or_an_error(tmp_path):
    rng = np.random.default_rng(8)
    for form in ("two components", "tiles", "tiles beyond the border"):
        whole = dng(mosaic(), **FORMS[form])
        for _ in range(60):
            bad = bytearray(whole)
            for at in rng.integers(0, len(bad), rng.integers(1, 6)):
                bad[at] = int(rng.integers(256))
            cut = bytes(bad[: int(rng.integers(len(bad)))]) if rng.random() < 0.2 else bytes(bad)
            (tmp_path / "a.dng").write_bytes(cut)
            answer(tmp_path / "a.dng")
