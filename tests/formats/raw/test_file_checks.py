"""Defective files are refused: cut, stripped, of a form that LibRaw misreads, or with impossible levels."""

import struct

import cv2
import numpy as np
import pytest

from polcap.errors import DecodeError
from polcap.formats.raw import file_checks, file_kind, photo, probe
from polcap.formats.raw import libraw as raw
from tests.formats import headers

MOSAIC = np.random.default_rng(4).integers(600, 9000, (60, 84)).astype(np.uint16)
BLACK = [[512, 512], [512, 512]]


def written(tmp_path, data, name="a.dng"):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


def test_a_jpeg_cut_anywhere_is_refused(tmp_path, rng):
    picture = cv2.GaussianBlur(rng.integers(0, 255, (64, 96, 3)).astype(np.uint8), (0, 0), 2)
    for options in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]):
        whole = cv2.imencode(".jpg", picture, options)[1].tobytes()
        assert photo.read(written(tmp_path, whole, "a.jpg")).value.shape == (64, 96, 3)
        assert probe.read(written(tmp_path, whole + b"a maker's trailer", "a.jpg")).kind == "photo"
        for length in (*range(4, len(whole) - 1, max(1, len(whole) // 9)), len(whole) - 2, len(whole) - 1):
            for tail in (b"", bytes(len(whole) - length)):  # cut, or filled with zeros as after a broken copy
                path = written(tmp_path, whole[:length] + tail, "a.jpg")
                with pytest.raises(DecodeError, match=r"a\.jpg"):
                    probe.read(path)


def jpeg_raw(coded):
    """An old Kodak's RAW: a TIFF with a sensor image of JPEG data."""
    main = headers.camera(b"Kodak", b"DC240") | headers.of_picture(np.zeros((64, 96, 1), np.uint8))
    main |= {254: (4, (0,)), 259: (3, (7,)), 262: (3, (32803,)), 279: (4, (len(coded),)), 33421: (3, (2, 2))}
    main |= {33422: (1, (0, 1, 1, 2))}
    return headers.tiff(main, image=coded)


def test_a_raw_of_cut_jpeg_data_is_refused(rng):
    coded = cv2.imencode(".jpg", rng.integers(0, 255, (64, 96)).astype(np.uint8))[1].tobytes()
    file_checks.check_structure("a.kdc", file_kind.structure(jpeg_raw(coded)), jpeg_raw(coded))
    for data in (coded[:-200] + bytes(200), coded[:-2]):
        with pytest.raises(DecodeError, match=r"a\.kdc: is cut short, its JPEG data have no end"):
            file_checks.check_structure("a.kdc", file_kind.structure(jpeg_raw(data)), jpeg_raw(data))


def test_a_stripped_dng_is_refused(tmp_path):
    whole = bytearray(headers.dng(MOSAIC, black=BLACK))
    assert raw.read(written(tmp_path, bytes(whole))).value.shape == MOSAIC.shape
    for tag in (273, 279, 262):  # without offsets, lengths, or photometric interpretation
        at = whole.index(tag.to_bytes(2, "little"), 8)
        bare = whole.copy()
        bare[at : at + 2] = (65000).to_bytes(2, "little")
        with pytest.raises(DecodeError, match=r"stripped|no RAW|not a readable|cannot hold"):
            probe.read(written(tmp_path, bytes(bare)))
    short = whole.replace((MOSAIC.nbytes).to_bytes(4, "little"), (MOSAIC.nbytes // 3).to_bytes(4, "little"), 1)
    with pytest.raises(DecodeError, match=r"image data where 84×60 px need 10080; it was stripped"):
        probe.read(written(tmp_path, bytes(short)))


def compressed(number):
    """A DNG with this number as compression of its image."""
    entry = struct.pack("<HHI", 259, 3, 1)
    return headers.dng(MOSAIC).replace(entry + struct.pack("<H", 1), entry + struct.pack("<H", number), 1)


@pytest.mark.parametrize(("number", "words"), [(9, r"GoPro GPR \(VC-5 compression 9\)"), (52546, "JPEG XL")])
def test_a_form_that_libraw_cannot_decode_is_named(tmp_path, number, words):
    path = written(tmp_path, compressed(number))
    with pytest.raises(DecodeError, match=words):
        probe.read(path)


def test_a_lossy_dng_that_decodes_to_black_is_named():
    with pytest.raises(DecodeError, match=r"lossy DNG \(JPEG compression 34892\) that LibRaw decodes to black"):
        file_checks.check_levels("a.dng", np.zeros((8, 8, 3), np.uint16), 0.0, 65535.0, lossy=True)
    file_checks.check_levels("a.dng", MOSAIC, 0.0, 65535.0, lossy=True)
    assert file_checks.is_lossy(file_kind.structure(compressed(34892)))


def test_a_remnant_of_a_panasonic_is_refused(tmp_path):
    main = headers.camera(b"Panasonic", b"DMC-G9") | {
        1: (7, b"0340"), 2: (3, (5488,)), 3: (3, (3904,)), 4: (3, (8,)), 5: (3, (8,)), 6: (3, (3896,)), 7: (3, (5480,)),
        9: (3, (4,)), 10: (3, (12,)), 0x118: (4, (2048,)),
    }  # fmt: skip
    data = headers.tiff(main, {headers.EXIF_IFD: headers.settings()}, magic=b"IIU\0").ljust(12_000, b"\x5a")
    path = written(tmp_path, data, "P1.RW2")
    for read in (probe.read, raw.read):
        with pytest.raises(DecodeError, match=r"P1\.RW2: (12 kB cannot hold|truncated|no RAW)"):
            read(path)


def test_a_white_level_below_the_counts_is_refused(tmp_path, rng):
    scan = rng.integers(1000, 65000, (60, 84, 3)).astype(np.uint16)  # as a film scanner writes it
    path = written(tmp_path, headers.dng(scan, photometric=34892, white=255))
    with pytest.raises(DecodeError, match=r"white level is 255, but its counts reach 6\d{4}"):
        raw.read(path)
    hot = MOSAIC.copy()
    hot[3, 5] = 60000  # one hot pixel above the white level is accepted
    assert raw.read(written(tmp_path, headers.dng(hot, black=BLACK, white=16383))).white == 16383


@pytest.mark.parametrize(("first", "words"), [(-6, "last rows are empty"), (0, "every count is 0")])
def test_rows_that_were_never_written_are_refused(tmp_path, first, words):
    cut = MOSAIC.copy()
    cut[first:] = 0
    with pytest.raises(DecodeError, match=words):
        raw.read(written(tmp_path, headers.dng(cut, black=BLACK)))


def test_a_raw_that_begins_with_text_is_not_taken_for_text(tmp_path, rng):
    """A Rollei's file begins with lines of text; LibRaw knows it by its first word."""
    head = b"DSC-Image\nHDR=1024\nX=84\nY=60\nTX=8\nTY=8\nEOHD\n".ljust(1024, b" ")
    data = head + rng.integers(0, 255, 84 * 60 * 10 // 8 + 64, dtype=np.uint8).tobytes()
    assert probe.read(written(tmp_path, data, "rollei.raw")).kind != "other"
    assert probe.read(written(tmp_path, b"a note\n" * 40, "note")).kind == "other"


def test_tags_of_many_forms_do_not_hang(tmp_path):
    """A million duplicate directories, offsets that loop, tags without values."""
    loop = headers.tiff(headers.camera(), {330: {330: (4, (8,))}})
    assert len(file_kind.structure(loop).directories) == 2
    many = headers.tiff(headers.camera() | {330: (4, (8,) * 200_000)})
    empty = bytearray(headers.dng(MOSAIC))
    at = empty.index((262).to_bytes(2, "little") + b"\3\0")
    empty[at + 4 : at + 8] = bytes(4)  # count 0
    for data in (many, bytes(empty)):
        with written(tmp_path, data, "many.dng").open("rb") as file:
            file_kind.kind(file, ".dng")
        assert len(file_kind.structure(data).directories) < 65
