"""Benchmark of the albedo scale: its error on simulated captures with tilted charts and a flash next to the lens.

    python -m tests.benchmarks.bench_scale [--captures 36] [--first 0] [--falloff 0] [--perfect-chart]

Each is a random solid or a cluster of them at .72 m, its chart turned by up to 30° and standing left, right or
below, the flash up to 10 cm from the lens; the chart as the camera sees it, with photon noise and patches printed
to 1.5 % (1σ). --falloff P darkens the picture by the P-th power of the cosine to the optical axis, as a lens does.

Prints the error of the scale [%] by the chart that was found: as if it faced the flash (decision 8), with its pose
and a flash at the lens, and with the flash where the light's slope puts it; the last two again with the object's true
depth; and how many 1σ of the stated doubt the third is.
"""

from dataclasses import replace

import cv2
import msgspec
import numpy as np

from polcap.chart_values import ChartRequest
from polcap.errors import ChartError
from polcap.formats import shipped_data
from polcap.image_values import View
from polcap.optics import frames, point_light, projection
from polcap.optics.mesh_tracer import GBuffer
from polcap.stage_values import AngleStack, StokesImage, single_frames
from polcap.stages import whitebalance
from polcap.stages.cues import scale
from polcap.stages.whitebalance import WhitebalanceSettings
from polcap.synth import color_checker, render
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from tests.experiments import arguments, rms

_VIEW = View(960.0, (319.5, 239.5), 2.0)  # 640 × 480 superpixels of 37° across
_SAMPLES = 4  # rays per pixel side
_COARSE = 4  # the object is looked at by every so many pixels
_CAMERA = np.array([[0.28, 0.10, 0.07], [0.08, 0.71, 0.22], [0.02, 0.18, 0.66]])  # linear Rec.709 → channels


def main() -> None:
    options = arguments(__doc__, "--perfect-chart", captures=36, first=0, falloff=0.0)
    rows = []
    for number in range(options.first, options.first + options.captures):
        try:
            rows.append(measure(number, options.falloff, 0.0 if options.perfect_chart else 0.015))
        except ChartError as error:
            print(number, error)
            continue
        print(number, " ".join(f"{value:7.2f}" for value in rows[-1]), flush=True)
    found = np.array(rows)
    rules = "faces the flash", "flash at the lens", "flash by the slope", "2nd, true depth", "3rd, true depth"
    for name, off in zip(rules, found.T):
        median, most = np.percentile(np.abs(off), (50, 90))
        print(f"{name:20} median {median:5.2f} %, 90th percentile {most:5.2f} %, mean {off.mean():+5.2f} %")
    print(f"errors in 1σ of the doubt: rms {rms(found[:, 5]):.2f}")
    normal, flash, away = (float(column.mean()) for column in found.T[6:])
    print(f"normal off by {normal:.2f}°, flash by {flash:.3f} distances, at {away:.3f} from the lens")


def measure(number: int, falloff: float, printed: float) -> tuple[float, ...]:
    """Errors of the scale [%], five rules; of the third in σ; of normal [deg] and flash; its place [distances]."""
    random = np.random.default_rng([8, number])
    scene = placed(random_scene(number, ("bumps", "clusters", "vase")[number % 3]), random)
    assert scene.chart is not None
    coarse = View(_VIEW.focal / _COARSE, (319.5 / _COARSE - 0.375, 239.5 / _COARSE - 0.375), 2.0 * _COARSE)
    object_ = render.gbuffer(scene, coarse, 480 // _COARSE, 640 // _COARSE)
    taken = photograph(scene, falloff, printed, random)
    color = whitebalance.measure(taken, shipped_data.colorchecker(), ChartRequest("auto"), WhitebalanceSettings())
    assert color.light is not None
    nothing = np.zeros((3, 1, 1, 3)), np.zeros((6, 1, 1, 3)), np.zeros((1, 1), np.uint8)
    stokes = StokesImage(*nothing, object_.mask, coarse, None)
    true = truth(scene, object_, falloff)
    radius = np.sqrt(object_.mask.sum() / np.pi) / coarse.focal
    bulge = (object_.depth[object_.mask].mean() / -scene.chart.center[2] / (1 - radius / 2)) ** 2
    at_lens = replace(color, light=replace(color.light, flash=np.zeros(3)))
    factors = [scale.factor(stokes, way) for way in (replace(color, light=None), at_lens, color)]
    errors = [100 * (factor / true - 1) for factor in (*factors, bulge * factors[1], bulge * factors[2])]
    doubt = scale.sigma(stokes, color)
    assert doubt is not None
    tilt = float(frames.angle_deg(color.light.normal, scene.chart.axes[0]))
    flash = np.array(scene.light[:2]) / -scene.chart.center[2]
    away = np.linalg.norm([color.light.flash[:2] - flash, flash], axis=1)
    return (*errors, errors[2] / 100 / doubt, tilt, *(float(a) for a in away))


def placed(scene: Scene, random: np.random.Generator) -> Scene:
    """The scene with its chart and flash where this benchmark has them."""
    assert scene.chart is not None
    x, y = ((0.095, 0.0), (-0.095, 0.0), (0.0, -0.085))[random.integers(3)]
    way, tilt = random.uniform(0, 2 * np.pi), random.uniform(0, 30)
    chart = msgspec.structs.replace(
        scene.chart,
        center=(x, y, -0.72 + random.uniform(-0.01, 0.01)),
        turn_deg=(tilt * np.cos(way), tilt * np.sin(way), 0.0),
    )
    angle, away = random.uniform(0, 2 * np.pi), random.uniform(0, 0.1)
    light = (float(away * np.cos(angle)), float(away * np.sin(angle)), 0.0)
    return msgspec.structs.replace(scene, position=(-0.8 * x, -0.8 * y, -0.72), chart=chart, light=light)


def photograph(scene: Scene, falloff: float, printed: float, random: np.random.Generator) -> AngleStack:
    """One shot of the chart before a dark wall, on superpixels, in the camera's channels."""
    assert scene.chart is not None
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    y, x = (axis.reshape(-1, 1) for axis in np.mgrid[:480, :640])
    v = frames.rays_at(
        _VIEW, *(axis.reshape(-1) for axis in (x + np.tile(steps, _SAMPLES), y + np.repeat(steps, _SAMPLES)))
    )
    at, distance, albedo = color_checker.intersect(scene.chart, v)
    point = -v[at] * distance[:, None]
    light = np.full((len(v), 3), 0.01)
    arriving = point_light.irradiance(point, np.array(scene.light[:2]), falloff, scene.chart.axes[0])
    light[at] = albedo * arriving[:, None]
    picture = cv2.GaussianBlur(light.reshape(480, 640, -1, 3).mean(axis=2), (0, 0), 0.5)
    row, column = np.mgrid[:480, :640]
    for quad in projection.project(_VIEW, color_checker.patches(scene.chart)):
        low, high = quad.min(0), quad.max(0)
        picture[(column > low[0]) & (column < high[0]) & (row > low[1]) & (row < high[1])] *= (
            1 + printed * random.normal()
        )
    value = picture @ _CAMERA.T * (0.3 / picture.max())
    value = value + random.normal(size=value.shape) * np.sqrt(value / 30_000 + 1e-8)
    variance, quality = np.full((1, *value.shape), 1e-8, np.float32), np.zeros((1, 480, 640), np.uint8)
    return AngleStack(value[None].astype(np.float32), variance, quality, np.zeros(1), _VIEW, single_frames(1))


def truth(scene: Scene, object_: GBuffer, falloff: float) -> float:
    """The factor that makes of the object's mean light what a flash at the lens throws on it, 1 on the axis there."""
    assert scene.chart is not None
    flash = np.array(scene.light[:2])
    white = color_checker.patches(scene.chart)[18].mean(axis=0)
    chart = point_light.irradiance(white, flash, falloff, scene.chart.axes[0])
    y, x = np.mgrid[: object_.mask.shape[0], : object_.mask.shape[1]].astype(np.float64)
    v = frames.rays_at(object_.view, x, y)[object_.mask]
    z = object_.depth[object_.mask]
    point = -v * (z / v[:, 2])[:, None]
    reached = point_light.irradiance(point, flash, falloff).mean()
    alone = point_light.irradiance(point, np.zeros(2), 0.0).mean()
    return float(chart * alone / reached * z.mean() ** 2)


if __name__ == "__main__":
    main()
