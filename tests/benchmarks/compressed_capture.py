"""Makes a copy of a capture of uncompressed DNGs in lossless JPEG, as cameras store them, for benchmarks of time.

    pip install imagecodecs
    python tests/benchmarks/compressed_capture.py CAPTURE OUT

Each row of the mosaic becomes a row of pixels with two components, as in DNGs of cameras. LibRaw must read the
same counts from both files; otherwise the command stops.
"""

import shutil
import struct
import sys
from pathlib import Path

import imagecodecs
import numpy as np
import rawpy
from numpy.typing import NDArray

from polcap.formats.atomic import new_folder

_COMPRESSION, _STRIP_OFFSET, _STRIP_BYTES = 259, 273, 279  # TIFF tags
_LOSSLESS_JPEG = 7


def make(capture: Path, out: Path) -> None:
    """Write the frames of `capture` in lossless JPEG below `out`."""
    with new_folder(out) as temporary:
        for file in sorted(capture.rglob("*.DNG")):
            place = temporary / file.relative_to(capture)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(_compressed(file))
            if not np.array_equal(_counts(file), _counts(place)):
                raise SystemExit(f"{file}: LibRaw reads other counts from the lossless JPEG")
        for truth in capture.glob("truth.*"):
            shutil.copy(truth, temporary)


def _compressed(file: Path) -> bytes:
    """The DNG with its only strip, which is the end of the file, as one lossless JPEG of 14 bits."""
    data, counts = file.read_bytes(), _counts(file)
    height, width = counts.shape
    jpeg: bytes = imagecodecs.jpeg_encode(
        counts.reshape(height, width // 2, 2), lossless=True, predictor=1, bitspersample=14, colorspace=0
    )
    (directory,) = struct.unpack_from("<I", data, 4)
    (number,) = struct.unpack_from("<H", data, directory)
    places = {
        struct.unpack_from("<H", data, entry)[0]: entry + 8
        for entry in range(directory + 2, directory + 2 + 12 * number, 12)
    }
    (offset,) = struct.unpack_from("<I", data, places[_STRIP_OFFSET])
    head = bytearray(data[:offset])
    struct.pack_into("<H", head, places[_COMPRESSION], _LOSSLESS_JPEG)
    struct.pack_into("<I", head, places[_STRIP_BYTES], len(jpeg))
    return bytes(head) + jpeg


def _counts(file: Path) -> NDArray[np.uint16]:
    with rawpy.imread(str(file)) as raw:
        counts: NDArray[np.uint16] = raw.raw_image.copy()
        return counts


if __name__ == "__main__":
    make(Path(sys.argv[1]), Path(sys.argv[2]))
