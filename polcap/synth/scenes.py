"""Random synthetic scenes from a seed: bumps, clusters of balls, vases, one ball, or a mesh from a file."""

import colorsys
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from polcap.errors import SettingError
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Bumps, Cluster, Model, Shape, Vase, Wave
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Color, Material

Kind = Literal["bumps", "clusters", "vase", "ball"]


def random_scene(seed: int, kind: Kind) -> Scene:
    """A random scene: object 0.1 to 0.17 m wide at 0.7 m, next to a chart, under a flash 4 to 7 cm above the lens.

    A ball has one color. The one or two materials are dielectrics of roughness 0.3–0.6 and refractive index 1.4–1.6.

    Raises SettingError for an unknown kind.
    """
    if kind not in get_args(Kind):
        raise SettingError(f'there is no scene "{kind}"; choose one of {", ".join(get_args(Kind))}')
    random = np.random.default_rng([seed, get_args(Kind).index(kind)])
    shape = {"bumps": _bumps, "clusters": _cluster, "vase": _vase, "ball": _ball}[kind](random)
    ior = random.uniform(1.4, 1.6)
    materials = tuple(_material(random, ior) for _ in range(random.integers(1, 3)))
    if kind == "ball":
        materials = (msgspec.structs.replace(materials[0], second=materials[0].first),)
    turn = random.uniform(-1, 1, 3) * ((15, 180, 8) if kind == "vase" else (180, 180, 180))
    return Scene(
        shape=shape,
        coat=Coat(materials, region_size=_rounded(random.uniform(0.05, 0.1)), seed=seed),
        position=(-0.085, _rounded(random.uniform(-0.01, 0.01)), _rounded(random.uniform(-0.74, -0.70))),
        turn_deg=_vector(turn),
        light=_vector(random.uniform((-0.02, 0.04, -0.01), (0.02, 0.07, 0.01))),
        chart=Chart(
            center=_vector(random.uniform((0.105, -0.05, -0.71), (0.12, 0.05, -0.68))),
            turn_deg=_vector(random.uniform(-1, 1, 3) * (6, 6, 3)),
        ),
    )


def with_model(scene: Scene, file: Path, seed: int) -> Scene:
    """A copy of the scene with a mesh as its object, in a random orientation, with cast shadows."""
    turn = np.random.default_rng([seed, 0x3E54]).normal(size=4)
    vector = _vector(Rotation.from_quat(turn).as_rotvec(degrees=True))
    model = Model(str(file), radius=0.08)
    return msgspec.structs.replace(scene, shape=model, turn_deg=vector, cast_shadows=True)


def with_textures(scene: Scene, folder: Path) -> Scene:
    """A copy of the scene with a texture set as its only material."""
    material = scene.coat.materials[0]
    textured = msgspec.structs.replace(
        material, first=(1.0, 1.0, 1.0), second=(1.0, 1.0, 1.0), size=0.1, roughness=(0.0, 1.0), texture=str(folder)
    )
    return msgspec.structs.replace(scene, coat=Coat((textured,)))


def _bumps(random: np.random.Generator) -> Shape:
    count = int(random.integers(5, 9))
    size = _vector(random.uniform(0.055, 0.072, 3))
    return Bumps(size, _random_waves(random, count, 0.22 / count, 4.5))


def _cluster(random: np.random.Generator) -> Shape:
    balls = [np.array([0, 0, 0, random.uniform(0.034, 0.044)])]
    while len(balls) < 4 + random.integers(0, 5):
        radius = random.uniform(0.02, 0.036)
        neighbor = balls[random.integers(len(balls))]
        direction = random.normal(size=3)
        center = neighbor[:3] + direction / np.linalg.norm(direction) * 0.85 * (neighbor[3] + radius)
        if np.linalg.norm(center) + radius < 0.085:
            balls.append(np.array([*center, radius]))
    return Cluster(tuple((_rounded(x), _rounded(y), _rounded(z), _rounded(r)) for x, y, z, r in balls))


def _ball(random: np.random.Generator) -> Shape:
    return Cluster(((0.0, 0.0, 0.0, _rounded(random.uniform(0.045, 0.06))),))


def _vase(random: np.random.Generator) -> Shape:
    foot, belly, neck, lip = random.uniform((0.024, 0.05, 0.02, 0.026), (0.036, 0.064, 0.03, 0.04))
    at = random.uniform(0.35, 0.55)
    profile = ((0.0, foot), (at, belly), (0.84, neck), (1.0, lip))
    return Vase(
        height=_rounded(random.uniform(0.13, 0.16)),
        profile=tuple((_rounded(h), _rounded(r)) for h, r in profile),
        lobes=int(random.integers(5, 12)),
        depth=_rounded(random.uniform(0.0, 0.05)),
        waves=_random_waves(random, 6, 0.0008, 110.0),
    )


def _random_waves(random: np.random.Generator, count: int, amplitude: float, number: float) -> tuple[Wave, ...]:
    """Sine waves of random direction, with about this amplitude and wave number [rad/unit]."""
    waves = []
    for _ in range(count):
        direction = random.normal(size=3)
        x, y, z = _vector(direction / np.linalg.norm(direction) * number * random.uniform(0.6, 1.3))
        waves.append((_rounded(amplitude * random.uniform(0.6, 1.4)), x, y, z, _rounded(random.uniform(0, 2 * np.pi))))
    return tuple(waves)


def _material(random: np.random.Generator, ior: float) -> Material:
    a, b = np.sort(random.uniform(0.3, 0.6, 2))
    return Material(
        first=_color(random),
        second=_color(random),
        pattern=("noise", "chequer", "veins")[random.integers(3)],
        size=_rounded(random.uniform(0.012, 0.03)),
        roughness=(_rounded(a), _rounded(b)),
        specular=_rounded(random.uniform(0.7, 1.2)),
        ior=_rounded(ior),
        seed=int(random.integers(1 << 30)),
    )


def _color(random: np.random.Generator) -> Color:
    return _vector(np.array(colorsys.hsv_to_rgb(random.uniform(), random.uniform(0.2, 0.7), random.uniform(0.25, 0.8))))


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (_rounded(v) for v in values)
    return x, y, z


def _rounded(value: float) -> float:
    return round(float(value), 6)
