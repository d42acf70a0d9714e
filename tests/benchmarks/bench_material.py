"""Errors of materials of simulated flat samples against their truth.

python tests/benchmarks/bench_material.py FOLDER [--views 9] [--width 3000] [--samples NAME,…] [--polarization no]
    [--f0 FACTOR]

Most samples have an F0 near the mean of its prior, so that its errors are small; `--f0` multiplies it.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from polcap.cli import app
from polcap.formats.maps import maps_folder
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.synth import flat_views
from polcap.synth.distance_fields import Bumps
from polcap.synth.flat_views import FlatShoot
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Color, Material
from tests.experiments import arguments, peak_mb, rms, timed

_EDGE_M = 0.0015  # of the sample, which is not compared


def _of(
    first: Color, second: Color, pattern: str, size: float, rough: tuple[float, float], specular: float = 1.0
) -> Material:
    return Material(first, second, pattern, size, rough, specular=specular, seed=1)  # type: ignore[arg-type]


# relief [m], size of its features [m], law of diffuse reflection, size of the materials' regions [m], materials
SAMPLES: dict[str, tuple[float, float, str, float, tuple[Material, ...]]] = {
    "matte": (6e-4, 0.008, "rough", 0, (_of((0.6, 0.5, 0.4), (0.4, 0.35, 0.3), "noise", 0.012, (0.7, 0.8)),)),
    "satin": (6e-4, 0.01, "smooth", 0, (_of((0.2, 0.3, 0.5), (0.3, 0.4, 0.6), "noise", 0.015, (0.4, 0.45)),)),
    "gloss": (4e-4, 0.012, "smooth", 0, (_of((0.5, 0.1, 0.08), (0.4, 0.1, 0.06), "noise", 0.02, (0.15, 0.18)),)),
    "mixed": (6e-4, 0.01, "smooth", 0.04, (
        _of((0.5, 0.4, 0.2), (0.55, 0.45, 0.25), "noise", 0.01, (0.6, 0.6)),
        _of((0.15, 0.3, 0.2), (0.1, 0.2, 0.15), "veins", 0.01, (0.25, 0.3), 1.1),
    )),
    "print": (1e-4, 0.006, "smooth", 0, (_of((0.8, 0.8, 0.78), (0.1, 0.1, 0.12), "chequer", 0.009, (0.4, 0.4)),)),
    "fabric": (4e-4, 0.003, "rough", 0, (_of((0.2, 0.1, 0.3), (0.35, 0.15, 0.4), "chequer", 0.003, (0.75, 0.85)),)),
    "wood": (3e-4, 0.006, "rough", 0, (_of((0.35, 0.2, 0.1), (0.5, 0.32, 0.18), "veins", 0.014, (0.5, 0.35)),)),
    "stone": (8e-4, 0.006, "rough", 0, (_of((0.4, 0.4, 0.38), (0.2, 0.2, 0.22), "noise", 0.005, (0.3, 0.5)),)),
    "coin": (1e-3, 0.012, "smooth", 0, (_of((0.4, 0.3, 0.2), (0.3, 0.2, 0.15), "noise", 0.02, (0.35, 0.35), 1.2),)),
    "brush": (8e-4, 0.005, "smooth", 0.03, (
        _of((0.6, 0.5, 0.1), (0.1, 0.2, 0.5), "noise", 0.02, (0.3, 0.35)),
        _of((0.6, 0.15, 0.1), (0.7, 0.6, 0.5), "noise", 0.015, (0.35, 0.4)),
    )),
    "leather": (5e-4, 0.005, "rough", 0, (_of((0.12, 0.07, 0.04), (0.2, 0.1, 0.06), "veins", 0.006, (0.45, 0.5)),)),
    "paper": (2e-4, 0.004, "rough", 0, (_of((0.75, 0.7, 0.65), (0.7, 0.66, 0.6), "noise", 0.01, (0.8, 0.85), 0.9),)),
}  # fmt: skip


def scene(name: str, f0: float = 1.0) -> tuple[Scene, FlatShoot]:
    """Scene and sample of a name, with its F0 times a factor."""
    relief, feature, law, region, parts = SAMPLES[name]
    parts = tuple(msgspec.structs.replace(part, specular=part.specular * f0) for part in parts)
    shoot = FlatShoot(relief_m=relief, feature_m=feature, seed=list(SAMPLES).index(name))
    made = Scene(Bumps((0.01, 0.01, 0.01), ()), Coat(parts, region or 0.08, seed=5), light=(0.01, 0.05, 0.0))
    return (msgspec.structs.replace(made, law="rough") if law == "rough" else made), shoot


def errors(folder: Path, out: str = "material") -> dict[str, Any]:
    """Errors of a session's material against its truth.json and truth.npz: rms, of normals the mean [°].

    `height` is over the range of the relief, after a plane is taken out; `score_…` are errors over the stated 1σ.
    """
    about = json.loads((folder / "truth.json").read_text())
    place = folder / out / "maps"
    stored = json.loads((place / "maps.json").read_text())
    size, texel = tuple(stored["size"]), stored["texel_m"]

    def read(name: str, letters: str) -> Floats:
        return maps_folder.read_map(place, name, letters, size)

    x = stored["origin_m"][0] + texel * np.arange(size[0])
    z = stored["origin_m"][1] + texel * np.arange(size[1])
    x, z = np.meshgrid(x, z)
    with np.load(folder / "truth.npz") as truth:
        true = {name: _sampled(truth[name], x, z, about["side_m"], texel) for name in truth.files}
        span = float(np.ptp(truth["height"]))
    inside = np.maximum(abs(x), abs(z)) < about["side_m"] / 2 - _EDGE_M
    true["normal"] = frames.unit(true["normal"])
    angle = frames.angle_deg(true["normal"], read("normal", "RGB"))[inside]
    difference = {
        "albedo": read("diffuse", "RGB") - true["diffuse"],
        "roughness": read("roughness", "Y") - true["roughness"],
        "f0": read("specular", "RGB")[..., 0] - true["specular"][..., 0],
    }
    sigma = {"albedo": "diffuse_sigma", "roughness": "roughness_sigma", "f0": "specular_sigma"}
    height = (read("height", "Y") - true["height"])[inside]
    terms = np.stack([x[inside], z[inside], np.ones(inside.sum())], axis=-1)
    left = height - terms @ np.linalg.lstsq(terms, height, rcond=None)[0]
    found: dict[str, Any] = {
        "normal": float(angle.mean()),
        "flat": float(np.degrees(np.arccos(np.clip(true["normal"][inside][:, 2], -1, 1))).mean()),
        "height": float(left.std() / span),
        "score_normal": rms(angle) / rms(read("normal_sigma", "Y")[inside]),
    }
    for name, value in difference.items():
        found[name] = rms(value[inside])
        found[f"bias_{name}"] = float(value[inside].mean())
        error = value.mean(axis=-1) if value.ndim == 3 else value
        found[f"score_{name}"] = rms((error / read(sigma[name], "Y"))[inside])
    return found


def _sampled(value: Floats, x: Floats, z: Floats, side: float, texel: float) -> Floats:
    """A true map at points x, z (H, W) [m], blurred like texels of that size [m]."""
    count = value.shape[0]
    smooth = cv2.GaussianBlur(value, (0, 0), max(0.3, 0.4 * texel * count / side))
    across, down = (((a / side + 0.5) * count - 0.5).astype(np.float32) for a in (x, z))
    return np.asarray(cv2.remap(smooth, across, down, cv2.INTER_LINEAR))


def main() -> None:
    usual = {"views": 9, "width": 1500, "samples": ",".join(SAMPLES), "rays": 1, "exposures": 1, "f0": 1.0}
    options = arguments(__doc__, "folder", polarization=("yes", "no"), **usual)
    for name in options.samples.split(","):
        made, shoot = scene(name, options.f0)
        height = options.width * 2 // 3 // 2 * 2
        how = {"width": options.width, "height": height, "samples": options.rays, "exposures": options.exposures}
        suffix = "" if options.f0 == 1 else f"-f0-{options.f0:g}"
        session = options.folder / f"{name}-{options.views}-{options.width}{suffix}"
        if not session.exists():
            flat_views.write(session, made, msgspec.structs.replace(shoot, **how), options.views)
        out = "material" if options.polarization == "yes" else "without"
        more = [] if options.polarization == "yes" else ["--set", "material.gloss.fitting.polarization_error=1"]
        words = ["-q", "material", str(session), "--out", str(session / out), *more]
        _, seconds = timed(partial(app, words, standalone_mode=False))
        figures = {key: round(value, 4) for key, value in errors(session, out).items()}
        figures |= {"cpu_s": round(seconds), "gb": round(peak_mb() / 1000, 2)}
        print(name, json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
