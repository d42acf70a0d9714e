"""Benchmark of the merge: error over brightness and time, against HDRutils on the same simulated brackets.

    pip install --no-deps --target DIR HDRutils
    python tests/benchmarks/bench_hdr.py DIR

HDRutils (MIT, Hanji et al.) merges in the mosaic here (demosaic_first=False) and its demosaicing is replaced
by the 2×2 binning that polcap uses, so that only the merges differ. Its file formats other than DNG, and
the plots, are not needed: packages it imports for them are stubbed where they are missing.
"""

import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import MagicMock

import numpy as np
import rawpy

from polcap.capture_values import Capture, Exif, Frame, Shot
from polcap.formats import dng_writer
from polcap.images import Floats, SensorImage
from polcap.optics import demosaic
from polcap.stages import hdr

T = TypeVar("T")
RGGB = np.array([[0, 1], [1, 2]], np.uint8)
BLACK, WHITE, READ, GAIN = 512, 15871, 3.0, 2.0
SIZE = (1536, 2304)


def main(folder: str) -> None:
    theirs = load_hdrutils(folder)
    y, x = np.mgrid[: SIZE[0] // 2, : SIZE[1] // 2]
    level = 15 * np.exp(x / x.max() * np.log(6000)) * (1 + 0.2 * np.sin(x / 7) * np.sin(y / 5))
    quads = level[..., None] * np.array([0.6, 1.0, 0.7])  # electrons at exposure 1
    for title, exposures, jitter in (
        ("times as stated", (0.25, 1, 4), 0.0),
        ("flash jitter 1.5 %", (0.25, 1, 4), 0.015),
        ("many frames", (1 / 16, 0.25, 1, 4), 0.0),
    ):
        with tempfile.TemporaryDirectory() as place:
            compare(title, theirs, quads, exposures, jitter, Path(place))


def load_hdrutils(folder: str) -> Any:
    sys.path.insert(0, folder)
    for name in ("imageio", "imageio.v3", "pyexr", "tqdm", "skimage", "matplotlib", "matplotlib.pyplot"):
        try:
            importlib.import_module(name)
        except ImportError:
            shallow = MagicMock()
            if name == "tqdm":
                shallow.tqdm = lambda items, **_: items
                shallow.trange = lambda n, **_: range(n)
            sys.modules[name] = shallow
    binned = MagicMock()
    binned.demosaicing_CFA_Bayer_bilinear = lambda mosaic, _: np.moveaxis(demosaic.superpixel(mosaic, RGGB), 0, -1)
    sys.modules["colour_demosaicing"] = binned
    return importlib.import_module("HDRutils.merge")


def compare(title: str, theirs: Any, quads: Floats, exposures: tuple[float, ...], jitter: float, place: Path) -> None:
    rng = np.random.default_rng(1)
    paths, true = [], []
    for k, exposure in enumerate(exposures):
        true.append(exposure * (1 + jitter * rng.normal()))
        light: Floats = np.empty(SIZE)
        for i, j in np.ndindex(2, 2):
            light[i::2, j::2] = quads[..., RGGB[i, j]] * true[-1]
        counts = (rng.poisson(light) + rng.normal(0, READ, SIZE)) / GAIN + BLACK
        exif = Exif(exposure_time=exposure / 100, f_number=8.0, iso=100.0, focal_length_mm=50.0)
        paths.append(place / f"{k}.dng")
        dng_writer.write(
            paths[-1], np.clip(np.round(counts), 0, WHITE).astype(np.uint16), cfa=RGGB, black=BLACK, white=WHITE,
            exif=exif, color_matrix=np.eye(3), as_shot_neutral=np.ones(3),
        )  # fmt: skip
    shot = Shot(0.0, tuple(frame(p, e / 100) for p, e in zip(paths, exposures)))
    capture = Capture("", "", (shot,), "folders", 1000.0, True, (0.0, 0.0), SIZE[::-1])
    stack, ours_s = timed(lambda: hdr.merge(capture, decode, hdr.HdrSettings()))
    reference = int(np.argmax(np.all(stack.bracket.exposure_ratio[0] == 1, axis=1)))
    truth = quads * true[reference] / GAIN / (WHITE - BLACK)
    clear = (stack.quality[0] & 1) == 0
    print(f"\n{title}: exposures {exposures}, {SIZE[0] * SIZE[1] / 1e6:.1f} MP")
    rows: dict[str, tuple[Floats, float]] = {"polcap": (stack.value[0], ours_s)}
    for name, estimate in (("HDRutils, EXIF times", None), ("HDRutils, estimated (mst)", "mst")):
        options = {"demosaic_first": False, "color_space": "raw", "estimate_exp": estimate}
        (image, _), seconds = timed(partial(theirs.merge, [str(p) for p in paths], **options))
        scale = truth[clear].sum() / image[clear].sum()  # its unit is free: the best scale is given to it
        rows[name] = (image * scale, seconds)
    heads = ["from 20 e⁻ up", *(f"{band:g} e⁻" for band in BANDS)]
    print(f"{'':28s}{'CPU s':>8s}" + "".join(f"{head:>18s}" for head in heads) + "   relative rms (bias) %")
    light = quads * true[reference]
    for name, (image, seconds) in rows.items():
        cells = []
        for low, high in [(20, np.inf), *((band, 2 * band) for band in BANDS)]:
            inside = clear[..., None] & (light > low) & (light < high)
            error = image[inside] / truth[inside] - 1
            some = f"{100 * np.sqrt(np.mean(error**2)):9.3f} ({100 * error.mean():+6.3f})" if error.size else "-"
            cells.append(some)
        print(f"{name:28s}{seconds:8.2f}" + "".join(f"{c:>18s}" for c in cells))
    print(f"speed: HDRutils / polcap = {rows['HDRutils, EXIF times'][1] / ours_s:.2f}", end=" ")
    print(f"(with estimated exposures {rows['HDRutils, estimated (mst)'][1] / ours_s:.2f})")


BANDS = (20, 100, 500, 2000, 8000, 20000, 50000)  # electrons at the reference exposure, up to twice that


def frame(path: Path, seconds: float) -> Frame:
    return Frame(str(path), Exif(exposure_time=seconds, iso=100.0), "shot", "")


def decode(frame: Frame) -> SensorImage:
    with rawpy.imread(frame.path) as raw:
        return SensorImage(raw.raw_image_visible.copy(), np.full((2, 2), float(BLACK)), float(WHITE), RGGB)


def timed(work: Callable[[], T]) -> tuple[T, float]:
    work()  # once for warming up
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


if __name__ == "__main__":
    main(sys.argv[1])
