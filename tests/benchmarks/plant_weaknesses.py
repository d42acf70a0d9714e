"""Simulates a capture with one kind of weakness from a seed, to test the gates.

Captures have three angles, 640 × 480 RAW px, the chart next to the object, and both laws of polarization. The kind
"none" is the same capture without the weakness.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from polcap.image_values import Floats
from polcap.synth import scene_materials
from polcap.synth import shooting as synthetic
from polcap.synth.distance_fields import Cluster
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot, ShotPose, Studio, Take

Random = np.random.Generator
Light = Callable[[Floats, int, int], Floats]  # light of frame e of shot k behind the polarizer, after the fault

# kind: the gates that name it
KINDS: dict[str, tuple[str, ...]] = {
    "none": (),
    "chart behind": ("albedo scale",),
    "chart lit from the side": ("albedo scale", "chart"),
    "vignetting 50 %": ("albedo scale", "chart"),
    "no chart": ("albedo scale",),
    "turned 0.3° a shot": ("alignment",),
    "turned 1° a shot": ("alignment",),
    "pushed 1 px": ("alignment",),
    "two softboxes": ("body", "other light", "lighting"),
    "two flashes": ("body", "other light", "lighting"),
    "one shot 25 % dimmer": ("gains",),
    "one shot lit unevenly by 2 %": ("lighting",),
    "all out of focus by 3 px": ("focus",),
    "overexposed 12 times": ("clipping",),
    "black level wrong by 2": ("stillness",),
    "vignetting of wide apertures": ("stillness",),
    "ambient frame": ("ambient",),
    "polarized ambient frames": ("ambient",),
    "at the border": ("mask", "other light"),
    "one frame blurred": ("sharpness",),
    "two objects": ("mask",),
    "polarized room": ("ambient", "room light", "body", "ill-posed", "outline"),
    "polarized room with a frame": ("ambient", "room light", "body", "ill-posed", "outline"),
}  # fmt: skip
ANGLES = (0.0, 45.0, 90.0)


@dataclass
class Plan:
    """A capture about to be written."""

    scene: Scene
    shoot: Shoot
    shift: Floats  # (K, 2) px, of the camera
    of_shot: Callable[[Scene, int], Scene] = lambda scene, k: scene
    lamps: tuple[tuple[float, float, float], ...] = ()  # m, instead of the flash
    after: Light = lambda light, k, e: light
    ambient: float = 0.0  # light of the room, mean over the object, over that of the flash
    polarized: float = 0.0  # degree of the room's polarization
    ambient_frames: Literal["none", "one", "each"] = "none"


def write(folder: Path, seed: int, kind: str, width: int = 640) -> None:
    """Write the capture, and its true maps as truth.npz."""
    random = np.random.default_rng([seed, 21])
    plan = _usual(seed, width, random)
    _plant(plan, kind, random)
    studio = _lit(plan)
    room = _room(plan, studio, random)
    numbers = iter(range(1, 100))
    actual = np.array(ANGLES) + plan.shoot.angle_error_deg * random.normal(size=len(ANGLES))
    for k, name in enumerate(ANGLES):
        pose = ShotPose(float(actual[k]), (float(plan.shift[k, 0]), float(plan.shift[k, 1])))
        scene = plan.of_shot(plan.scene, k)
        shot = studio
        if scene is not plan.scene:
            shot = Studio(scene, plan.shoot)
            shot.middle = studio.middle
        radiance = shot.radiance(pose)
        indoors = room.radiance(pose) if plan.ambient else np.zeros_like(radiance)
        for e in range(plan.shoot.exposures):
            file = folder / f"pol{name:05.1f}" / f"IMG_{next(numbers):04d}.DNG"
            file.parent.mkdir(parents=True, exist_ok=True)
            light = plan.after(radiance + indoors, k, e)
            studio.photograph(file, light, Take(k, e, plan.shoot.step ** (e - 1)))
        if plan.ambient_frames == "each" or (plan.ambient_frames == "one" and k == 0):
            file = folder / "ambient" / f"IMG_{next(numbers):04d}.DNG"
            file.parent.mkdir(parents=True, exist_ok=True)
            studio.photograph(file, indoors, Take(k, 1, 1.0, again=1))
    if plan.ambient_frames != "none":
        _state_roles(folder)
    _write_truth(folder, studio)


def _usual(seed: int, width: int, random: Random) -> Plan:
    shoot = Shoot(
        seed=seed, width=width, height=width * 3 // 8 * 2, samples=1, angles_deg=ANGLES,
        bracket="time", gain_jitter=0.003,
    )  # fmt: skip
    scene = random_scene(seed, ("bumps", "clusters", "vase")[seed % 3])
    scene = msgspec.structs.replace(scene, law=("smooth", "rough")[seed // 3 % 2])
    shift = random.uniform(-1, 1, (len(ANGLES), 2)) * shoot.nudge_px
    shift[0] = 0
    return Plan(scene, shoot, shift)


def _plant(plan: Plan, kind: str, random: Random) -> None:
    replace = msgspec.structs.replace
    scene, shoot, chart = plan.scene, plan.shoot, plan.scene.chart
    assert chart is not None
    victim = int(random.integers(1, len(ANGLES)))
    if kind == "chart behind":
        far = tuple(2**0.5 * c for c in chart.center)
        plan.scene = replace(scene, chart=replace(chart, center=far, pitch=2**0.5 * chart.pitch))
    elif kind == "chart lit from the side":
        plan.after = _chart_side_light(plan, float(random.choice([-1, 1])), bool(random.random() < 0.5))
    elif kind == "vignetting 50 %":
        fall = _vignette(shoot, 0.5)
        plan.after = lambda light, k, e: light * fall
    elif kind == "no chart":
        plan.scene = replace(scene, chart=None)
    elif kind.startswith("turned"):
        degrees = 1.0 if "1°" in kind else 0.3
        axis = random.normal(size=3)
        step = degrees * axis / np.linalg.norm(axis)
        plan.of_shot = lambda of, k: _turned(of, k * step) if k else of
    elif kind == "pushed 1 px":
        way = random.uniform(0, 2 * np.pi)
        px = 2 * 0.7 / shoot.view.focal  # m: a pixel of the merged picture
        push = px * np.array([np.cos(way), np.sin(way), 0.0])
        plan.of_shot = lambda of, k: replace(of, position=tuple(np.array(of.position) + push)) if k == victim else of
    elif kind in ("two softboxes", "two flashes"):
        plan.shift[:] = 0
        z = scene.position[2]
        if kind == "two flashes":
            plan.lamps = ((-0.35, 0.05, 0.0), (0.35, 0.05, 0.0))
        else:
            boxes = [(side * 0.6, up, z + 0.6) for side in (-1, 1) for up in (-0.15, 0.15)]
            plan.lamps = tuple(boxes)
    elif kind == "one shot 25 % dimmer":
        plan.after = lambda light, k, e: 0.75 * light if k == victim else light
    elif kind == "one shot lit unevenly by 2 %":
        ramp = np.linspace(0.99, 1.01, shoot.width)[:, None]
        plan.after = lambda light, k, e: ramp * light if k == victim else light
    elif kind == "all out of focus by 3 px":
        plan.after = lambda light, k, e: gaussian_filter(light, 3.0, axes=(0, 1))
    elif kind == "overexposed 12 times":
        plan.shoot = replace(shoot, exposure_factor=12.0)
    elif kind == "one frame blurred":
        frame = int(random.integers(3))
        blur = partial(gaussian_filter, sigma=1.5, axes=(0, 1))
        plan.after = lambda light, k, e: blur(light) if (k, e) == (victim, frame) else light
    elif kind == "black level wrong by 2":
        plan.scene = replace(scene, backdrop_albedo=0.004)
        black = float(random.choice([-2, 2])) / (shoot.sensor.white - shoot.sensor.black)
        middle = float(Studio(plan.scene, plan.shoot).middle)
        plan.after = lambda light, k, e: np.maximum(light + black / (middle * shoot.step ** (e - 1)), 0)
    elif kind == "vignetting of wide apertures":
        plan.shoot = replace(shoot, bracket="aperture")
        falls = [_vignette(shoot, share) for share in (0.0, 0.1, 0.3)]
        plan.after = lambda light, k, e: light * falls[e]
    elif kind == "at the border":
        x = -0.17 - float(random.uniform(0.02, 0.05))
        plan.scene = replace(scene, position=(x, *scene.position[1:]))
    elif kind == "two objects":
        up, radius = random.uniform(-0.02, 0.02, 2).tolist(), random.uniform(0.024, 0.034, 2).tolist()
        balls = [(x, y, 0.0, r) for x, y, r in zip((-0.04, 0.04), up, radius)]
        plan.scene = replace(scene, shape=Cluster(tuple(balls)), turn_deg=(0.0, 0.0, float(random.uniform(-60, 60))))
    elif kind in ("ambient frame", "polarized ambient frames", "polarized room", "polarized room with a frame"):
        plan.shift[:] = 0
        plan.ambient = 0.15 / 0.85
        plan.polarized = 0.3 * ("polarized" in kind)
        plan.ambient_frames = "each" if "frames" in kind else "one" if "frame" in kind else "none"


def _turned(scene: Scene, by_deg: Floats) -> Scene:
    turn = Rotation.from_rotvec(by_deg, degrees=True) * scene.turn
    x, y, z = (float(v) for v in turn.as_rotvec(degrees=True))
    return msgspec.structs.replace(scene, turn_deg=(x, y, z))


def _lit(plan: Plan) -> Studio:
    """The studio under its flash, or under all its lamps at once."""
    studio = Studio(plan.scene, plan.shoot)
    if plan.lamps:
        each = [Studio(msgspec.structs.replace(plan.scene, light=lamp), plan.shoot).reference for lamp in plan.lamps]
        studio.reference = np.mean(each, axis=0)
        studio.middle = synthetic._middle_exposure(
            plan.scene, plan.shoot, studio.buffer, studio.reference[0] @ studio.to_camera.T
        )
    return studio


def _room(plan: Plan, studio: Studio, random: Random) -> Studio:
    """The studio under the room's light, from lamps all around, with one polarization throughout."""
    room = copy.copy(studio)
    if not plan.ambient:
        return room
    lamps = [(1.5, 0.5, 0.5), (-1.5, 0.5, 0.5), (0.0, 1.6, 0.0), (0.0, -1.6, 0.3), (0.3, 0.3, 1.2)]
    each = [Studio(msgspec.structs.replace(plan.scene, light=lamp), plan.shoot).reference for lamp in lamps]
    light = np.mean(each, axis=0)
    mask = studio.buffer.mask
    light = light * plan.ambient * studio.reference[0][mask].mean() / light[0][mask].mean()
    if plan.polarized:
        way = float(random.uniform(0, np.pi))
        light[1], light[2] = (plan.polarized * light[0] * f(2 * way) for f in (np.cos, np.sin))
    room.reference = light
    return room


def _vignette(shoot: Shoot, lost: float) -> Floats:
    """Share of the light (H, W, 1) that passes a lens which loses `lost` of it in the corners."""
    y, x = np.mgrid[: shoot.height, : shoot.width].astype(np.float64)
    off = np.hypot(x - shoot.view.center[0], y - shoot.view.center[1])
    return np.asarray(1 - lost * (off / off.max()) ** 2)[..., None]


def _chart_side_light(plan: Plan, side: float, added: bool) -> Light:
    """The chart's light falls from side to side by a third, the object's does not.

    With `added` light of a lamp next to the chart comes on top of the flash, else the chart's mean light is right.
    """
    view, chart = plan.shoot.view, plan.scene.chart
    assert chart is not None
    y, x = np.mgrid[: plan.shoot.height, : plan.shoot.width].astype(np.float64)
    px = view.focal / -chart.center[2]
    u = (x - view.center[0] - px * chart.center[0]) / (3 * px * chart.pitch)  # −1…1 over the chart
    v = (y - view.center[1] + px * chart.center[1]) / (3 * px * chart.pitch)
    on = (np.abs(u) < 1.15) & (np.abs(v) < 0.9)
    lamp = 9 / (3 - side * np.clip(u, -1.2, 1.2)) ** 2
    gain = np.where(on, 1 + 0.35 * lamp if added else 1 + 0.35 * (lamp - 1), 1.0)[..., None]
    return lambda light, k, e: light * gain


def _state_roles(folder: Path) -> None:
    """Write capture.toml; with one ambient frame per angle, each has its angle."""
    ambient = sorted((folder / "ambient").iterdir())
    entries = []
    for k, name in enumerate(ANGLES):
        angle = f"angle = {name}\n"
        shots = sorted((folder / f"pol{name:05.1f}").iterdir())
        entries += [f'file = "{file.relative_to(folder)}"\n{angle}' for file in shots]
        for file in ambient[k : k + 1]:
            role = 'role = "ambient"\n' + angle * (len(ambient) > 1)
            entries.append(f'file = "{file.relative_to(folder)}"\n{role}')
    (folder / "capture.toml").write_text("".join(f"[[frame]]\n{entry}" for entry in entries))


def _write_truth(folder: Path, studio: Studio) -> None:
    buffer: Any = studio.buffer
    diffuse, specular, roughness, _ = scene_materials.evaluate(studio.scene.coat, buffer.position, buffer.facing)
    maps = {"normal": buffer.normal, "diffuse": diffuse, "specular": specular, "roughness": roughness}
    halves = {name: image.astype(np.float16) for name, image in maps.items()}
    np.savez_compressed(folder / "truth.npz", allow_pickle=False, mask=buffer.mask, **halves)
