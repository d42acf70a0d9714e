"""Which term of a renderer's material model parts its picture from polcap's, by how much: no renderer is needed.

python tests/benchmarks/bench_look_terms.py

The scene of `bench_look.py`: a ball of two paints, varying roughness and F0, ripples, three suns. From polcap's own law
(`optics/shade.py`) one term after the other is exchanged for glTF's, then for three.js's; a row says what that one
exchange changes, and what all of them up to it have changed, of the 99th percentile of polcap's picture: median and
95th percentile over the pixels that face camera and light within 45°, and over the others.

References
----------
Khronos, glTF 2.0 §B.3. three.js r183, `lights_physical_pars_fragment`. Heitz, Understanding the masking-shadowing
function, JCGT 2014 (height-correlated Smith). Karis, Physically based shading on mobile, 2014 (its environment term).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from bench_look import LIGHTS, cosine, inner, own, varied

from polcap.images import Floats, SurfaceMaps
from polcap.optics import brdf, frames, fresnel

IOR = 1.5


@dataclass(frozen=True)
class Model:
    """A material model by its terms; each takes a `Scene`."""

    body: Callable[["Scene"], Floats]
    reflectance: Callable[["Scene"], Floats]
    masking: Callable[["Scene"], Floats]
    beyond: Callable[["Scene"], Floats]  # factor on the gloss: light that facets scatter again


@dataclass(frozen=True)
class Scene:
    """Cosines and maps of every pixel, (H, W) or (H, W, 3)."""

    maps: SurfaceMaps
    light: Floats  # n·l
    eye: Floats  # n·v
    half: Floats  # n·h
    between: Floats  # v·h

    @property
    def alpha(self) -> Floats:
        return np.asarray(self.maps.roughness**2)

    @property
    def base(self) -> Floats:
        """As the asset holds it, unrounded."""
        entry, _ = fresnel.transmission(np.float64(1.0), IOR)
        return np.asarray(self.maps.diffuse * entry**2 / (1 - self.maps.specular.max(axis=-1, keepdims=True)))


def two_transmissions(scene: Scene) -> Floats:
    through = fresnel.transmission(scene.light, IOR)[0] * fresnel.transmission(scene.eye, IOR)[0]
    return np.asarray(scene.maps.diffuse * through[..., None])


def what_is_not_reflected(scene: Scene) -> Floats:
    return np.asarray(scene.base * (1 - schlick(scene).max(axis=-1, keepdims=True)))


def all_of_it(scene: Scene) -> Floats:
    return scene.base


def exact(scene: Scene) -> Floats:
    share = fresnel.reflection(scene.between, IOR)[0] / fresnel.normal_reflectance(IOR)
    return np.asarray(scene.maps.specular * share[..., None])


def schlick(scene: Scene) -> Floats:
    f0 = scene.maps.specular
    return np.asarray(f0 + (1 - f0) * (1 - scene.between[..., None]) ** 5)


def separable(scene: Scene) -> Floats:
    return np.asarray(brdf.smith_masking(scene.light, scene.eye, scene.alpha))


def correlated(scene: Scene) -> Floats:
    a2, light, eye = scene.alpha**2, scene.light, scene.eye
    one = light * np.sqrt(a2 + (1 - a2) * eye**2)
    other = eye * np.sqrt(a2 + (1 - a2) * light**2)
    return np.asarray(2 * light * eye / (one + other))


def once(scene: Scene) -> Floats:
    return np.ones((*scene.light.shape, 1))


def again(scene: Scene) -> Floats:
    """1 + F0 (1/E − 1), E the share of light that facets send back at once where all reflect (Karis' fit)."""
    rough = scene.maps.roughness
    z, w = (a * rough + b for a, b in ((-0.572, 1.04), (0.022, -0.04)))
    sent = z + w  # scale −1.04 a + z and bias 1.04 a + w together: F0 = F90 = 1
    return np.asarray(1 + scene.maps.specular * (1 / np.clip(sent, 0.1, 1.0)[..., None] - 1))


STEPS = (
    ("Fresnel: Schlick for the exact one", {"reflectance": schlick}),
    ("masking: height-correlated for separable", {"masking": correlated}),
    ("body: base (1 − F) for two transmissions", {"body": what_is_not_reflected}),
    ("three.js: base without 1 − F", {"body": all_of_it}),
    ("three.js: scattered again", {"beyond": again}),
)


def shaded(model: Model, scene: Scene) -> Floats:
    """S0 (H, W, 3) under a sun in which a white Lambertian plane has 1."""
    gloss = np.pi * brdf.ggx_distribution(scene.half, scene.alpha) * model.masking(scene) / (4 * scene.eye)
    out = model.body(scene) * scene.light[..., None] + model.reflectance(scene) * gloss[..., None] * model.beyond(scene)
    return np.asarray(np.where((scene.light > 0)[..., None], out, 0))


def main() -> None:
    maps = varied()
    rays = frames.rays(maps.view, *maps.mask.shape)
    print(f"{'light':15}{'exchanged':44}{'within 45°: alone':>18}{'so far':>16}{'others: alone':>18}{'so far':>16}")
    for name, direction in LIGHTS.items():
        to_light = np.array(direction) / np.linalg.norm(direction)
        half = rays + to_light
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        pairs = ((maps.normal, to_light), (maps.normal, rays), (maps.normal, half), (rays, half))
        scene = Scene(maps, *(np.clip(np.sum(a * b, axis=-1), 1e-4, 1) for a, b in pairs))
        scene = replace(scene, light=np.where(maps.normal @ to_light > 0, scene.light, 0))
        model = Model(two_transmissions, exact, separable, once)
        start = before = shaded(model, scene)
        inside = inner(maps, start)
        assert np.abs(start - own(maps, to_light))[inside].max() < 1e-3  # the first model is polcap's
        facing = inside & (np.minimum(cosine(maps, direction), cosine(maps, (0, 0, 1))) > np.sqrt(0.5))
        white = np.percentile(start[inside], 99)
        for says, exchanged in STEPS:
            model = replace(model, **exchanged)
            now = shaded(model, scene)
            told = []
            for where in (facing, inside & ~facing):
                for other in (before, start):
                    off = 100 * np.abs(now - other).max(axis=-1)[where] / white
                    told.append(f"{np.median(off):.1f}, {np.percentile(off, 95):.1f} %")
            print(f"{name:15}{says:44}{told[0]:>18}{told[1]:>16}{told[2]:>18}{told[3]:>16}")
            before = now


if __name__ == "__main__":
    main()
