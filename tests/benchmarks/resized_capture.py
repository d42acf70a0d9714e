"""Makes a copy of a capture of Bayer DNGs at another size, as uncompressed DNGs, for benchmarks of time and memory.

    python tests/benchmarks/resized_capture.py CAPTURE OUT MEGAPIXELS

The four planes of each mosaic are resized; where they grow, noise of the counts' own size is put back, for merging and
finding weigh by it. Focal length in pixels grows as the picture does. For times and memory, not for accuracy.
"""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.formats import dng_writer
from polcap.formats.atomic import new_folder
from polcap.formats.raw import libraw as raw
from polcap.formats.raw import probe

_ELECTRONS = 0.25  # counts per electron of the synthetic camera, about: the noise that is put back
_DAYLIGHT = np.array([0.5, 1.0, 0.6])
_SRGB_FROM_XYZ = np.array([[3.2405, -1.5371, -0.4985], [-0.9693, 1.876, 0.0416], [0.0556, -0.204, 1.0572]])


def make(capture: Path, out: Path, megapixels: float) -> None:
    """Write the frames of `capture` with about so many pixels each below `out`."""
    with new_folder(out) as temporary:
        for number, file in enumerate(sorted(capture.rglob("*.DNG"))):
            place = temporary / file.relative_to(capture)
            place.parent.mkdir(parents=True, exist_ok=True)
            _frame(file, place, megapixels, np.random.default_rng(number))
        for truth in capture.glob("truth.json"):
            shutil.copy(truth, temporary / "not-to-scale.json")


def _frame(source: Path, target: Path, megapixels: float, rng: np.random.Generator) -> None:
    image, known = raw.read(source), probe.read(source)
    counts: NDArray[np.uint16] = image.value.astype(np.uint16)
    assert image.cfa is not None
    stated = known.exif.color_matrix
    height, width = image.value.shape
    grown = float(np.sqrt(megapixels * 1e6 / (height * width)))
    size = tuple(round(side * grown / 2) for side in (width, height))
    out = np.empty((2 * size[1], 2 * size[0]), np.uint16)
    for y in (0, 1):
        for x in (0, 1):
            out[y::2, x::2] = _plane(counts[y::2, x::2], size, float(image.black[y, x]), image.white, grown, rng)
    matrix = _SRGB_FROM_XYZ if stated is None else np.reshape(stated, (3, 3))
    neutral = _DAYLIGHT if image.white_balance is None else 1 / image.white_balance
    dng_writer.write(
        target, out, cfa=image.cfa, black=image.black, white=image.white, exif=known.exif, color_matrix=matrix,
        as_shot_neutral=neutral,
    )  # fmt: skip


def _plane(
    plane: NDArray[np.uint16], size: tuple[int, ...], black: float, white: float, grown: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    if grown == 1:
        return plane
    way = cv2.INTER_AREA if grown < 1 else cv2.INTER_LINEAR
    large = cv2.resize(plane.astype(np.float32), size, interpolation=way)
    if grown > 1:
        large += rng.standard_normal(large.shape, np.float32) * np.sqrt(np.maximum(large - black, 1) * _ELECTRONS)
    clipped = cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST) >= white
    return np.where(clipped, white, np.clip(np.rint(large), 0, 65535)).astype(np.uint16)


if __name__ == "__main__":
    make(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
