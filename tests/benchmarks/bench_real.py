"""Consistency of Stokes parameters from real and third-party photographs through a polarizer.

    python tests/benchmarks/bench_real.py $POLCAP_DATA/real

Four angles give a check that three do not: I₀ + I₉₀ = I₄₅ + I₁₃₅. Normals rendered by another group
under natural light, which is reflected rather than diffuse, show how AoLP relates to azimuth there. A mosaic goes
through the path as `process` runs it, and is compared with polanalyser, where that is installed (`pip install
polanalyser`), on the same pixels.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.formats.maps import png
from polcap.formats.raw import frame_decoder
from polcap.images import Floats
from polcap.optics import mueller
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.stage_values import AngleStack
from polcap.stages import hdr


def main() -> None:
    real = Path(sys.argv[1])
    for name in ("polarizer_rotated/macbeth_classic", "polarizer_rotated/potery", "polarization_mosaic"):
        radiance = merged(real / name)
        print(f"{name}: median |I0 + I90 - I45 - I135|/S0 = {100 * residual(radiance):.2f} %")
    against_polanalyser(real / "polarization_mosaic")
    for name in sorted(file.name for file in (real / "polarized_ground_truth" / "normal").glob("*.png")):
        along, across = against_normals(real / "polarized_ground_truth", name)
        print(f"{name}: median |AoLP - azimuth| {along:.1f} degrees, from its perpendicular {across:.1f}")


def against_polanalyser(folder: Path) -> None:
    """Gains and offsets of a mosaic as found; DoLP and AoLP against polanalyser's bilinear demosaicing."""
    try:
        import polanalyser
    except ImportError:
        print("polanalyser is not installed: mosaic not compared")
        return
    capture = captures.read(folder, None)
    supplied = UserInput(ChartRequest("none"), None, None, models.load_mask_network(1))
    found = path(capture, supplied, Config(), MemoryCache(until="stokes"))
    gains, alignment, image = found.selfcal.gains, found.alignment, found.stokes
    print(f"gains all 1: {bool((gains.gain == 1).all())} ({gains.source})")
    print(f"offsets [merged px]: {(-alignment.transform[:, :2, 2]).tolist()}")
    (x0, y0), (height, width) = (round(at) for at in image.view.origin), image.mask.shape
    counts = np.uint16(257) * png.read(Path(capture.shots[0].frames[0].path))  # their means are rounded to integers
    here = np.s_[
        2 * y0 + 1 : 2 * (y0 + height) : 2, 2 * x0 + 1 : 2 * (x0 + width) : 2
    ]  # where 0° stands: the first shot
    planes = [plane[here] / 1.0 for plane in polanalyser.demosaicing(counts, polanalyser.COLOR_PolarMono)]
    theirs = polanalyser.calcStokes(planes, [polanalyser.polarizer(angle) for angle in np.radians([0, 45, 90, 135])])
    s0, s1, s2 = image.stokes.mean(-1)
    use = image.mask & (image.quality == 0)
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-9) - polanalyser.cvtStokesToDoLP(theirs)
    aolp = np.arctan2(s2, s1) / 2 - polanalyser.cvtStokesToAoLP(theirs)
    sure = use & (polanalyser.cvtStokesToDoLP(theirs) > 0.03)
    print(f"against polanalyser, medians over {use.sum()} px: DoLP {np.median(np.abs(dolp[use])):.4f}, ", end="")
    print(f"AoLP {median_turn(aolp, use):.2f} degrees; of DoLP over .03 {median_turn(aolp, sure):.2f}")


def merged(folder: Path) -> AngleStack:
    return hdr.merge(captures.read(folder, None), frame_decoder.decode, Config().hdr)


def residual(radiance: AngleStack) -> float:
    """Median over unsaturated pixels above the 20th percentile of light, after a Gaussian of 2 px."""
    smooth = [cv2.GaussianBlur(value.mean(-1), (0, 0), 2.0) for value in radiance.value]
    i0, i45, i90, i135 = smooth
    s0 = (i0 + i45 + i90 + i135) / 2
    use = (radiance.quality == 0).all(0) & (s0 > np.percentile(s0, 20))
    return float(np.median(np.abs(i0 + i90 - i45 - i135)[use] / s0[use]))


def against_normals(folder: Path, name: str) -> tuple[float, float]:
    """Median angle between AoLP and the normals' azimuth, and its perpendicular, where tilt and DoLP show [degrees]."""
    with tempfile.TemporaryDirectory() as place:
        for angle in ("pol000", "pol045", "pol090", "pol135"):
            (Path(place) / angle).mkdir()
            (Path(place) / angle / name).symlink_to((folder / angle / name).resolve())
        radiance = merged(Path(place))
    light = np.stack([cv2.GaussianBlur(value.mean(-1), (0, 0), 1.0) for value in radiance.value])
    s0, s1, s2 = np.tensordot(np.linalg.pinv(mueller.analyzer(radiance.angle)), light, axes=1)
    normal = png.read(folder / "normal" / name)[..., :3].astype(np.float64) / 65535 * 2 - 1
    mask = png.read(folder / "mask" / name)
    inside = (mask if mask.ndim == 2 else mask[..., 0]) > 0
    use = inside & (np.hypot(normal[..., 0], normal[..., 1]) > 0.3) & (np.hypot(s1, s2) > 0.03 * s0)
    aolp, azimuth = np.arctan2(s2, s1) / 2, np.arctan2(normal[..., 1], normal[..., 0])
    return median_turn(aolp - azimuth, use), median_turn(aolp - azimuth + np.pi / 2, use)


def median_turn(angle: Floats, use: Floats) -> float:
    """Median of |angle mod π| over the chosen pixels, degrees."""
    return float(np.degrees(np.median(np.abs((angle[use] + np.pi / 2) % np.pi - np.pi / 2))))


if __name__ == "__main__":
    main()
