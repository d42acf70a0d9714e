"""Simulated captures in which one thing, and only one, went wrong; or nothing."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d

from polcap.image_values import Floats
from polcap.synth.scenes import Kind, random_scene
from polcap.synth.shooting import Shoot, ShotPose, Studio, Take

FAULTS = {  # what went wrong: the lines of `polcap check` that tell it; none: the folder cannot be read
    "clipped": ("clipping",),
    "swapped": ("order", "angles"),
    "clockwise": ("order",),
    "defocus": ("sharpness",),
    "shaken": ("sharpness",),
    "moved": ("alignment",),
    "pushed": ("alignment",),
    "misfire": ("gains", "energy"),
    "drift": ("energy",),
    "wrong angle": ("angles", "order"),
    "not turned": ("angles", "order"),
    "lamp": ("other light", "angles", "gains"),
    "missing": (),
}
_ANGLES = (0.0, 45.0, 90.0)
_KINDS: tuple[Kind, ...] = ("bumps", "clusters", "vase")


def shoot(folder: Path, seed: int, fault: str, width: int) -> str:
    """Write a 3 × 3 capture with the ordinary jitter and nudges, and `fault` ("" for none); tells what was done."""
    random = np.random.default_rng([seed, 4])
    studio = _studio(seed, width)
    scene, how = studio.scene, studio.shoot
    victim, frame = (int(random.integers(n)) for n in (3, 3))
    actual = np.array(_ANGLES) + how.angle_error_deg * random.normal(size=3)
    shift = random.uniform(-1, 1, (3, 2)) * how.nudge_px
    roll = random.uniform(-1, 1, 3) * how.nudge_deg
    shift[0] = roll[0] = 0
    change: Callable[[Floats, int, int], Floats] = lambda light, k, e: light  # noqa: E731
    names, done = [0, 1, 2], f"shot {victim}"
    if fault == "clipped":
        lit = studio.through(0)[studio.buffer.mask].max(-1) * studio.middle / how.step
        times = 1.1 / float(np.percentile(lit, 85))
        change, done = lambda light, k, e: times * light, f"{times:.0f} times the light"
    elif fault == "swapped":
        other = (victim + 1) % 3
        names[victim], names[other] = other, victim
        done = f"shots {victim} and {other}"
    elif fault == "clockwise":
        actual, done = -actual, "all angles"
    elif fault == "defocus":
        sigma = random.uniform(1.8, 3)
        change = lambda light, k, e: gaussian_filter(light, sigma, axes=(0, 1)) if k == victim else light  # noqa: E731
        done = f"shot {victim}, sigma {sigma:.1f} px"
    elif fault == "shaken":
        length, axis = int(random.integers(7, 11)), int(random.integers(2))
        hit = (victim, frame)
        change = lambda light, k, e: uniform_filter1d(light, length, axis) if (k, e) == hit else light  # noqa: E731
        done = f"shot {victim} frame {frame}, {length} px along {'yx'[axis]}"
    elif fault == "moved":
        victim = 1 + victim % 2
        shift[victim] = random.choice([-1, 1], 2) * random.uniform(90, 120, 2)
        done = f"shot {victim} by {np.round(shift[victim])} px"
    elif fault == "pushed":
        victim, mask = 1 + victim % 2, studio.buffer.mask
        there = np.roll(mask, 6, 1)[..., None]
        change = lambda light, k, e: np.where(there, np.roll(light, 6, 1), light) if k == victim else light  # noqa: E731
        done = f"shot {victim}, the object by 6 px"
    elif fault == "misfire":
        whole = bool(random.integers(2))
        change = lambda light, k, e: light * (0.7 if k == victim and (whole or e == frame) else 1)  # noqa: E731
        done = f"shot {victim}{'' if whole else f' frame {frame}'} 30 % low"
    elif fault == "drift":
        change = lambda light, k, e: light * ((1, 0.92, 0.84)[e] if k == victim else 1)  # noqa: E731
        done = f"shot {victim} by 8 % a frame"
    elif fault == "wrong angle":
        error = 15 * float(random.choice([-1, 1]))
        actual[victim] += error
        done = f"shot {victim} by {error:+.0f} degrees"
    elif fault == "not turned":
        victim = 1 + victim % 2
        actual[victim] = actual[victim - 1]
        done = f"shot {victim} as the one before"
    elif fault == "lamp":
        place = (float(random.choice([-1, 1])) * 0.6, 0.3, 0.0)
        lamp = Studio(msgspec.structs.replace(scene, light=place), how)
        share = 0.15 * studio.reference[0][studio.buffer.mask].mean() / lamp.reference[0][studio.buffer.mask].mean()
        extra = share * (lamp.reference[0] @ lamp.to_camera.T) / 2
        change = lambda light, k, e: light + extra if k == victim else light  # noqa: E731
        done = f"shot {victim}, 15 % more light from one side"
    for k in range(3):
        radiance = _radiance(seed, width, ShotPose(actual[k], (shift[k, 0], shift[k, 1]), roll[k]))
        for e in range(3):
            stops = how.step ** (e - 1)
            file = folder / f"pol{_ANGLES[names[k]]:03.0f}" / f"IMG_{3 * k + e + 1:04d}.DNG"
            file.parent.mkdir(parents=True, exist_ok=True)
            studio.photograph(file, change(radiance, k, e), Take(k, e, stops))
            if fault == "missing" and (k, e) == (victim, frame):
                file.unlink()
                done = f"shot {victim} frame {frame}"
    return done


@lru_cache(maxsize=8)
def _radiance(seed: int, width: int, pose: ShotPose) -> Floats:
    """Light of a shot, (H, W, 3), which most faults of a seed share."""
    return _studio(seed, width).radiance(pose)


@lru_cache(maxsize=2)
def _studio(seed: int, width: int) -> Studio:
    how = Shoot(seed=seed, width=width, height=width * 3 // 4, samples=1)
    return Studio(random_scene(seed, _KINDS[seed % 3]), how)
