"""Charts in real photographs and path-traced captures: found where eyes marked them, refused where there is none."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from polcap.chart_values import ChartReference, ColorCalibration
from polcap.errors import ChartError
from polcap.image_values import Floats, View
from polcap.optics.color import decode_srgb
from polcap.stage_values import AngleStack
from tests.stages.whitebalance.chart_pictures import CLASSIC, measure, stack

DATA = os.environ.get("POLCAP_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="POLCAP_DATA is not set: no real charts")
REAL = Path(DATA or ".") / "real"
RENDERED = Path(DATA or ".") / "rendered"
PHOTOS = sorted((REAL / "charts").glob("*.jpg"))
SCENES = ["d21_spot", "d22_demosthenes", "d23_penguin", "d24_scorpion"]


def photo(path: Path) -> AngleStack:
    """An 8-bit photograph as linear light, half size where it is large."""
    image = cv2.imread(str(path))
    assert image is not None
    step = 2 if max(image.shape) > 2000 else 1
    return stack(decode_srgb(image[::step, ::step, ::-1] / 255.0), clip=decode_srgb(np.array(254 / 255.0)))


def superpixels(path: Path) -> Floats:
    """A RAW file binned 2×2, (counts − black)/(white − black)."""
    import rawpy

    with rawpy.imread(str(path)) as raw:
        counts, names = raw.raw_image_visible.astype(np.float32), raw.color_desc.decode()
        black, white, pattern = raw.black_level_per_channel, raw.white_level, raw.raw_pattern.copy()
    counts = counts[: counts.shape[0] // 2 * 2, : counts.shape[1] // 2 * 2]
    binned = np.zeros((counts.shape[0] // 2, counts.shape[1] // 2, 3))
    for (y, x), index in np.ndenumerate(pattern):
        channel = "RGB".index(names[index])
        share = 0.5 if channel == 1 else 1.0
        binned[..., channel] += share * (counts[y::2, x::2] - black[index]) / (white - black[index])
    return binned


# Outer corners of the outer patches, marked by eye in enlarged pictures; px as `photo` and `superpixels` give them.
MARKED = {
    "Apple_iPhone_13_Pro": ((1285, 147), (1292, 1895), (145, 1899), (151, 149)),
    "Canon_PowerShot_G2": ((72, 84), (1041, 82), (1045, 710), (77, 718)),
    "Canon_PowerShot_G6": ((125, 54), (572, 55), (577, 347), (118, 347)),
    "Canon_Rebel_XT_350D": ((116, 1588), (107, 158), (1037, 158), (1042, 1577)),
    "IMG_20140613_203438": ((811, 449), (570, 692), (381, 594), (628, 378)),
    "Kodak_DC210": ((181, 203), (979, 205), (979, 726), (178, 723)),
    "Nikon_D3100": ((186, 2066), (196, 295), (1339, 312), (1333, 2056)),
    "Panasonic_DS_CAMERA": ((353, 308), (963, 307), (958, 703), (357, 700)),
    "Pentax__ist_DL": ((125, 81), (1383, 86), (1378, 908), (125, 899)),
    "Sony_DSC-P5": ((138, 184), (854, 179), (853, 646), (130, 654)),
    "TL84_colorchecker": ((308, 316), (1028, 314), (1027, 783), (310, 784)),
    "exposure30": ((317, 334), (1031, 331), (1033, 798), (317, 798)),
    "passport": ((740, 337), (328, 338), (329, 68), (739, 67)),
    "CRW_0101.CRW": ((109, 98), (1022, 93), (1021, 685), (117, 693)),
    "P003910.KDC": ((13, 69), (279, 60), (279, 338), (13, 336)),
}
_MARK = 0.02  # of the chart's longer side


def corners_off(color: ColorCalibration, marked: tuple[tuple[float, float], ...]) -> float:
    """Greatest distance of a corner from its mark, of the chart's longer side."""
    assert color.place is not None
    side = max(np.linalg.norm(np.subtract(marked[0], marked[1])), np.linalg.norm(np.subtract(marked[1], marked[2])))
    return float(np.linalg.norm(color.place.corners - np.array(marked), axis=-1).max() / side)


@needs_data
@pytest.mark.parametrize("path", PHOTOS, ids=lambda path: path.stem)
def test_classic_is_found_in_every_real_photograph(path):
    color = measure(photo(path))
    linear = path.stem in ("TL84_colorchecker", "exposure30")  # not gamma-encoded: decoding them bends their greys
    assert np.nanmean(color.patches.delta_e) < (14 if linear else 7)
    assert corners_off(color, MARKED[path.stem]) < _MARK


@needs_data
@pytest.mark.parametrize(("name", "fitted", "ahead"), [("CRW_0101.CRW", 2.6, 3.2), ("P003910.KDC", 5.0, 6.0)])
def test_classic_is_found_in_real_raw_files(name, fitted, ahead):
    color = measure(stack(superpixels(REAL / "raw_chart" / name)))
    assert np.nanmean(color.patches.delta_e) < fitted
    assert np.nanmean(color.patches.predicted) < ahead
    assert corners_off(color, MARKED[name]) < _MARK


@needs_data
def test_a_chart_of_18_patches_is_refused():
    with pytest.raises(ChartError, match="no ColorChecker Classic"):
        measure(photo(REAL / "charts" / "1.png"))


def rendered(name: str) -> tuple[AngleStack, dict[str, Any], dict[str, Any]]:
    """The 0° bracket merged on its true exposures, unclipped samples only."""
    meta = json.loads((RENDERED / f"{name}.meta.json").read_text())
    truth = json.loads((RENDERED / f"{name}.truth.json").read_text())
    total, weight = np.zeros(()), np.zeros(())
    for shot in truth["shots"][:3]:
        exposure = shot["relative_exposure"] * shot["flash_factor"]
        frame = superpixels(RENDERED / shot["file"])
        good = np.all(frame < 0.9, axis=-1, keepdims=True)
        total, weight = total + good * frame, weight + good * exposure
    first = truth["shots"][0]["relative_exposure"] * truth["shots"][0]["flash_factor"]
    view = View(meta["fx"] / 2, ((meta["cx"] - 1) / 2, (meta["cy"] - 1) / 2), 2.0)
    return stack(first * total / np.maximum(weight, 1e-9), view), meta, truth


@needs_data
@pytest.mark.parametrize("name", SCENES)
def test_path_traced_chart_is_found_and_its_camera_matrix_recovered(name):
    radiance, meta, truth = rendered(name)
    printed = ChartReference("as rendered", np.array(meta["chart"]["reference_linear_srgb"]), CLASSIC.size_m)
    color = measure(radiance, reference=printed, chart_width_m=0.0165 * 5.862)
    true = (np.array(meta["chart"]["patch_corners_px"]) - 1) / 2  # RAW px with centers on +½ → binned px
    error = np.linalg.norm(color.place.quads.mean(axis=1) - true.mean(axis=1), axis=-1)
    assert np.median(error) < 0.05 and error.max() < 0.15
    identity = color.matrix @ np.array(truth["camera_matrix_from_linear_srgb"])
    assert identity / np.trace(identity) * 3 == pytest.approx(np.eye(3), abs=0.006)
    assert np.nanmean(color.patches.delta_e) < 0.3
    assert color.metres_per_px == pytest.approx(-meta["chart"]["c"][2] / radiance.view.focal, rel=3e-3)


@needs_data
@pytest.mark.parametrize("name", SCENES)
def test_path_traced_scene_without_its_chart_is_refused(name):
    radiance, meta, _ = rendered(name)
    x0 = int(np.min(np.array(meta["chart"]["patch_corners_px"])[..., 0]) / 2) - 6
    x1 = int(np.max(np.array(meta["chart"]["patch_corners_px"])[..., 0]) / 2) + 6
    image = radiance.value[0]
    rest = image[:, :x0] if x0 > image.shape[1] - x1 else image[:, x1:]
    with pytest.raises(ChartError, match="no ColorChecker Classic"):
        measure(stack(rest))
