"""Real and third-party polarizer photographs in, what the Stokes parameters say of them out.

    python tests/benchmarks/bench_real.py $POLCAP_DATA/real

Four angles give a check that three do not: I₀ + I₉₀ = I₄₅ + I₁₃₅. Normals rendered by another group
under natural light, which is reflected rather than diffuse, show how AoLP relates to azimuth there.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from polcap.config import Config
from polcap.formats import capture as captures
from polcap.formats import png
from polcap.images import AngleStack, Floats
from polcap.optics import mueller
from polcap.stages import hdr


def main() -> None:
    real = Path(sys.argv[1])
    for name in ("polarizer_rotated/macbeth_classic", "polarizer_rotated/potery", "polarization_mosaic"):
        radiance = merged(real / name)
        print(f"{name}: median |I0 + I90 - I45 - I135|/S0 = {100 * residual(radiance):.2f} %")
    for name in sorted(path.name for path in (real / "polarized_ground_truth" / "normal").glob("*.png")):
        along, across = against_normals(real / "polarized_ground_truth", name)
        print(f"{name}: median |AoLP - azimuth| {along:.1f} degrees, from its perpendicular {across:.1f}")


def merged(folder: Path) -> AngleStack:
    return hdr.merge(captures.read(folder, None), Config().hdr)


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
