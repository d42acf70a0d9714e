"""The golden outputs: each stage run on stored inputs, compared with its stored output.

    python -m tests.golden        renew tests/goldens/ after a stage's `version` was raised

No stage runs on the output of another, so a rounding difference is never passed on. The first stages run on the
photographs of tests/capture (integers); the later ones on a sixteenth of their pixels, in tests/goldens/inputs.npz.
To make new inputs, delete that file and run the command.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap import Config, chart_values, image_values, mesh_values, read_capture, stage_values
from polcap.formats import onnx, shipped_data
from polcap.formats.raw import frame_decoder
from polcap.image_values import View
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stages import Stage, align, asset, cues, hdr, infer, mask, selfcal, stokes, surface, whitebalance
from tests import scenes

Arrays = dict[str, NDArray[Any]]
FOLDER = Path(__file__).with_name("goldens")
INPUTS = FOLDER / "inputs.npz"
CAPTURE = Path(__file__).parent / "capture"
SAMPLES = 3000  # pixels or vertices stored of one array, evenly spread
REMEDY = "If the change is intended, raise the stage's `version`, then run `python -m tests.golden`."


# How far an output may differ on another processor. Every limit is below a change of 0.5 % in a patch of 32×32 px,
# except where it is marked `sensitive`.


@dataclass(frozen=True)
class Limit:
    """Largest difference of one value, and the share of the values that may exceed it."""

    unit: str  # "relative", "absolute", "degrees", "px"
    most: float
    share: float = 0.0
    sensitive: bool = False  # the limit is wider than 0.5 %


FLOAT32 = Limit("relative", 1e-3, 5e-4)  # stored to 2e-4; single pixels change sides of a threshold
NUMBERS = Limit("relative", 1e-3)  # sums over many pixels: rounding averages out
BITS = Limit("absolute", 0.0, 1e-3)  # pixels on a threshold: 4 of 250,000 were seen to flip
CHOICES = Limit("absolute", 0.0)  # counts, orders, names

INFER = {
    "mask": BITS,
    "normal": Limit("degrees", 0.1, 1e-3),  # pixels choose between hypotheses of almost equal cost
    "diffuse": Limit("absolute", 3e-4, 1e-3),  # albedo
    "confidence": Limit("relative", 2e-3, 1e-3),
    "*": FLOAT32,
}

LIMITS: dict[str, dict[str, Limit]] = {  # stage → array → limit; the first pattern that fits
    "hdr": {
        "quality": BITS,
        "value": FLOAT32,
        "variance": FLOAT32,
    },
    "whitebalance": {
        "place.*": Limit("absolute", 0.02),  # px; corners are found on 8-bit pictures
    },
    "align": {
        "transform": Limit("px", 0.01),  # 1e-3 px was seen; the registration's own error is 0.02 px
    },
    "mask": {
        "mask": BITS,
        "crop": Limit("absolute", 1.0),  # follows the outermost pixel of the mask
    },
    "selfcal": {  # degrees: under a tenth of their 1σ
        "*angle": Limit("degrees", 0.02),
        "ring.*": Limit("degrees", 0.02),
    },
    "stokes": {"quality": BITS, "mask": BITS, "*": FLOAT32},
    "cues": {"quality": BITS, "mask": BITS, "*": FLOAT32},
    "infer": INFER,
    "infer by network": INFER,
    "surface": {
        "normals": Limit("degrees", 0.1, 1e-3),
        "faces": Limit("absolute", 0.0, 1e-3),
        "*": FLOAT32,
    },
    "asset": {"*_factor": NUMBERS, "ior": NUMBERS, "*": BITS},  # 8-bit: few values round differently
}


def limit(stage: str, name: str, array: NDArray[Any]) -> Limit:
    """The limit of one array: by name, else by its kind."""
    for pattern, found in LIMITS[stage].items():
        if fnmatch(name, pattern):
            return found
    return NUMBERS if array.dtype.kind == "f" else CHOICES


# Compare.


def differences(stage: str, expected: Arrays, found: Arrays) -> list[str]:
    """One line for each array that is missing, new or beyond its limit."""
    return other_names(stage, expected, found) + other_values(stage, expected, found)


def other_names(stage: str, expected: Arrays, found: Arrays) -> list[str]:
    """One line for each array that is missing or new."""
    lines = [f"{stage}: {name} is no longer an output." for name in expected if name not in found]
    return lines + [f"{stage}: {name} is a new output." for name in found if name not in expected]


def other_values(stage: str, expected: Arrays, found: Arrays) -> list[str]:
    """One line for each array beyond its limit."""
    lines = []
    for name in expected.keys() & found.keys():
        before, now = expected[name], found[name]
        if before.shape != now.shape:
            lines.append(f"{stage}: {name} has shape {now.shape}, expected {before.shape}.")
            continue
        allowed = limit(stage, name, before)
        change = np.asarray(difference(before, now, allowed.unit))
        share = float(np.mean(change > allowed.most)) if change.size else 0.0
        if share > allowed.share:
            lines.append(
                f"{stage}: {name} differs by more than {allowed.most:g} ({allowed.unit}) in {share:.2%} of its values "
                f"(limit {allowed.share:.2%}); the largest difference is {np.max(change):.3g}."
            )
    return sorted(lines)


def difference(before: NDArray[Any], now: NDArray[Any], unit: str) -> Any:
    """Change of each value in a unit of `Limit`; infinite where only one of the two is a number."""
    if before.dtype.kind == "U":
        return np.where(before == now, 0, np.inf)
    before, now = before.astype(np.float64), now.astype(np.float64)
    if unit == "px":  # movement of the corners of the picture by transforms (K, 3, 3)
        corners = np.array([[0, 575, 0, 575], [0, 0, 431, 431], [1, 1, 1, 1]])
        places = [(moved := transform @ corners)[:, :2] / moved[:, 2:] for transform in (before, now)]
        return np.linalg.norm(places[1] - places[0], axis=1)
    one_is_nan = np.isnan(before) != np.isnan(now)
    before, now = np.nan_to_num(before), np.nan_to_num(now)
    change = np.abs(now - before)
    if unit == "relative":
        rms = np.sqrt(np.mean(before**2)) if before.size else 0.0  # a value near 0 has no relative error of its own
        change = change / np.maximum(np.maximum(np.abs(before), 0.1 * rms), 1e-30)
    elif unit == "degrees":
        vectors = before.ndim > 1 and before.shape[-1] == 3
        change = np.degrees(np.linalg.norm(change, axis=-1, keepdims=True) if vectors else change)
    return np.where(one_is_nan, np.inf, change)


# Run the stages on stored inputs.


@dataclass(frozen=True)
class Golden:
    """A stage, and a function that runs it on its stored inputs."""

    stage: Stage[..., Any]
    run: Callable[[], Any]


def radiance() -> stage_values.AngleStack:
    """The longest exposure of each angle of the small capture; sums and quotients of integers, no stage."""
    capture = read_capture(CAPTURE)
    photographs = [frame_decoder.decode(shot.frames[-1]) for shot in capture.shots]
    values, clipped = [], []
    for photograph in photographs:
        count = np.asarray(photograph.value).astype(np.float32)
        red, green, green2, blue = (count[y::2, x::2] for y in (0, 1) for x in (0, 1))  # RGGB
        values.append((np.stack([red, (green + green2) / 2, blue], axis=-1) - 256) / np.float32(4095 - 256))
        clipped.append(np.maximum.reduce([red, green, green2, blue]) > 4000)
    value, first = np.stack(values), photographs[0]
    return stage_values.AngleStack(
        value=value,
        variance=np.float32(3e-5) * (np.maximum(value, 0) + np.float32(0.02)),
        quality=np.stack(clipped).astype(np.uint8) * np.uint8(image_values.Quality.CLIPPED),
        angle=capture.angle,
        view=VIEW,
        bracket=stage_values.single_frames(len(value)),
        sensor=stage_values.ColorSensor(first.camera_matrix, first.white_balance, first.site_px),
        equipment=stage_values.Equipment("flash"),
        mosaic=image_values.Mosaic(((first.value - np.float32(256)) / (4095 - 256)).astype(np.float16), RGGB),
    )


RGGB = np.array([[0, 1], [1, 2]], np.uint8)
VIEW = View(focal=1344.0, center=(287.5, 215.5), scale=2.0)  # of the small capture


def goldens(inputs: Arrays, threads: int = 1) -> dict[str, Golden]:
    """Every golden by name: the stages, and the stage `infer` once more with the shipped network."""
    config = Config()
    shots = cache(radiance)
    color = replace(
        scenes.no_color(),
        matrix=inputs["matrix"],
        place=chart_values.ChartPlace(inputs["quads"], inputs["corners"]),
        source="chart",
        light=chart_values.ChartLight(
            inputs["light.white"], inputs["light.normal"], inputs["light.flash"], inputs["light.covariance"]
        ),
    )
    registered = replace(scenes.still(), transform=inputs["transform"])
    x0, y0, x1, y1 = (int(edge) for edge in inputs["crop"])
    object_ = stage_values.ObjectMask(inputs["mask"], (x0, y0, x1, y1), "automatic")
    equal = scenes.equal(gain=inputs["gain"])
    calibration = replace(equal, gains=replace(equal.gains, sigma=inputs["sigma"]))

    chart = shipped_data.colorchecker(config.whitebalance.chart)
    network = cache(lambda: models.load_network("network", None, "cpu", threads))
    mask_network = cache(lambda: models.load_mask_network(threads))
    cue, maps, run = stored_cues(inputs), stored_maps(inputs), onnx.run
    return {
        "hdr": Golden(hdr.merge, lambda: hdr.merge(read_capture(CAPTURE), frame_decoder.decode, config.hdr)),
        "whitebalance": Golden(
            whitebalance.measure,
            lambda: whitebalance.measure(shots(), chart, chart_values.ChartRequest("auto"), config.whitebalance),
        ),
        "align": Golden(align.register, lambda: align.register(shots(), config.align)),
        "mask": Golden(
            mask.segment, lambda: mask.segment(shots(), registered, color, None, mask_network(), run, config.mask)
        ),
        "selfcal": Golden(selfcal.solve, lambda: selfcal.solve(shots(), registered, object_, color, config.selfcal)),
        "stokes": Golden(stokes.solve, lambda: stokes.solve(shots(), registered, calibration, object_, config.stokes)),
        "cues": Golden(cues.compute, lambda: cues.compute(plain_stokes(shots(), object_), color)),
        "infer": Golden(infer.estimate, lambda: infer.estimate(cue, None, run, config.infer)),
        "infer by network": Golden(infer.estimate, lambda: infer.estimate(cue, network(), run, config.infer)),
        "surface": Golden(surface.integrate, lambda: surface.integrate(maps, 0.7, config.surface)),
        "asset": Golden(asset.build, lambda: asset.build(maps, stored_mesh(inputs), config.asset)),
    }


def plain_stokes(shots: stage_values.AngleStack, object_: stage_values.ObjectMask) -> stage_values.StokesImage:
    """Stokes parameters of the shots at 0°, 45° and 90° as they are, unregistered; with the variance of each."""
    x0, y0, x1, y1 = object_.crop
    (i0, i45, i90), (v0, v45, v90) = shots.value[:, y0:y1, x0:x1], shots.variance[:, y0:y1, x0:x1]
    sum_ = v0 + v90
    return stage_values.StokesImage(
        stokes=np.stack([i0 + i90, i0 - i90, 2 * i45 - i0 - i90]),
        covariance=np.stack([sum_, v0 - v90, -sum_, sum_, v90 - v0, 4 * v45 + sum_]),
        quality=np.bitwise_or.reduce(shots.quality[:, y0:y1, x0:x1]),
        mask=object_.mask[y0:y1, x0:x1],
        view=crop_view((x0, y0)),
        residual=None,
    )


def crop_view(corner: tuple[int, int], step: int = 1) -> View:
    """The camera over every `step`-th pixel from a corner (x, y)."""
    x, y = corner
    center = ((VIEW.center[0] - x) / step, (VIEW.center[1] - y) / step)
    return View(VIEW.focal / step, center, VIEW.scale * step, (x / step, y / step))


STEP = 4  # stored cues and maps hold every fourth pixel
MESH_STEP = 8  # the stored mesh is made of every eighth


def stored_cues(inputs: Arrays) -> stage_values.Cues:
    """The cues that `infer` runs on."""
    ratio, sigma, color = inputs["cues.ratio"], inputs["cues.ratio_sigma"], inputs["cues.radiance"]
    square = ratio[0] ** 2 + ratio[1] ** 2
    length = np.sqrt((color**2).sum(axis=-1, keepdims=True))
    view = crop_view((int(inputs["crop"][0]), int(inputs["crop"][1])), STEP)
    return stage_values.Cues(
        radiance=color,
        ratio=ratio,
        ratio_sigma=sigma,
        dolp=np.sqrt(np.maximum(square - sigma**2, 0)),
        normalized_stokes=ratio / np.maximum(np.sqrt(square), np.float32(1e-6)),
        diffuse_color=np.where(length > 0.01, color / np.maximum(length, np.float32(0.01)), np.float32(0)),
        rays=frames.rays(view, *sigma.shape).astype(np.float32),
        mask=inputs["cues.mask"],
        quality=np.zeros(sigma.shape, np.uint8),
        view=view,
        detail=stored_detail(sigma.shape),
    )


def stored_detail(shape: tuple[int, ...]) -> NDArray[np.float16]:
    """Detail of RAW pixels, strong enough in every second stripe to differ from shading."""
    y, x = np.mgrid[: 2 * shape[0], : 2 * shape[1]]
    return np.asarray(np.sin(2.1 * x + 0.7 * y) * (0.05 + 0.4 * (x // 40 % 2)), np.float16)


def stored_maps(inputs: Arrays) -> stage_values.SurfaceMaps:
    """The maps that `surface` and `asset` run on."""
    x, y = inputs["maps.normal"]
    return stage_values.SurfaceMaps(
        normal=np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, np.float32(1e-4)))], axis=-1),
        diffuse=inputs["maps.diffuse"],
        specular=np.repeat(inputs["maps.specular"][..., None], 3, axis=-1),
        roughness=inputs["maps.roughness"],
        depth_prior=None,
        confidence=inputs["maps.confidence"],
        mask=inputs["cues.mask"],
        view=stored_cues(inputs).view,
        estimator="stored",
        detail=stored_detail(inputs["cues.mask"].shape),
    )


def stored_mesh(inputs: Arrays) -> mesh_values.ReliefMesh:
    """The mesh that `asset` runs on."""
    part: Any = {name.removeprefix("mesh."): array for name, array in inputs.items() if name.startswith("mesh.")}
    depth = np.full(inputs["cues.mask"].shape, 0.7, np.float32)
    return mesh_values.ReliefMesh(**part, depth=depth, metric=True, pieces=1, cuts=0.0, cut_px=0.0, raggedness=0.0)


# Store.


def outputs(value: Any, name: str = "") -> Arrays:
    """Every array, number and text of a stage's output by dotted name; without the mesh that an asset repeats."""
    if value is None or (name and isinstance(value, mesh_values.Mesh)):
        return {}
    if is_dataclass(value):
        parts: Iterator[tuple[str, Any]] = ((field.name, getattr(value, field.name)) for field in fields(value))
    else:
        return {name: np.asarray(value)}
    return {key: array for part, item in parts for key, array in outputs(item, f"{name}.{part}".strip(".")).items()}


def samples(arrays: Arrays) -> Arrays:
    """A stage's outputs as they are stored: of a large array at most `SAMPLES` pixels; masks whole."""
    return {name: sample(array) for name, array in arrays.items()}


def sample(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype == bool or array.size <= 200:
        return array
    rows = array.reshape(-1, array.shape[-1] if array.shape[-1] <= 4 else 1)
    count = min(SAMPLES, len(rows))
    return short(rows[np.arange(count) * len(rows) // count])


def short(array: NDArray[Any]) -> NDArray[Any]:
    """Numbers rounded to 12 bits (2e-4 of each), which compress to half."""
    if array.dtype.kind != "f":
        return array
    digits, exponent = np.frexp(array)
    return np.ldexp(np.round(digits * 4096) / 4096, exponent).astype(np.float32)


def read(file: Path) -> Arrays:
    """The arrays of one file."""
    with np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def file_of(name: str) -> Path:
    """Where a golden is stored."""
    return FOLDER / f"{name.replace(' ', '_')}.npz"


def make_inputs() -> Arrays:
    """Inputs of the later stages, by the stages before them."""
    config, shots = Config(), radiance()
    chart = shipped_data.colorchecker(config.whitebalance.chart)
    color = whitebalance.measure(shots, chart, chart_values.ChartRequest("auto"), config.whitebalance)
    registered = align.register(shots, config.align)
    object_ = mask.segment(shots, registered, color, None, models.load_mask_network(1), onnx.run, config.mask)
    calibration = selfcal.solve(shots, registered, object_, color, config.selfcal)
    assert color.place is not None and color.light is not None
    seen = cues.compute(stokes.solve(shots, registered, calibration, object_, config.stokes), color)
    inside = seen.mask[::STEP, ::STEP]
    found = {f"light.{name}": array for name, array in vars(color.light).items()} | {
        "matrix": color.matrix, "quads": color.place.quads, "corners": color.place.corners,
        "transform": registered.transform, "mask": object_.mask, "crop": np.array(object_.crop),
        "gain": calibration.gains.gain, "sigma": calibration.gains.sigma,
        "cues.mask": inside,
        "cues.radiance": short(seen.radiance[::STEP, ::STEP] * inside[..., None]),
        "cues.ratio": short(seen.ratio[:, ::STEP, ::STEP] * inside),
        "cues.ratio_sigma": short(seen.ratio_sigma[::STEP, ::STEP]),
    }  # fmt: skip
    maps = infer.estimate(stored_cues(found), models.load_network("network", None, "cpu", 1), onnx.run, config.infer)
    found |= {
        "maps.normal": short(np.moveaxis(maps.normal[..., :2] * inside[..., None], -1, 0)),
        "maps.diffuse": short(maps.diffuse * inside[..., None]),
        "maps.specular": short(maps.specular[..., 0] * inside),
        "maps.roughness": short(maps.roughness * inside),
        "maps.confidence": short(maps.confidence * inside),
    }
    few = MESH_STEP // STEP
    small = replace(
        stored_maps(found),
        **{name: getattr(stored_maps(found), name)[::few, ::few] for name in ("normal", "confidence", "mask")},
        view=crop_view((int(found["crop"][0]), int(found["crop"][1])), MESH_STEP),
    )
    mesh = surface.integrate(small, 0.7, config.surface)
    return found | {f"mesh.{name}": getattr(mesh, name) for name in ("vertices", "normals", "uv", "tangents", "faces")}


def main() -> None:
    """Renew the goldens; refuse where an output changed and its stage's version did not."""
    FOLDER.mkdir(exist_ok=True)
    new_inputs = not INPUTS.exists()
    if new_inputs:
        np.savez_compressed(INPUTS, **make_inputs())  # type: ignore[arg-type]
        print("new inputs.npz")
    refused = []
    for name, golden in goldens(read(INPUTS)).items():
        found, file = samples(outputs(golden.run())), file_of(name)
        if file.exists() and not new_inputs:
            expected = read(file)
            if int(expected.pop("version")) == golden.stage.version:
                values = other_values(name, expected, found)
                refused += values
                if values or not other_names(name, expected, found):
                    continue
        np.savez_compressed(file, version=np.array(golden.stage.version), **found)  # type: ignore[arg-type]
        print(f"new {file.name}")
    if refused:
        sys.exit("\n".join([*refused, "Not renewed: raise the stage's `version` first."]))


if __name__ == "__main__":
    main()
