"""How often `check` and `process` are right, and agree, on simulated captures good and with one planted fault.

python tests/benchmarks/bench_verdicts.py FOLDER [--good 12] [--faults 1] [--first-seed 300] [--width 640] [--only KIND]

FOLDER keeps the captures, outside the repository. `process` is the path up to its gates, with the analytic estimator.
Prints a Markdown row per capture and the shares: kept, passed, contradictions, found, rightly named.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from polcap import check, gates, path
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats import capture as captures
from polcap.formats import png
from polcap.images import ChartRequest, Floats
from polcap.report.whole import Whole
from polcap.store import Store
from polcap.synth import shooting as synthetic
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot, Studio, Take

ANGLES = ((0.0, 45.0, 90.0), (0.0, 60.0, 120.0), (0.0, 45.0, 90.0, 135.0))
LOOKS = ("as drawn", "dark", "white", "matte", "glossy")

# kind: (gates or words that name it, of `check` or of the error line)
FAULTS: dict[str, tuple[str, ...]] = {
    "swapped": ("order", "angles"),
    "mirrored": ("order", "angles"),
    "missing turn": ("angles", "order", "polarized"),
    "turned by 15°": ("angles", "order"),
    "flash jitter, no chart": ("gains", "gain doubt"),
    "clipped": ("clipping", "alignment"),
    "underexposed": ("noise", "chart", "capture"),  # capture: "too few well exposed pixels"
    "object moved": ("alignment", "stillness", "body", "ill-posed"),
    "camera moved": ("alignment",),
    "defocus": ("sharpness",),
    "ambient light": ("ambient", "body", "other light", "ill-posed"),
    "tone curve": ("tone curve", "source"),
    "lossy": ("source", "tone curve"),
    "cut file": ("error",),
    "wrong focal": ("focal length",),
    "no chart": ("chart",),
    "glossy chart": ("gain doubt", "chart", "gains"),
    "other object": ("alignment",),
    "flash by shutter": ("exposures", "clipping"),
    "wax": ("body",),
}


@dataclass
class Shooting:
    """A capture about to be written."""

    studio: Studio
    actual: list[float]  # degrees
    names: list[float]
    shifts: Floats
    light: Callable[[Floats, int, int], Floats]


def main() -> None:
    parse = argparse.ArgumentParser()
    parse.add_argument("folder", type=Path)
    parse.add_argument("--good", type=int, default=12)
    parse.add_argument("--faults", type=int, default=1, help="captures of each kind")
    parse.add_argument("--first-seed", type=int, default=300)
    parse.add_argument("--width", type=int, default=640)
    parse.add_argument("--only", default="")
    given = parse.parse_args()
    plan = [""] * given.good + list(FAULTS) * given.faults
    print("| seed | planted | check | process | because of | right |\n| --- | --- | --- | --- | --- | --- |")
    good = kept = passed = contradictions = faulty = found = named = 0
    for seed, kind in enumerate(plan, given.first_seed):
        if given.only and kind != given.only:
            continue
        place = given.folder / f"{seed}-{kind.replace(' ', '-') or 'good'}-{given.width}"
        if not place.exists():
            shoot(place, seed, kind, given.width)
        said, reasons = judge_check(place)
        done, why = judge_process(place, no_chart=with_no_chart(seed, kind))
        told = reasons | why
        sound = "fail" not in (said, done)
        mark = ""
        if not kind:
            good, kept, passed = good + 1, kept + (said != "fail"), passed + (done != "fail")
            contradictions += (said == "fail") != (done == "fail")
            mark = "yes" if sound else "NO"
        else:
            faulty, found = faulty + 1, found + bool(told)
            right = any(word in reason for reason in told for word in FAULTS[kind])
            named += right
            mark = "named" if right else "found" if told else "NO"
        print(f"| {seed} | {kind} | {said} | {done} | {'; '.join(sorted(told))} | {mark} |", flush=True)
    print(f"\ngood {good}: kept by check {kept}, passed by process {passed}, contradictions {contradictions}")
    print(f"faulty {faulty}: found {found}, rightly named {named}")


def judge_check(place: Path) -> tuple[str, set[str]]:
    """The verdict, and the gates that speak; a missing chart speaks only where it is the fault."""
    try:
        verdict = check.inspect(captures.read(place), None, Config())
    except InputError as error:
        return "fail", {f"error {type(error).__name__}"}
    return gates.verdict(verdict.lines), _speaking(verdict.lines, place)


def judge_process(place: Path, no_chart: bool) -> tuple[str, set[str]]:
    chart = ChartRequest("none" if no_chart else "auto")
    with tempfile.TemporaryDirectory() as out:
        try:
            capture = captures.read(place)
            found = path.path(capture, path.UserInput(chart=chart), Config(), Store(Path(out)))
            lines = list(gates.judge(Whole(found, capture.focal_known), Config()))
        except InputError as error:
            name = type(error).__name__.removesuffix("Error").lower()
            order = "order " if "contradict the object's outline" in str(error) else ""
            return "fail", {f"error {order}{name}{' chart' * ('ColorChecker' in str(error))}"}
    return gates.verdict(lines), _speaking(lines, place)


def _speaking(lines: tuple[gates.Gate, ...] | list[gates.Gate], place: Path) -> set[str]:
    usual = {"mask", "chart"} if "good" in place.name or "no-chart" not in place.name else {"mask"}
    return {line.name for line in lines if line.state == "fail" or (line.state == "warn" and line.name not in usual)}


def with_no_chart(seed: int, kind: str) -> bool:
    return kind == "flash jitter, no chart" or (not kind and seed % 4 == 3)


def shoot(folder: Path, seed: int, kind: str, width: int) -> None:
    """Write a capture of 3 exposures with ordinary jitter and nudges, and the fault `kind` ("" for none)."""
    random = np.random.default_rng([seed, 11])
    planned = _good(seed, kind, width, random)
    _plant(planned, kind, random)
    how = planned.studio.shoot
    for k, name in enumerate(planned.names):
        roll = how.nudge_deg * float(random.uniform(-1, 1)) * (k > 0)
        shift = float(planned.shifts[k, 0]), float(planned.shifts[k, 1])
        pose = {
            "actual_deg": planned.actual[k],
            "rot_deg": roll,
            "transform": synthetic.transform(how, shift, roll).tolist(),
        }
        radiance = planned.studio.radiance(pose, first=k == 0)
        for e in range(3):
            stops = how.step ** (e - 1)
            suffix = "png" if kind in ("tone curve", "lossy") else "DNG"
            file = folder / f"pol{name:03.0f}" / f"IMG_{3 * k + e + 1:04d}.{suffix}"
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


def _good(seed: int, kind: str, width: int, random: np.random.Generator) -> Shooting:
    angles = ANGLES[seed % 3] if not kind else ANGLES[0]
    bracket = ("time", "flash", "iso")[seed % 3]
    how = Shoot(seed=seed, width=width, height=width * 3 // 4, samples=1, angles_deg=angles, bracket=bracket)  # type: ignore[arg-type]
    scene = random_scene(seed, ("bumps", "clusters", "vase")[(seed // 2) % 3])
    look = LOOKS[seed % 5] if not kind else LOOKS[0]
    if look != "as drawn":
        scene = msgspec.structs.replace(scene, coat=_dressed(scene.coat, look))
    if with_no_chart(seed, kind) or kind == "no chart":
        scene = msgspec.structs.replace(scene, chart=None)
    shots = len(angles)
    actual = (np.array(angles) + how.angle_error_deg * random.normal(size=shots)).tolist()
    shifts = random.uniform(-1, 1, (shots, 2)) * how.nudge_px
    shifts[0] = 0
    return Shooting(Studio(scene, how), actual, list(angles), shifts, lambda light, k, e: light)


def _dressed(coat: object, look: str) -> object:
    scale = {"dark": 0.25, "white": 1.0, "matte": 1.0, "glossy": 1.0}[look]
    dressed = []
    for one in coat.materials:  # type: ignore[attr-defined]
        first, second = (tuple(min(scale * c, 1.0) for c in color) for color in (one.first, one.second))
        if look == "white":
            first, second = (0.85, 0.85, 0.83), (0.75, 0.75, 0.74)
        rough = {"matte": (0.6, 0.8), "glossy": (0.15, 0.25)}.get(look, one.roughness)
        dressed.append(msgspec.structs.replace(one, first=first, second=second, roughness=rough))
    return msgspec.structs.replace(coat, materials=tuple(dressed))  # type: ignore[type-var]


def _plant(planned: Shooting, kind: str, random: np.random.Generator) -> None:
    studio, victim = planned.studio, int(random.integers(1, 3))
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
        pops = 1 + np.array([0, -0.12, 0.13])[random.permutation(3)]
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
        shine = 0.06 * np.array([1.0, 0.6, 0.2]) * float(studio.through(0).max())
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


def _pushed(light: Floats, mask: NDArray[np.bool_], px: int) -> Floats:
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


if __name__ == "__main__":
    main()
