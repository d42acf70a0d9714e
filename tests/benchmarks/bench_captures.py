"""Benchmark of the whole path: errors of all maps of rendered captures against their true maps.

    python tests/benchmarks/bench_captures.py $POLCAP_DATA/rendered [--estimator analytic] [--model ONNX] [--rough]

Prints a Markdown row per capture. Truth comes with the captures, from another renderer, whose bodies have a smooth
interface; with --rough, S1 and S2 are scaled to what the facets of each pixel's true roughness leave of them.
"""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from polcap.capture_values import Capture
from polcap.config import Config
from polcap.formats import onnx
from polcap.formats.capture import reader as captures
from polcap.image_values import Floats
from polcap.optics import body, frames
from polcap.optics.resize import block_means
from polcap.pipeline.path import distance_m
from polcap.results import Results
from polcap.stage_values import Network
from polcap.stages import cues, infer, surface
from tests.experiments import Networks, arguments, head, networks, process, rms, row

COLUMNS = (
    "capture", "normal mean", "median", "chart px", "align px", "gain %", "ratio %",
    "diffuse", "roughness", "F0", "depth", "diffuse at RAW px", "with detail",
    "its fine part", "with detail", "truth's",
)  # fmt: skip


def main() -> None:
    options = arguments(__doc__, "folder", "--rough", estimator=(None, "network", "analytic"), model=Path)
    using = networks(options.estimator, options.model)
    print(head(*COLUMNS))
    rows = []
    for truth in sorted(options.folder.glob("*.truth.json")):
        rows.append(measure(truth, using, options.rough))
        print(row(truth.name.split(".")[0], *rows[-1]), flush=True)
    print(row("mean", *np.mean(rows, axis=0)))


def measure(truth_file: Path, using: Networks, rough: bool) -> list[float]:
    """One capture's figures, in the order of COLUMNS."""
    stem = str(truth_file)[: -len(".truth.json")]
    applied = json.loads(truth_file.read_text())
    meta = json.loads(Path(stem + ".meta.json").read_text())
    capture = captures.read(Path(stem), None)
    found = process(capture, Results, using)
    with np.load(stem + ".truth.npz") as maps:
        errors = surface_errors(found, dict(maps), using[0], rough)
        detail = detail_errors(found, dict(maps))
    return [*errors[:2], *capture_errors(found, capture, applied, meta), *errors[2:], *detail]


def detail_errors(found: Results, truth: dict[str, Floats]) -> list[float]:
    """RMSE of the diffuse albedo at RAW pixels, enlarged and with its detail, and those of its fine part.

    The last figure is the rms of the true fine part: gray albedo less its Gaussian mean of 0.75 px.
    """
    maps = found.maps
    assert maps.detail is not None
    (height, width), (x0, y0) = maps.detail.shape, (round(2 * edge) for edge in maps.view.origin)
    crop = np.s_[y0 : y0 + height, x0 : x0 + width]
    albedo = truth["albedo"][crop].astype(np.float32)
    enlarged, covered = (cv2.resize(part, (width, height)) for part in (maps.diffuse, maps.mask.astype(np.float32)))
    inside = (truth["mask"][crop] > 0) & (covered > 0.99)
    detailed = np.clip(enlarged * np.exp(maps.detail, dtype=np.float32)[..., None], 0, 1)

    def fine(image: Floats) -> Floats:
        gray = image.mean(axis=-1)
        return np.asarray(gray - cv2.GaussianBlur(gray, (0, 0), 0.75))

    pairs = [(part(image), part(albedo)) for part in (np.asarray, fine) for image in (enlarged, detailed)]
    return [*(rms((one - true)[inside]) for one, true in pairs), rms(fine(albedo)[inside])]


def capture_errors(found: Results, capture: Capture, applied: dict, meta: dict) -> list[float]:  # type: ignore[type-arg]
    """Chart centres and alignment [RAW px, worst], gains and bracket ratios [%, worst]."""
    centers = (np.array(meta["chart"]["patch_corners_px"]) - 1).mean(1) / 2  # their pixel centres lie at .5
    assert found.color.place is not None
    chart = 2 * np.linalg.norm(found.color.place.quads.mean(1) - centers, axis=1).max()

    files = {shot["file"].split("/", 1)[1]: shot for shot in applied["shots"]}
    frames = [
        [files[str(Path(frame.path).relative_to(capture.folder))] for frame in shot.frames] for shot in capture.shots
    ]
    exposure = np.array([[f["relative_exposure"] * f["flash_factor"] for f in shot] for shot in frames])
    ratio = found.radiance.bracket.exposure_ratio.mean(-1)
    reference = int(np.abs(ratio[0] - 1).argmin())
    flash = np.array([shot[reference]["flash_factor"] for shot in frames])
    gain = found.selfcal.gains.gain.mean(1) / (flash / flash[0]) - 1
    ratios = ratio / (exposure / exposure[:, [reference]]) - 1

    rows, columns = np.nonzero(found.object_.mask)
    at = np.stack([columns, rows, np.ones(len(rows))])
    grid = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])  # binned px → RAW px
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # RAW px with centres on whole numbers → at .5
    worst = 0.0
    for shot, transform in zip(frames, found.alignment.transform):
        true = np.vstack([shot[0]["affine_ref_to_shot"], [0, 0, 1]])
        expected = np.linalg.inv(grid) @ np.linalg.inv(half) @ true @ half @ grid @ at
        seen = transform @ at
        worst = max(worst, 2 * np.hypot(*(seen[:2] / seen[2] - expected[:2])).max())
    return [float(chart), worst, float(100 * np.abs(gain).max()), float(100 * np.abs(ratios).max())]


def surface_errors(found: Results, truth: dict[str, Floats], network: Network | None, rough: bool) -> list[float]:
    """Normal mean and median [degrees], RMSE of diffuse, roughness and F0, of depth [share of its range]."""
    x0, y0, x1, y1 = found.object_.crop
    crop = np.s_[y0:y1, x0:x1]

    def binned(image: Floats) -> Floats:
        return np.asarray(block_means(image.astype(np.float32), 2)[crop])

    normal = binned(truth["normal"])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    maps, depth = found.maps, found.mesh.depth
    if rough:
        share = facet_share(normal, binned(truth["alpha"]), binned(truth["ior"]), found.cues.rays)
        parts = found.stokes.stokes.copy()
        parts[1:] *= np.where(binned(truth["mask"]) > 0, share, 1)[..., None]
        seen = cues.compute(replace(found.stokes, stokes=parts), found.color)
        maps = infer.estimate(seen, network, onnx.run, Config().infer)
        depth = surface.integrate(maps, distance_m(found.color, found.radiance), Config().surface).depth
    inside = (binned(truth["mask"]) == 1) & maps.mask
    angle = frames.angle_deg(normal, maps.normal)[inside]
    ior = np.maximum(binned(truth["ior"]), 1)
    f0 = ((ior - 1) / (ior + 1)) ** 2

    z = binned(truth["depth"])
    inside &= np.isfinite(z) & np.isfinite(depth)
    true, ours = z[inside] - z[inside].mean(), depth[inside] * np.mean(z[inside]) / np.mean(depth[inside])
    materials = (
        (maps.diffuse, binned(truth["albedo"])),
        (maps.roughness, np.sqrt(binned(truth["alpha"]))),
        (maps.specular[..., 1], f0),
    )
    errors = [rms((estimate - right)[inside]) for estimate, right in materials]
    return [float(angle.mean()), float(np.median(angle)), *errors, rms(ours - ours.mean() - true) / float(np.ptp(true))]


def facet_share(normal: Floats, alpha: Floats, ior: Floats, rays: Floats) -> Floats:
    """DoLP of diffuse light through facets over that through a smooth interface (H, W)."""
    cosine = np.clip(frames.to_ray_frame(normal, rays)[..., 2], 0.05, 1 - 1e-6)
    index = np.clip(ior, 1.3, 1.7)
    return np.asarray(body.dolp(cosine, alpha, index) / body.dolp(cosine, 0.0, index), np.float32)


if __name__ == "__main__":
    main()
