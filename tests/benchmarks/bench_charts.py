"""Benchmark of the chart detection: charts found and false detections, compared with OpenCV's `cv2.mcc` alone.

    python tests/benchmarks/bench_charts.py [--pictures 216] [--first 0]

Needs POLCAP_DATA. Prints a row per photograph of a chart (corner error in percent of the chart's longer side against
corners marked by eye, mean ΔE2000 of a 3 × 3 matrix, and of patches left out of the fit), and how many of
--pictures without a ColorChecker Classic were taken for one: views of the environments, textures of the
materials, 6 × 4 swatches cut from them on a dark card, and an 18-patch chart seen from many sides. With --first
above 0 only those from that number on.
"""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polcap.errors import ChartError
from polcap.image_values import Floats
from polcap.optics.color import decode_srgb, encode_srgb
from polcap.stage_values import AngleStack
from polcap.stages import whitebalance
from polcap.stages.whitebalance import WhitebalanceSettings, patches
from polcap.stages.whitebalance.color_matrix import fit_matrix
from tests.experiments import arguments
from tests.stages.whitebalance.chart_pictures import AUTO, CLASSIC, stack
from tests.stages.whitebalance.test_real_charts import DATA, MARKED, PHOTOS, REAL, corners_off, photo, superpixels

_SIDE = (480, 640)
_ACCEPTED_COST = 0.06  # the same limit as polcap's own, so that the tests after it are what is compared


def photographs() -> None:
    print(f"{'':22}{'polcap':>28}{'cv2.mcc':>20}")
    print(f"{'photograph':22}{'corner %':>10}{'ΔE':>8}{'left out':>10}{'corner %':>12}{'ΔE':>8}")
    raws = [("CRW_0101.CRW", REAL / "raw_chart"), ("P003910.KDC", REAL / "raw_chart")]
    for name, radiance in [
        *((path.stem, photo(path)) for path in PHOTOS),
        *((name, stack(superpixels(folder / name))) for name, folder in raws),
    ]:
        color = whitebalance.measure(radiance, CLASSIC, AUTO, WhitebalanceSettings())
        plain = opencv(radiance)
        colors = color.patches
        assert colors is not None and colors.predicted is not None
        own = (100 * corners_off(color, MARKED[name]), np.nanmean(colors.delta_e), np.nanmean(colors.predicted))
        there = f"{'not found':>20}" if plain is None else f"{100 * far(plain[0], MARKED[name]):12.2f}{plain[1]:8.2f}"
        print(f"{name:22}{own[0]:10.2f}{own[1]:8.2f}{own[2]:10.2f}{there}", flush=True)


def chart_free(pictures: int, first: int) -> None:
    start, seen, by_opencv, by_cost = time.process_time(), 0, 0, 0
    by_polcap: list[tuple[str, float]] = []
    for name, picture in itertools.islice(foreign(first), pictures):
        radiance = stack(picture)
        seen += 1
        if seen % 20 == 0:
            print(seen, by_polcap, by_opencv, by_cost, flush=True)
        try:
            color = whitebalance.measure(radiance, CLASSIC, AUTO, WhitebalanceSettings())
            assert color.patches is not None
            by_polcap.append((name, float(np.nanmean(color.patches.delta_e))))
        except ChartError:
            pass
        found = opencv(radiance)
        by_opencv += found is not None
        by_cost += found is not None and found[2] <= _ACCEPTED_COST
    cost = (time.process_time() - start) / max(seen, 1)
    print(f"{seen} pictures without a Classic: polcap {len(by_polcap)} {by_polcap}, cv2.mcc {by_opencv}, ", end="")
    print(f"cv2.mcc with cost ≤ {_ACCEPTED_COST} {by_cost}; {cost:.1f} CPU s each")


def opencv(radiance: AngleStack) -> tuple[Floats, float, float] | None:
    """Corners (4, 2) of the outer patches, mean ΔE and cost of plain cv2.mcc on the picture as it is shown."""
    value = radiance.value[0]
    shown = encode_srgb(np.clip(value / np.percentile(value, 99, axis=(0, 1)), 0, 1))
    detector: Any = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray((255 * shown[..., ::-1]).astype(np.uint8)), 1):
        return None
    checker = detector.getBestColorChecker()
    quads = np.asarray(checker.getColorCharts(), np.float64).reshape(24, 4, 2)
    place = whitebalance.chart.from_centers(quads.mean(axis=1))
    stats = np.asarray(checker.getChartsRGB()).reshape(24, 3, 5)[:, :, 1] / 255  # its own samples, encoded
    fit = fit_matrix(decode_srgb(stats), CLASSIC.rec709, patches.position(), np.ones(24, bool))
    return place.corners(), float(np.nanmean(fit.delta_e)), float(checker.getCost())


def far(corners: Floats, marked: tuple[tuple[float, float], ...]) -> float:
    side = max(np.linalg.norm(np.subtract(marked[0], marked[1])), np.linalg.norm(np.subtract(marked[1], marked[2])))
    return float(np.linalg.norm(corners - np.array(marked), axis=-1).max() / side)


def foreign(first: int) -> Iterator[tuple[str, Floats]]:
    """Linear pictures (H, W, 3) without a ColorChecker Classic, without end; each by its number."""
    data = Path(DATA or ".")
    textures = [read(path) for path in sorted((data / "materials").glob("*/*/*albedo*.jpg"))]
    probes = sorted((data / "environments").glob("*.hdr"))
    skies = [picture(path, cv2.IMREAD_UNCHANGED) for path in probes]
    board = read(REAL / "charts" / "1.png")
    for number in itertools.count(first):
        random = np.random.default_rng([18, number])
        kind = number % 4
        if kind == 0:
            yield f"view {number}", view(skies[number // 4 % len(skies)], random)
        elif kind == 1:
            yield f"texture {number}", seen(textures[random.integers(len(textures))], random, 0.7)
        elif kind == 2:
            yield f"swatches {number}", seen(swatches(textures, random), random, 0.3)
        else:
            yield f"board {number}", seen(board, random, 0.3)


def read(path: Path) -> Floats:
    return np.asarray(decode_srgb(picture(path) / 255.0))


def picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> Floats:
    """(H, W, 3) as stored, red first."""
    found = cv2.imread(str(path), flags)
    assert found is not None, path
    return np.asarray(found)[..., ::-1]


def swatches(textures: list[Floats], random: np.random.Generator) -> Floats:
    """6 × 4 squares of materials on a dark card: all of a Classic but its colours."""
    card = np.full((4 * 60 + 12, 6 * 60 + 12, 3), 0.03)
    for row, column in itertools.product(range(4), range(6)):
        texture = textures[random.integers(len(textures))]
        y, x = random.integers(0, np.array(texture.shape[:2]) - 52)
        flat = texture[y : y + 52, x : x + 52]
        share = random.uniform(0, 1)  # from the texture to its mean
        card[row * 60 + 10 : row * 60 + 62, column * 60 + 10 : column * 60 + 62] = (
            share * flat + (1 - share) * flat.mean((0, 1))
        )[:52, :52]
    return card


def seen(flat: Floats, random: np.random.Generator, least: float) -> Floats:
    """A flat thing before a grey wall, in perspective, under a cast, with noise."""
    height, width = _SIDE
    size = random.uniform(least, 1.1) * min(height / flat.shape[0], width / flat.shape[1])
    turn = random.uniform(-np.pi, np.pi)
    c, s = size * np.cos(turn), size * np.sin(turn)
    corners = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5) * flat.shape[1::-1]
    there = corners @ np.array([[c, s], [-s, c]]) * random.uniform(0.85, 1.15, (4, 1)) + np.array([width, height]) / 2
    warp = cv2.getPerspectiveTransform(
        (corners + np.array(flat.shape[1::-1]) / 2).astype(np.float32), there.astype(np.float32)
    )
    picture = cv2.warpPerspective(
        flat.astype(np.float32), warp, (width, height), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT,
        borderValue=(0.25, 0.25, 0.25),
    )  # fmt: skip
    return noisy(picture * random.uniform(0.5, 1.0, 3), random)


def view(sky: Floats, random: np.random.Generator) -> Floats:
    """A pinhole's view, 60° wide, out of an equirectangular probe."""
    height, width = _SIDE
    y, x = np.mgrid[0:height, 0:width]
    ray = np.stack([(x - width / 2) / width * 1.15, (height / 2 - y) / width * 1.15, -np.ones_like(x, float)], axis=-1)
    yaw, pitch = random.uniform(-np.pi, np.pi), random.uniform(-0.7, 0.5)
    c, s = np.cos(pitch), np.sin(pitch)
    ray = ray @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    azimuth = np.arctan2(ray[..., 0], -ray[..., 2]) + yaw
    elevation = np.arctan2(ray[..., 1], np.hypot(ray[..., 0], ray[..., 2]))
    u = (azimuth / (2 * np.pi) % 1 * sky.shape[1]).astype(np.float32)
    v = ((0.5 - elevation / np.pi) * (sky.shape[0] - 1)).astype(np.float32)
    picture = cv2.remap(np.asarray(sky, np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return noisy(picture * (0.5 / np.percentile(picture, 90)), random)


def noisy(picture: Floats, random: np.random.Generator) -> Floats:
    picture = np.clip(picture, 0, 1)
    return np.asarray(picture + random.normal(size=picture.shape) * np.sqrt(picture / 20_000 + 1e-8))


if __name__ == "__main__":
    options = arguments(__doc__, pictures=216, first=0)
    if options.first == 0:
        photographs()
    chart_free(options.pictures, options.first)
