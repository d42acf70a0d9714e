"""Simulates a good or faulty capture from a seed, with random angles, light, chart, object and polarization law.

Kind "" is a good capture: ordinary jitter of light and angles, ordinary nudges. The true normals are stored with it.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from bench_flat import KINDS as FLAT
from bench_flat import draw
from scipy.ndimage import gaussian_filter

from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import mueller
from polcap.synth.color_checker import Chart
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene, with_model
from polcap.synth.shooting import Shoot, ShotPose, Studio, Take

Random = np.random.Generator

LOOKS = ("as drawn", "dark", "white", "matte", "glossy")
STANDARD_ANGLES = ((0.0, 45.0, 90.0), (0.0, 60.0, 120.0), (0.0, 45.0, 90.0, 135.0))

# kind: gates, or words of the error line, that name it
FAULTS: dict[str, tuple[str, ...]] = {
    "swapped": ("order", "angles"),
    "mirrored": ("order", "angles"),
    "missing turn": ("angles", "order", "polarized"),
    "turned by 15°": ("angles", "order"),
    "flash jitter, no chart": ("gains", "gain doubt"),
    "clipped": ("clipping", "alignment", "exposure"),  # an error line "too few well exposed pixels"
    "underexposed": ("noise", "chart", "exposure"),
    "object moved": ("alignment", "stillness"),
    "camera moved": ("alignment",),
    "defocus": ("sharpness",),
    "ambient light": ("ambient", "body", "other light", "ill-posed"),
    "tone curve": ("tone curve", "source"),
    "lossy": ("source", "tone curve"),
    "cut file": ("decode",),
    "wrong focal": ("focal length",),
    "no chart": ("chart",),
    "glossy chart": ("gain doubt", "chart", "gains"),
    "other object": ("alignment",),
    "flash by shutter": ("exposures", "clipping"),
    "wax": ("body", "polarized"),  # which names translucent bodies too
}


@dataclass
class Planned:
    """A capture about to be written."""

    studio: Studio
    look: str
    chart: str  # near, corner or none
    actual: list[float]  # degrees
    names: list[float]
    shifts: Floats  # (K, 2) px
    light: Callable[[Floats, int, int], Floats] = field(default=lambda light, k, e: light)

    @property
    def about(self) -> dict[str, Any]:
        """How it is shot, for a row of the benchmark."""
        how, scene = self.studio.shoot, self.studio.scene
        return {
            "angles": list(how.angles_deg), "bracket": how.bracket, "chart": self.chart, "look": self.look,
            "law": scene.law if isinstance(scene.law, str) else "smooth",
            "object": Path(getattr(scene.shape, "file", "")).stem, "focal": round(how.focal_mm), "width": how.width,
        }  # fmt: skip


def shoot(folder: Path, seed: int, kind: str, width: int, meshes: Path | None = None) -> dict[str, Any]:
    """Write a capture of 3 exposures, width × ¾ width RAW px, and the fault `kind`; returns what was drawn.

    With a folder of meshes the object is one of them or, every fourth time, a flat shape; lenses have 36 to 100 mm.
    """
    random = np.random.default_rng([seed, 11])
    planned = _good(seed, kind, width, random, meshes)
    _plant(planned, kind, random)
    how = planned.studio.shoot
    for k, name in enumerate(planned.names):
        roll = how.nudge_deg * float(random.uniform(-1, 1)) * (k > 0)
        shift = float(planned.shifts[k, 0]), float(planned.shifts[k, 1])
        radiance = planned.studio.radiance(ShotPose(planned.actual[k], shift, roll))
        for e in range(3):
            stops = how.step ** (e - 1)
            suffix = "png" if kind in ("tone curve", "lossy") else "DNG"
            file = folder / f"pol{name:05.1f}" / f"IMG_{3 * k + e + 1:04d}.{suffix}"
            file.parent.mkdir(parents=True, exist_ok=True)
            light = planned.light(radiance, k, e)
            if suffix == "png":
                _develop(file, light * planned.studio.middle * stops, kind)
                continue
            planned.studio.photograph(file, light, Take(k, e, stops))
            if kind == "cut file" and (k, e) == (1, 1):
                file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    if kind == "wrong focal":
        (folder / "capture.toml").write_text("focal_length_mm = 24.0\n")
    buffer = planned.studio.buffer
    np.savez_compressed(folder / "normals.npz", normal=buffer.normal.astype(np.float16), mask=buffer.mask)
    return planned.about


def _good(seed: int, kind: str, width: int, random: Random, meshes: Path | None) -> Planned:
    angles = _angles(seed, random)
    bracket: Literal["time", "flash", "iso", "aperture"] = ("time", "flash", "iso", "time", "aperture")[seed // 3 % 5]
    jitter = 0.003 if bracket == "time" else 0.01  # steady lamps repeat better than flashes
    how = Shoot(
        seed=seed, width=width, height=width * 3 // 8 * 2, samples=1, angles_deg=angles, bracket=bracket,
        gain_jitter=jitter, cfa=("RGGB", "BGGR", "GRBG", "GBRG")[seed // 2 % 4],
    )  # fmt: skip
    scene = random_scene(seed, ("bumps", "clusters", "vase")[int(random.integers(3))])
    look = LOOKS[int(random.integers(5))]
    if look != "as drawn":
        scene = msgspec.structs.replace(scene, coat=_dressed(scene.coat, look))
    chart = ("near", "near", "corner", "none")[int(random.integers(4))]
    if kind:  # other places of a chart are no fault that was planted
        chart = "none" if kind in ("flash jitter, no chart", "no chart") else "near"
    if chart == "none":
        scene = msgspec.structs.replace(scene, chart=None)
    elif chart == "corner":
        up = float(random.choice([-1, 1]))
        turn = tuple(random.uniform(-1, 1, 3) * (6, 6, 3))  # not along the rays' rows: one ray a pixel sees steps there
        scene = msgspec.structs.replace(scene, chart=Chart(center=(0.144, 0.106 * up, -0.7), turn_deg=turn))
    scene = msgspec.structs.replace(scene, law=("smooth", "rough")[int(random.integers(2))])
    if meshes is not None:
        scene, times = _other_object(scene, seed, meshes)
        how = msgspec.structs.replace(how, focal_mm=how.focal_mm * times)
    shots = len(angles)
    actual = (np.array(angles) + how.angle_error_deg * random.normal(size=shots)).tolist()
    shifts = random.uniform(-1, 1, (shots, 2)) * how.nudge_px
    shifts[0] = 0
    return Planned(Studio(scene, how), look, chart, actual, list(angles), shifts)


def _other_object(scene: Scene, seed: int, meshes: Path) -> tuple[Scene, float]:
    """The scene with a mesh or a flat shape as its object, and the factor of focal length and distance."""
    random = np.random.default_rng([seed, 12])
    times = float(random.uniform(0.6, 1.67))
    if seed % 4 == 0:
        flat = draw(seed, list(FLAT)[seed // 4 % len(FLAT)], Path(tempfile.gettempdir()) / "polcap-flat")
        scene = msgspec.structs.replace(scene, shape=flat.shape, turn_deg=flat.turn_deg, interreflection=True)
    else:
        files = sorted(meshes.glob("*.npz"))
        scene = with_model(scene, files[int(random.integers(len(files)))], seed)
    x, y, z = scene.position
    chart = scene.chart
    if chart is not None:
        chart = msgspec.structs.replace(chart, center=(*chart.center[:2], times * chart.center[2]))
    return msgspec.structs.replace(scene, position=(x, y, times * z), chart=chart), times


def _angles(seed: int, random: Random) -> tuple[float, ...]:
    """A usual set; every fourth time 3 to 6 random whole degrees that determine the Stokes parameters about as well."""
    if seed % 4 < 3:
        return STANDARD_ANGLES[seed % 4]
    while True:
        drawn = np.sort(random.choice(180, int(random.integers(3, 7)), replace=False)).astype(float)
        if np.linalg.cond(mueller.analyzer(np.radians(drawn))) < 4 and np.diff(drawn).min() >= 12:
            return tuple(drawn)


def _dressed(coat: Any, look: str) -> Any:
    scale = 0.25 if look == "dark" else 1.0
    dressed = []
    for one in coat.materials:
        first, second = (tuple(min(scale * c, 1.0) for c in color) for color in (one.first, one.second))
        if look == "white":
            first, second = (0.85, 0.85, 0.83), (0.75, 0.75, 0.74)
        rough = {"matte": (0.6, 0.8), "glossy": (0.15, 0.25)}.get(look, one.roughness)
        dressed.append(msgspec.structs.replace(one, first=first, second=second, roughness=rough))
    return msgspec.structs.replace(coat, materials=tuple(dressed))


def _plant(planned: Planned, kind: str, random: Random) -> None:
    studio, shots = planned.studio, len(planned.names)
    victim = int(random.integers(1, shots))
    mask = studio.buffer.mask
    if kind == "swapped":
        planned.names[0], planned.names[victim] = planned.names[victim], planned.names[0]
    elif kind == "mirrored":
        planned.actual = [-angle for angle in planned.actual]
    elif kind == "missing turn":
        planned.actual[victim] = planned.actual[victim - 1]
    elif kind == "turned by 15°":
        planned.actual[victim] += 15 * float(random.choice([-1, 1]))
    elif kind == "flash jitter, no chart":
        pops = 1 + np.array([0, -0.12, 0.13, *random.uniform(-0.05, 0.05, shots - 3)])[random.permutation(shots)]
        planned.light = lambda light, k, e: light * pops[k]
    elif kind == "clipped":
        bright = float(np.percentile(studio.through(0)[mask].max(-1), 80)) * studio.middle / studio.shoot.step
        planned.light = lambda light, k, e: light * 1.1 / bright
    elif kind == "underexposed":
        planned.light = lambda light, k, e: light / 300
    elif kind == "object moved":
        planned.light = lambda light, k, e: _pushed(light, mask, 6) if k == victim else light
    elif kind == "camera moved":
        planned.shifts[victim] = random.choice([-1, 1], 2) * random.uniform(90, 120, 2)
    elif kind == "defocus":
        planned.light = lambda light, k, e: gaussian_filter(light, 2.4, axes=(0, 1)) if k == victim else light
    elif kind == "ambient light":
        lamp = Studio(msgspec.structs.replace(studio.scene, light=(0.6, 0.3, 0.0)), studio.shoot)
        share = 0.8 * studio.reference[0][mask].mean() / lamp.reference[0][mask].mean()
        extra = share * (lamp.reference[0] @ lamp.to_camera.T) / 2
        planned.light = lambda light, k, e: light + extra
    elif kind == "glossy chart":
        shine = 0.06 * (0.6 + 0.4 * np.cos(2 * np.radians(planned.actual))) * float(studio.through(0).max())
        zone = ~mask & (studio.through(0).mean(-1) > 0)
        zone[:, : zone.shape[1] * 6 // 10] = False
        planned.light = lambda light, k, e: light + shine[k] * zone[..., None]
    elif kind == "other object":
        other = Studio(random_scene(999, "clusters"), studio.shoot)
        light_of = other.through(planned.actual[victim])
        planned.light = lambda light, k, e: light_of if k == victim else light
    elif kind == "flash by shutter":
        studio.shoot = msgspec.structs.replace(studio.shoot, bracket="time")
        planned.light = lambda light, k, e: light / studio.shoot.step ** (e - 1)
    elif kind == "wax":
        mean = np.mean([studio.through(a) for a in (0, 90)], axis=0)
        planned.light = lambda light, k, e: np.where(mask[..., None], mean + 0.12 * (light - mean), light)


def _pushed(light: Floats, mask: Any, px: int) -> Floats:
    """The object moved by so many pixels before its backdrop."""
    moved, there = np.roll(light, px, 1), np.roll(mask, px, 1)
    behind = np.where(mask[..., None], np.median(light[~mask], axis=0), light)
    return np.where(there[..., None], moved, behind)


def _develop(file: Path, light: Floats, kind: str) -> None:
    """A finished picture: sRGB in 8 bits ("lossy"), or an S-curve in 16 bits passed off as linear."""
    balanced = np.clip(light / light.mean((0, 1)) * light.mean(), 0, 1)
    if kind == "lossy":
        png.write(file, np.round(255 * balanced ** (1 / 2.2)).astype(np.uint8))
        return
    png.write(file, np.round(65535 * (balanced**0.6) * (1.2 - 0.2 * balanced) / 1.0).clip(0, 65535).astype(np.uint16))
