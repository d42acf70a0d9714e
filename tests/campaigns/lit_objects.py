"""Shots of a simulated object without photographs, for campaigns on `selfcal`.

Bumps, clusters and vases of `polcap.synth`, 320 × 240 px, under a flash by the lens, smooth and rough bodies in turn,
with finishes that make gains difficult: glossy, matt, textured, a white patch near the outline, clipped highlights.
"""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats, Quality
from polcap.optics import frames, mueller
from polcap.stage_values import AngleStack, Equipment, ObjectMask, single_frames
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot, Studio
from tests import scenes
from tests.experiments import with_materials

FINISHES = ("textured", "glossy", "matt", "white patch", "clipped")
_NOISE = 0.004  # 1σ at S0 = 1, growing with its root: that of a bracket's merged pixel
_MARGIN = 12  # px of the crop around the object


@dataclass(frozen=True)
class Lit:
    """An object under a flash."""

    finish: str
    stokes: Floats  # (3, H, W, 3) in the frame of each ray
    mask: NDArray[np.bool_]
    rays: Floats  # (H, W, 3)


def lit(seed: int, thin: bool = False, chart: bool = False) -> Lit:
    """The seed's object; `thin` takes clusters alone, with parts that hide one another; `chart` adds a color chart.

    With a chart the picture has 640 × 480 px.
    """
    random = np.random.default_rng([seed, 11])
    finish = FINISHES[seed % len(FINISHES)]
    scene = random_scene(seed, "clusters" if thin else ("bumps", "clusters", "vase")[seed // 2 % 3])
    if not chart:
        scene = msgspec.structs.replace(scene, chart=None, position=(0.0, 0.0, scene.position[2]))
    rough = {"glossy": 0.2, "clipped": 0.25, "matt": 0.8}.get(finish)
    if rough is not None:
        scene = with_materials(scene, roughness=(rough, rough))
    law = "rough" if seed % 2 else "smooth"
    size = (640, 480, 60.0) if chart else (320, 240, 70.0)
    shoot = Shoot(width=size[0], height=size[1], focal_mm=size[2], samples=1)
    studio = Studio(msgspec.structs.replace(scene, law=law), shoot)
    image, mask = np.asarray(studio.reference, np.float64), studio.buffer.mask
    image = image / (1.0 if chart else np.percentile(image[0][mask], 90))
    if finish == "white patch":
        slope = studio.buffer.normal[..., 2]
        rim = np.argwhere(mask & (slope > 0.3) & (slope < 0.5))
        y, x = rim[int(random.integers(len(rim)))]
        rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
        image[:, mask & (np.hypot(rows - y, columns - x) < 14)] *= 4
    return Lit(finish, image, mask, frames.rays(shoot.view, *mask.shape))


def stack(case: Lit, angle: Floats, seed: int, gain: Floats | None = None, stated: Floats | None = None) -> AngleStack:
    """Shots at angles (K,) rad, with gains (K,) and noise, stated as `stated` (K,) rad."""
    random = np.random.default_rng([seed, 12])
    gain = np.ones(len(angle)) if gain is None else gain
    weights = np.stack([mueller.analyzer(frames.axis_on_ray(np.asarray(a), case.rays)) for a in angle])  # (K, H, W, 3)
    shots = np.einsum("khwj,jhwc->khwc", weights, case.stokes) * gain[:, None, None, None]
    variance = _NOISE**2 * np.maximum(shots, 0.02)
    shots = shots + random.normal(size=shots.shape) * np.sqrt(variance)
    top = 0.75 if case.finish == "clipped" else 4.0
    clipped = (shots > top).any(-1)
    return AngleStack(
        value=np.minimum(shots, top).astype(np.float32), variance=variance.astype(np.float32),
        quality=clipped.astype(np.uint8) * np.uint8(Quality.CLIPPED), angle=angle if stated is None else stated,
        view=scenes.VIEW, bracket=single_frames(len(angle)), equipment=Equipment("flash"),
    )  # fmt: skip


def object_of(case: Lit) -> ObjectMask:
    """The mask of the object, as drawn by hand."""
    rows, columns = (np.flatnonzero(case.mask.any(axis)) for axis in (1, 0))
    height, width = case.mask.shape
    edge = float(np.concatenate([case.mask[[0, -1]].ravel(), case.mask[:, [0, -1]].ravel()]).mean())
    box = (
        max(int(columns[0]) - _MARGIN, 0), max(int(rows[0]) - _MARGIN, 0),
        min(int(columns[-1]) + 1 + _MARGIN, width), min(int(rows[-1]) + 1 + _MARGIN, height),
    )  # fmt: skip
    return ObjectMask(case.mask, box, "user", border=edge)
