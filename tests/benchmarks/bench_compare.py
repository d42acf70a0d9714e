"""Which changes `polcap report --compare` finds in twelve simulated pairs before and after.

    python tests/benchmarks/bench_compare.py FOLDER

Two objects, six pairs each: other noise only, a stain, a scratch, a new varnish on one half, the camera moved, another
focal length. In one pair of each of the last two the object has a stain, too. Prints a line per pair.
"""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import numpy as np
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

import polcap
from polcap import report
from polcap.image_values import Floats
from polcap.report import compare
from polcap.synth import scene_materials, scenes, shooting
from polcap.synth.render import Scene
from polcap.synth.shooting import Shoot

SHOOT = Shoot(width=768, height=576, exposures=2, samples=1)
OBJECTS: dict[scenes.Kind, int] = {"bumps": 5, "vase": 3}  # kind and seed
MOVE_M, ORBIT_DEG = np.array([0.012, -0.008, 0.03]), 4.0
FOCAL_MM = 75.0
_evaluate, _relief = scene_materials.evaluate, scene_materials.add_relief
Material = tuple[Floats, Floats, Floats, Floats]


def front(scene: Scene) -> Floats:
    """The direction of the camera from the object's middle, in the object's frame (3,)."""
    toward = -np.array(scene.position)
    return np.asarray(scene.turn.inv().apply(toward / np.linalg.norm(toward)))


def sides(scene: Scene) -> tuple[Floats, Floats]:
    """Picture right and up in the object's frame."""
    right, up = scene.turn.inv().apply([[1.0, 0, 0], [0, 1.0, 0]])
    return right, up


def stain(scene: Scene) -> Callable[..., Material]:
    """A brown stain of 10 mm radius, right of the middle of the front."""
    right, up = sides(scene)

    def evaluate(coat: scene_materials.Coat, position: Floats, facing: Floats) -> Material:
        diffuse, f0, roughness, ior = _evaluate(coat, position, facing)
        away = np.hypot(position @ right - 0.015, position @ up - 0.01)
        share = np.clip((0.011 - away) / 0.002, 0, 1)[..., None] * (position @ front(scene) > 0)[..., None]
        return diffuse * (1 - share * np.array([0.3, 0.45, 0.6])), f0, roughness, ior

    return evaluate


def varnish(scene: Scene) -> Callable[..., Material]:
    """The right half is smoother."""
    right, _ = sides(scene)

    def evaluate(coat: scene_materials.Coat, position: Floats, facing: Floats) -> Material:
        diffuse, f0, roughness, ior = _evaluate(coat, position, facing)
        share = np.clip(position @ right / 0.004, 0, 1)
        return diffuse, f0, roughness * (1 - 0.45 * share), ior

    return evaluate


def scratch(scene: Scene) -> Callable[..., Floats]:
    """A groove 6 mm wide and 40 mm long, up to 45° steep, across the front."""
    right, up = sides(scene)

    def relief(coat: scene_materials.Coat, position: Floats, facing: Floats) -> Floats:
        facing = _relief(coat, position, facing)
        along, across = position @ (right + up) / np.sqrt(2), position @ (right - up) / np.sqrt(2)
        inside = (np.abs(along) < 0.02) & (np.abs(across) < 0.003) & (position @ front(scene) > 0)
        slope = np.where(inside, np.tan(np.radians(45)) * np.sin(np.pi * across / 0.003), 0)
        bent = facing - slope[..., None] * ((right - up) / np.sqrt(2))
        return np.asarray(bent / np.linalg.norm(bent, axis=-1, keepdims=True))

    return relief


def moved(scene: Scene) -> Scene:
    """The object as a camera sees it that went around and nearer."""
    turn = Rotation.from_euler("y", ORBIT_DEG, degrees=True) * scene.turn
    position = tuple(float(x) for x in np.array(scene.position) + MOVE_M)
    return replace(scene, position=position, turn_deg=tuple(turn.as_rotvec(degrees=True).tolist()))


def pairs(scene: Scene, first: bool) -> dict[str, tuple[Scene, Shoot, str]]:
    """Name of each second capture of an object: its scene, camera and change."""
    longer = replace(SHOOT, focal_mm=FOCAL_MM, seed=2)
    again = replace(SHOOT, seed=2)
    return {
        "nothing": (scene, again, ""),
        "stain": (scene, again, "stain"),
        "scratch": (scene, again, "scratch"),
        "varnish": (scene, again, "varnish"),
        "moved": (moved(scene), again, "" if first else "stain"),
        "focal": (scene, longer, "stain" if first else ""),
    }


def result(folder: Path, scene: Scene, shoot: Shoot, change: str, base: Scene) -> Path:
    """The result folder of a simulated capture, made where it is missing."""
    if not (folder / "polcap" / "report.json").exists():
        with ExitStack() as patches:
            if change == "scratch":
                patches.enter_context(patch.object(scene_materials, "add_relief", scratch(base)))
            elif change:
                made = stain(base) if change == "stain" else varnish(base)
                patches.enter_context(patch.object(scene_materials, "evaluate", made))
            shooting.write(folder, scene, shoot)
        polcap.process(folder)
    return folder / "polcap"


def main(folder: Path) -> None:
    """Make the pairs, compare them, and print what was found."""
    for number, (kind, seed) in enumerate(OBJECTS.items()):
        scene = scenes.random_scene(seed, kind)
        before = result(folder / kind / "before", scene, SHOOT, "", scene)
        for name, (other, shoot, change) in pairs(scene, number == 0).items():
            after = result(folder / kind / name, other, shoot, change, scene)
            if "--render" in sys.argv:
                continue
            abouts = report.read(before), report.read(after)
            sentence, _ = compare.write(after / "compare.html", (before, after), abouts)
            print(f"{kind:8}{name:10}{change or 'nothing':10}{sentence}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
