"""Benchmark of unsuitable light: errors of simulated objects under several lights, and whether the gates warn.

python -m tests.benchmarks.bench_lighting [--cases 100] [--first-seed 0] [--picture FILE.png]

Needs $POLCAP_DATA for its light probes. Objects are bumps, clusters and vases of polcap.synth, 320 × 240 px, dark, as
drawn or white, matte or glossy, or of metal. The truth comes from the true normals: the share of the object with
polarization closer to perpendicular than to parallel to the azimuth. A flash next to the lens is good. Light from one
side, metal, and light from around with a share above a tenth are not good; light from around with less is neither.
The gates are right if they pass the good captures and warn about the others. Prints a Markdown row per light.
"""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from polcap.formats import onnx
from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import fresnel, mueller
from polcap.quality import polarization
from polcap.quality.gate_values import full_size
from polcap.quality.limits import GateLimits
from polcap.stage_values import AngleStack, ObjectMask, single_frames
from polcap.stages import cues, infer, stokes
from polcap.synth import scene_materials
from polcap.synth.render import ObjectBuffer
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot, Studio
from tests import scenes
from tests.experiments import arguments, data, head, networks, row

ANGLE = np.radians([0.0, 45.0, 90.0])
LIGHTS = ("flash", "flash", "off-axis flash", "around", "flash and around", "metal")
LOOKS = ((1.0, None), (0.15, None), (None, None), (1.0, 0.2), (1.0, 0.7))  # albedo's factor, None: white; roughness
METALS = {"gold": 0.2 + 3.3j, "copper": 0.4 + 2.9j, "aluminium": 1.1 + 6.8j, "iron": 2.9 + 3.0j}  # near 600 nm
NOISE = 0.004  # 1σ at S0 = 1
FLIPPED = 0.1


@dataclass
class Lit:
    """An object under some light."""

    stokes: Floats  # (3, H, W, 3) in the frame of each ray, which here is the camera's: the object is far away
    normal: Floats  # (H, W, 3)
    mask: NDArray[np.bool_]


@dataclass
class Judged:
    """True properties of an object under some light, and the gates that do not pass."""

    flipped: float  # share of the polarized object with an AoLP nearer to across than along the azimuth
    jumps: float  # share of neighboring pixels with polarizations over 45° from each other
    normal_deg: float  # median error of the textbook's inversion, half-turns known
    lines: dict[str, str]  # findings of the gates that do not pass, by gate


def main() -> None:
    options = arguments(__doc__, cases=100, first_seed=0, picture=Path)
    rows: dict[str, list[tuple[bool, Judged]]] = {}
    for seed in range(options.first_seed, options.first_seed + options.cases):
        light = LIGHTS[seed % len(LIGHTS)]
        case = lit(seed, light)
        found = judge(case, seed)
        good = light == "flash"
        neither = "around" in light and found.flipped <= FLIPPED
        right = neither or (not found.lines) == good
        group = f"{light}, {'good' if good else 'neither' if neither else 'not good'}"
        rows.setdefault(group, []).append((right, found))
        if not right:
            print(f"<!-- {seed} {light}: flipped {found.flipped:.2f}, {found.lines} -->", flush=True)
    print(head("light", "captures", "across", "jumps", "normals °", "right"))
    for name in sorted(rows):
        each = [(found.flipped, found.jumps, found.normal_deg) for _, found in rows[name]]
        print(row(name, len(each), *np.median(each, axis=0), sum(right for right, _ in rows[name])))
    every = [right for name, group in rows.items() for right, _ in group if "neither" not in name]
    print(f"\nright {sum(every)} of {len(every)}")
    if options.picture:
        draw(options.picture)


def lit(seed: int, light: str) -> Lit:
    """The seed's object under a light of this kind."""
    random = np.random.default_rng([seed, 5])
    scene = random_scene(seed, ("bumps", "clusters", "vase")[seed % 3])
    turn = np.radians(random.uniform(30, 65)) if light == "off-axis flash" else 0.0
    way = random.uniform(0, 2 * np.pi)
    flash = (0.7 * np.tan(turn) * np.cos(way), 0.7 * np.tan(turn) * np.sin(way), 0.0) if turn else scene.light
    scene = msgspec.structs.replace(scene, chart=None, position=(0.0, 0.0, scene.position[2]), light=flash)
    albedo, rough = LOOKS[seed // 2 % len(LOOKS)]
    materials = tuple(_dressed(one, albedo, rough) for one in scene.coat.materials)
    coat = msgspec.structs.replace(scene.coat, materials=materials)
    scene = msgspec.structs.replace(scene, coat=coat, law="rough" if seed % 2 else "smooth")
    studio = Studio(scene, Shoot(width=320, height=240, focal_mm=70.0, samples=1))
    image, buffer = studio.reference, studio.buffer
    level = float(np.median(image[0][buffer.mask]))
    if light in ("around", "flash and around", "metal"):
        metal = METALS[list(METALS)[seed % len(METALS)]] if light == "metal" else None
        probe = _probe(seed, random.uniform(0, 2 * np.pi))
        surrounding = _around(buffer, coat, probe, metal)
        around = float(np.median(surrounding[0][buffer.mask]))
        share = {"around": 1.0, "flash and around": random.uniform(0.2, 0.6), "metal": 0.9}[light]
        image = (0 if metal or share == 1 else 1 - share) * image / level + share * surrounding / max(around, 1e-9)
    else:
        image = image / level
    return Lit(np.where(buffer.mask[..., None], image, 0), buffer.normal, buffer.mask)


def judge(case: Lit, seed: int) -> Judged:
    """Photograph it with noise, solve for the Stokes parameters, and judge by the gates of polarization."""
    image = solved(case, seed)
    total = image.stokes.sum(-1)
    mask = case.mask & (image.quality == 0)
    ratio = (total[1] + 1j * total[2]) / np.maximum(total[0], 1e-9)
    azimuth = np.arctan2(case.normal[..., 1], case.normal[..., 0])
    zenith = np.arccos(np.clip(case.normal[..., 2], 0, 1))
    sloped = mask & (zenith > np.radians(20)) & (np.abs(ratio) > 3 * NOISE)
    along = np.cos(np.angle(ratio) - 2 * azimuth)
    step = 3
    pairs = sloped[:, step:] & sloped[:, :-step]
    jump = np.cos(np.angle(ratio[:, step:]) - np.angle(ratio[:, :-step])) < 0
    return Judged(
        flipped=float((along[sloped] < 0).mean()) if sloped.any() else 1.0,
        jumps=float(jump[pairs].mean()) if pairs.any() else 0.0,
        normal_deg=_normal_error(ratio, case.normal, mask),
        lines=_findings(image),
    )


def solved(case: Lit, seed: int) -> Any:
    """The Stokes image of three shots in noise."""
    random = np.random.default_rng([seed, 6])
    shots = np.einsum("kj,jhwc->khwc", mueller.analyzer(ANGLE), case.stokes)
    variance = NOISE**2 * np.maximum(shots, 0.02)
    shots = shots + random.normal(size=shots.shape) * np.sqrt(variance)
    radiance = AngleStack(
        value=shots.astype(np.float32), variance=variance.astype(np.float32),
        quality=np.zeros(shots.shape[:3], np.uint8), angle=ANGLE, view=scenes.VIEW,
        bracket=single_frames(3),
    )  # fmt: skip
    object_ = ObjectMask(case.mask, (0, 0, case.mask.shape[1], case.mask.shape[0]), "user")
    return stokes.solve(radiance, scenes.still(), scenes.equal(), object_, stokes.StokesSettings())


def _findings(image: Any) -> dict[str, str]:
    seen = cues.compute(image, scenes.no_color())
    maps = infer.estimate(seen, networks()[0], onnx.run, infer.InferSettings(symmetries=1, fine=False))
    results: Any = SimpleNamespace(
        stokes=image, radiance=scenes.stack(), selfcal=scenes.equal(), object_=scenes.ball_object(), maps=maps,
        cues=seen, color=scenes.no_color(),
    )  # fmt: skip
    found: Any = full_size(results, (0.0, 0.0))
    lines = [
        *polarization.polarized(found),
        *polarization.of_outline(found, GateLimits()),
        polarization.ill_posed(found, GateLimits()),
    ]
    return {line.name: line.message for line in lines if line.state in ("fail", "warn")}


def _dressed(material: Any, albedo: float | None, rough: float | None) -> Any:
    if albedo is None:
        material = msgspec.structs.replace(material, first=(0.85, 0.85, 0.83), second=(0.75, 0.75, 0.74))
    elif albedo != 1:
        first, second = (tuple(albedo * c for c in color) for color in (material.first, material.second))
        material = msgspec.structs.replace(material, first=first, second=second)
    return material if rough is None else msgspec.structs.replace(material, roughness=(rough, rough))


def _probe(seed: int, turn: float) -> Floats:
    """A light probe (64, 128, 3) of mean 1, latitude down and longitude across, turned about the vertical."""
    files = sorted((data() / "environments").glob("*.hdr"))
    picture = np.asarray(cv2.imread(str(files[seed % len(files)]), cv2.IMREAD_UNCHANGED))[..., ::-1]
    small = cv2.resize(np.minimum(picture, np.percentile(picture, 99.9)), (128, 64), interpolation=cv2.INTER_AREA)
    return np.roll(small / small.mean(), int(turn / (2 * np.pi) * 128), 1)


def _around(buffer: ObjectBuffer, coat: Any, probe: Floats, metal: complex | None) -> Floats:
    """Stokes parameters (3, H, W, 3) under the probe: mirrored light, spread by one lobe, and body light."""
    normal = buffer.normal.astype(np.float64)
    diffuse, specular, roughness, ior = scene_materials.evaluate(coat, buffer.position, buffer.facing)
    cosine = np.clip(normal[..., 2], 0.02, 1)
    mirrored = 2 * cosine[..., None] * normal - np.array([0.0, 0.0, 1.0])
    alpha = float(np.mean(roughness[buffer.mask])) ** 2
    light = _seen(_spread(probe, np.arctan(alpha)), mirrored)
    if metal is None:
        plus, minus = fresnel.reflection(cosine, ior)
        gloss = specular / fresnel.normal_reflectance(ior)[..., None]
        out_plus, out_minus = fresnel.transmission(cosine, ior)
        body = diffuse * _seen(_spread(probe, np.radians(50)), normal)  # a cosine lobe, nearly
    else:
        plus, minus = _conductor(cosine, metal)
        gloss, body, out_plus, out_minus = np.ones(3), np.zeros(3), 0 * cosine, 0 * cosine
    azimuth = np.arctan2(normal[..., 1], normal[..., 0])
    waves = (np.ones_like(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth))
    parts = ((out_plus, plus), (out_minus, -minus), (out_minus, -minus))
    return np.stack(
        [wave[..., None] * (body * d[..., None] + gloss * light * s[..., None]) for wave, (d, s) in zip(waves, parts)]
    )


def _conductor(cosine: Floats, index: complex) -> tuple[Floats, Floats]:
    """R₊ and R₋ of a metal of complex index."""
    inner = np.sqrt(index**2 - 1 + cosine**2 + 0j)
    s = np.abs((cosine - inner) / (cosine + inner)) ** 2
    p = np.abs((index**2 * cosine - inner) / (index**2 * cosine + inner)) ** 2
    return (s + p) / 2, (s - p) / 2


def _spread(probe: Floats, sigma: float) -> Floats:
    """The probe blurred by 1σ rad; longitudes close, poles are taken as they are drawn."""
    width = probe.shape[1]
    round_ = np.concatenate([probe, probe, probe], axis=1)
    pixels = max(float(sigma) * width / (2 * np.pi), 0.5)
    return np.asarray(cv2.GaussianBlur(round_.astype(np.float32), (0, 0), pixels)[:, width : 2 * width])


def _seen(probe: Floats, direction: Floats) -> Floats:
    """The probe's radiance (H, W, 3) in directions (H, W, 3), y up."""
    height, width = probe.shape[:2]
    row = np.arccos(np.clip(direction[..., 1], -1, 1)) / np.pi * height - 0.5
    column = (np.arctan2(direction[..., 0], direction[..., 2]) / (2 * np.pi) % 1) * width - 0.5
    at = column.astype(np.float32), row.astype(np.float32)
    return np.asarray(cv2.remap(probe.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def _normal_error(ratio: Any, normal: Floats, mask: NDArray[np.bool_]) -> float:
    """Median angle [degrees] between true normals and zenith by DoLP (n = 1.5), azimuth by AoLP, half-turns known."""
    cosine = fresnel.cos_zenith_from_dolp(np.minimum(np.abs(ratio), 0.38), 1.5)
    sine, phi = np.sqrt(1 - cosine**2), np.angle(ratio) / 2
    side = np.abs(sine * (np.cos(phi) * normal[..., 0] + np.sin(phi) * normal[..., 1]))
    error = np.degrees(np.arccos(np.clip(side + cosine * normal[..., 2], -1, 1)))
    return float(np.median(error[mask]))


def draw(file: Path) -> None:
    """One object under four lights: what is seen, its normalised Stokes map, and where polarization lies across."""
    strips = []
    for light in ("flash", "off-axis flash", "flash and around", "around"):
        case = lit(1, light)
        image = solved(case, 1).stokes.sum(-1)
        length = np.maximum(np.hypot(image[1], image[2]), 1e-9)
        seen = np.clip(image[0] / np.percentile(image[0][case.mask], 98), 0, 1) ** (1 / 2.2)
        field = np.stack([0 * length, image[1] / length, image[2] / length], -1) / 2 + 0.5
        azimuth = np.arctan2(case.normal[..., 1], case.normal[..., 0])
        along = np.cos(np.arctan2(image[2], image[1]) - 2 * azimuth)
        lies = np.stack(
            [np.where(along < 0, 0.9, 0.2), np.where(along < 0, 0.3, 0.6), np.where(along < 0, 0.1, 0.8)], -1
        )
        inside = case.mask[..., None]
        rows, columns = (np.flatnonzero(case.mask.any(axis)) for axis in (1, 0))
        box = np.s_[rows[0] - 6 : rows[-1] + 7, columns[0] - 6 : columns[-1] + 7]
        parts = [np.where(inside, part, 0.12)[box] for part in (seen[..., None] * np.ones(3), field, lies)]
        strips.append(np.concatenate(parts))
    picture = np.round(255 * np.concatenate(strips, axis=1)).astype(np.uint8)
    png.write(file, picture.repeat(2, 0).repeat(2, 1))


if __name__ == "__main__":
    main()
