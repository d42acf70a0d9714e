"""Benchmark of the gates on path-traced objects: RAW captures of the scenes of `make_mitsuba.py` next to a chart.

    python tests/benchmarks/bench_verdicts_mitsuba.py SCENES FOLDER [--lamp X,Y,Z] [--turned 90,45,0]

Each object is put into the picture of a simulated studio with chart and backdrop, at its own focal length, and shot at
0°, 45° and 90° with three exposures. --lamp adds unpolarized light from that direction (camera frame), .8 of the
flash's. --turned gives the angles to which the polarizer is turned in the three shots. Prints for each capture the
verdict, the expected and the actual error of the normals (medians over the object, degrees), and the gates that warn or
fail; then how often each gate spoke.
"""

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_mitsuba import scene_light

from polcap.errors import InputError
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.quality import gates
from polcap.quality.gate_values import Gate
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Cluster
from polcap.synth.forward_camera import SENSOR_WIDTH_MM
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot, Studio, Take
from tests.experiments import arguments, judge, row

WIDTH, HEIGHT, TIMES = 1152, 864, 2  # visible RAW px; RAW px per pixel of a scene
DISTANCE = 0.7  # m
EDGE, PITCH = 10, 34  # px: least distance from the picture's edge; largest distance between the chart's patches
CHART_PITCHES = 6.2  # width of the chart
LAMP = 0.8  # light of the lamp over that of the flash, means over the object
ANGLES = (0.0, 45.0, 90.0)


def main() -> None:
    options = arguments(__doc__, "scenes", "folder", lamp=str, turned="0,45,90")
    lamp = _numbers(options.lamp) if options.lamp else None
    spoke: Counter[str] = Counter()
    for seed, file in enumerate(sorted(options.scenes.glob("*.npz"))):
        with np.load(file) as stored:
            scene = {name: stored[name] for name in stored.files}
        place = options.folder / file.stem
        corner = photograph(place, scene, seed, lamp, _numbers(options.turned))
        try:
            lines, error = judged(place, scene, corner)
        except InputError as refused:
            print(row(file.stem, "refused", "", "", refused), flush=True)
            continue
        finally:
            shutil.rmtree(place)
        said = [line for line in lines if line.state in ("warn", "fail")]
        spoke.update(f"{line.name} {line.state}" for line in said)
        spoke[gates.verdict(lines)] += 1
        expected = next(line.value for line in lines if line.name == "normal error")
        names = "; ".join(f"{line.name} {line.state} {line.value} ({line.cost_deg:.0f}°)" for line in said)
        print(row(file.stem, gates.verdict(lines), expected, error, names), flush=True)
    print(spoke.most_common())


def _numbers(text: str) -> Floats:
    return np.array([float(part) for part in text.split(",")])


def photograph(place: Path, scene: dict[str, Any], seed: int, lamp: Floats | None, turned: Floats) -> tuple[int, int]:
    """Write the capture; returns the RAW pixel x, y of the scene's first pixel."""
    focal = TIMES * float(scene["focal"])  # RAW px
    shoot = Shoot(
        seed=seed, width=WIDTH, height=HEIGHT, samples=1, focal_mm=focal * SENSOR_WIDTH_MM / WIDTH,
        bracket="time", gain_jitter=0.003,
    )  # fmt: skip
    rows, columns = np.nonzero(scene["mask"])
    first, last = (np.array([f(columns), f(rows)]) for f in (np.min, np.max))
    same_rays = np.round(np.array(shoot.view.center) - TIMES * scene["center"]).astype(int)
    corner = np.clip(same_rays, EDGE - TIMES * first, np.array([WIDTH, HEIGHT]) - EDGE - TIMES * (last + 1))
    studio = _studio(shoot, focal, scene["mask"], corner, seed)
    box = np.s_[first[1] : last[1] + 1, first[0] : last[0] + 1]
    x, y = corner + TIMES * first
    mask = _enlarged(scene["mask"][box], cv2.INTER_NEAREST) > 0
    share = np.maximum(_enlarged(scene["mask"][box], cv2.INTER_LINEAR), 1e-3)[..., None]
    light = scene_light(scene) + (0 if lamp is None else _lamp_light(scene, lamp))
    for plane, seen in zip(studio.reference, light * scene["mask"][..., None]):
        target = plane[y : y + mask.shape[0], x : x + mask.shape[1]]
        target[mask] = (_enlarged(seen[box], cv2.INTER_LINEAR) / share)[mask]
    random = np.random.default_rng(seed)
    for k, (angle, actual) in enumerate(zip(ANGLES, turned)):
        radiance = studio.through(actual + shoot.angle_error_deg * random.normal())
        for e in range(shoot.exposures):
            file = place / f"pol{angle:05.1f}" / f"{e}.DNG"
            file.parent.mkdir(parents=True, exist_ok=True)
            studio.photograph(file, radiance, Take(k, e, shoot.step ** (e - 1)))
    return int(corner[0]), int(corner[1])


def _studio(shoot: Shoot, focal: float, mask: Bools, corner: Floats, seed: int) -> Studio:
    """A studio with a chart next to the object's place, and there a ball of one pixel that the object will hide."""
    columns = np.nonzero(mask)[1]
    left, right = corner[0] + TIMES * columns.min(), corner[0] + TIMES * columns.max()
    room = max(left, WIDTH - right) - 4 * EDGE
    middle = right + 2 * EDGE + room / 2 if WIDTH - right > left else left - 2 * EDGE - room / 2
    px = focal / DISTANCE
    chart = Chart(
        center=((middle - shoot.view.center[0]) / px, 0.0, -DISTANCE), pitch=min(PITCH, room / CHART_PITCHES) / px
    )
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    off = (TIMES * np.array([x, y]) + corner - shoot.view.center) / px
    ball = Cluster(((0.0, 0.0, 0.0, 1.0 / px),))
    coat = random_scene(seed, "clusters").coat
    return Studio(Scene(ball, coat, position=(float(off[0]), float(-off[1]), -DISTANCE), chart=chart), shoot)


def _lamp_light(scene: dict[str, Any], lamp: Floats) -> Floats:
    """Stokes parameters (3, H, W, 3) of unpolarized diffuse light from the direction `lamp`."""
    shading = np.maximum(scene["normal"] @ (lamp / np.linalg.norm(lamp)), 0)[..., None] * scene["diffuse"]
    mask = scene["mask"]
    shading *= LAMP * scene["stokes"][0][mask].mean() / shading[mask].mean()
    return np.stack([shading, np.zeros_like(shading), np.zeros_like(shading)])


def _enlarged(image: Floats | Bools, how: int) -> Floats:
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(image.astype(np.float32), (TIMES * width, TIMES * height), interpolation=how))


def judged(place: Path, scene: dict[str, Any], corner: tuple[int, int]) -> tuple[list[Gate], float]:
    """All gates of the capture, and the median error of its normals in degrees."""
    found, lines = judge(place)
    maps = found.maps
    rows, columns = np.nonzero(maps.mask)
    x = np.round((columns + maps.view.origin[0]) - corner[0] / TIMES).astype(int)
    y = np.round((rows + maps.view.origin[1]) - corner[1] / TIMES).astype(int)
    height, width = scene["mask"].shape
    on = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    on[on] = scene["mask"][y[on], x[on]]
    return lines, float(np.median(frames.angle_deg(maps.normal[rows[on], columns[on]], scene["normal"][y[on], x[on]])))


if __name__ == "__main__":
    main()
