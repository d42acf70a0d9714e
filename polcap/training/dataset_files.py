"""Data set files, `polcap synth --dataset`: photographs of random objects at four polarizer angles, and the truth.

::

    FOLDER/dataset.json               the settings, and the encoding of all files
    FOLDER/000000/I000.png … I135.png  light behind a polarizer at 0, 45, 90, 135°, with noise
                  stokes.png          (S1, S2)/√(S1² + S2²), from the noisy photographs
                  diffuse_color.png   ½(S0 − √(S1² + S2²)) per channel, unit length
                  normal.png depth.png diffuse.png specular.png roughness.png mask.png
                  sample.json         camera, flash, depth's limits

A sample is determined by the seed and its number. Its folder appears when it is complete, so a stopped run can
continue, and a run with a larger number adds samples.

References
----------
Deschaintre, Lin, Ghosh, Deep Polarization Imaging for 3D Shape and SVBRDF Acquisition, CVPR 2021, §4.
"""

from math import log1p
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from msgspec import Meta

from polcap.errors import InputError
from polcap.formats import atomic, text_file
from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import frames, mueller
from polcap.optics.mesh_tracer import Tracer, centred
from polcap.stages import cues
from polcap.training import materials, random_shapes, traced_views
from polcap.training.progress import Report, silent

ANGLES_DEG = (0, 45, 90, 135)
_LARGEST, _KNEE = 16.0, 0.01  # HDR encoding: radiance at 65535, and the limit between linear and logarithmic parts


class DatasetRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a data set, common to all its samples."""

    seed: int = 0
    size: Annotated[int, Meta(ge=64, le=4096)] = 512  # px
    noise: Annotated[float, Meta(ge=0)] = 0.002  # 1σ at radiance 1; ∝ √radiance, in the dark a tenth
    mesh: str = ""  # file or folder of files; empty: random shapes
    material: str = ""  # folder of texture sets; empty: solid noise
    law: Literal["smooth", "rough"] = "smooth"  # interface of diffuse light


def main(out: Path, count: int, recipe: DatasetRecipe, report: Report = silent) -> int:
    """Make the samples 0…count − 1 that the folder lacks; returns the number of new samples."""
    library, files = _open_library(recipe.material), _list_meshes(recipe.mesh)
    _write_description(out, recipe)
    made = 0
    for number in range(count):
        place = out / f"{number:06d}"
        if place.exists():
            continue
        with atomic.new_folder(place) as folder:
            _write_sample(folder, recipe, library, files, number)
        made += 1
        report(f"{number + 1} of {count} samples")
    return made


def _write_sample(
    folder: Path, recipe: DatasetRecipe, library: materials.MaterialLibrary, files: list[Path], number: int
) -> None:
    """Simulate one object and write its pictures and sample.json; without mesh `files` its shape is random."""
    rng = np.random.default_rng([recipe.seed, number])
    file = files[rng.integers(len(files))] if files else None
    mesh = centred(traced_views.read_mesh(file)) if file else random_shapes.compose(rng)
    buffer, turn, _ = traced_views.trace_random_view(str(file or "a random shape"), Tracer(mesh), recipe.size, rng)
    mask, view = buffer.mask, buffer.view
    middle, unit = traced_views.depth_unit(mask, buffer.depth, view.focal)
    images = frames.rays(view, *mask.shape), buffer.normal, buffer.position, buffer.depth
    v, unbumped, position, depth = (torch.from_numpy(image[mask]) for image in images)
    with torch.random.fork_rng():
        torch.manual_seed(int(rng.integers(1 << 62)))
        owner, smooth = torch.zeros(len(v), dtype=torch.long), float(recipe.law == "smooth")
        turns = torch.from_numpy(turn).float()[None]
        surface = materials.draw_surface(library, unbumped, position, turns, owner, smooth)
    flash = [middle * offset for offset in (*traced_views.random_flash(rng), 0.0)]
    to_light = torch.tensor(flash, dtype=torch.float32) + v * (depth / v[:, 2])[:, None]
    normal, diffuse, specular = materials.reflect(surface, v, to_light, torch.full((len(v),), middle**2))
    photographs = _photograph((diffuse + specular).numpy(), v.numpy(), recipe.noise, rng)
    i0, i45, i90, i135 = photographs
    stokes = np.stack([photographs.sum(axis=0) / 2, i0 - i90, i45 - i135])
    cos, sin = cues.polarization(stokes, np.zeros((6, *stokes.shape[1:])))[3]
    near, far = float(depth.min()), float(depth.max())
    pictures = {
        **{f"I{angle:03d}": encode(picture) for angle, picture in zip(ANGLES_DEG, photographs)},
        "stokes": np.stack([0 * cos, cos, sin], axis=1) / 2 + 0.5,  # S0's slot first, as in the paper
        "diffuse_color": cues.least_intensity_color(stokes, np.eye(3)),
        "normal": frames.from_ray_frame(normal, v).numpy() / 2 + 0.5,
        "depth": (depth.numpy() - near) / max(far - near, 1e-9),
        "diffuse": surface.diffuse.numpy(),
        "specular": surface.specular.numpy(),
        "roughness": surface.roughness.numpy(),
    }
    for name, value in pictures.items():
        png.write(folder / f"{name}.png", png.sixteen_bits(traced_views.fill(mask, value)))
    png.write(folder / "mask.png", np.where(mask, 255, 0).astype(np.uint8))
    facts = {
        "focal_px": view.focal, "center_px": view.center, "flash": flash, "depth": {"near": near, "far": far},
        "middle": middle, "depth_unit": unit, "ior": float(surface.ior.mean()),
    }  # fmt: skip
    atomic.write_json(folder / "sample.json", facts, synced=False)  # the whole folder is synced


def encode(radiance: Floats) -> Floats:
    """Encode linear radiance for a picture file as 0…1: ln(1 + x/k)/ln(1 + m/k), m = 16, k = 0.01; clipped."""
    return np.asarray(np.log1p(np.clip(radiance, 0, _LARGEST) / _KNEE) / log1p(_LARGEST / _KNEE))


def _open_library(material: str) -> materials.MaterialLibrary:
    """Texture sets of a folder. Raises InputError: it holds none."""
    library = materials.MaterialLibrary(Path(material) if material else None, torch.device("cpu"))
    if material and not library.has_textures:
        raise InputError(f"{material} holds no texture set; give a folder of folders, each with albedo.jpg")
    return library


def _list_meshes(mesh: str) -> list[Path]:
    """Mesh files that the setting `mesh` names; an empty list means random shapes."""
    place = Path(mesh)
    if not mesh or not place.is_dir():
        return [place] if mesh else []
    files = sorted(p for p in place.iterdir() if p.suffix != ".json")
    if not files:
        raise InputError(f"{place} holds no mesh; give a mesh file or a folder of mesh files")
    return files


def _photograph(light: Floats, rays: Floats, noise: float, rng: np.random.Generator) -> Floats:
    """Simulate photographs (4, M, 3) through an ideal polarizer at 0, 45, 90 and 135°, with photon and read noise.

    `light` (3, M, 3) are S0, S1 and S2 of three colors, in the frames of the view rays `rays` (M, 3). `noise` is the 1σ
    of light 1; that of darkness is a tenth of it.
    """
    photographs = []
    for angle in np.radians(ANGLES_DEG):
        weights = mueller.analyzer(frames.axis_on_ray(np.asarray(angle), rays), np.inf)
        passed = np.einsum("ms,smc->mc", weights, light)
        sigma = noise * np.hypot(np.sqrt(np.maximum(passed, 0)), 0.1)
        photographs.append(passed + sigma * rng.normal(size=passed.shape))
    return np.stack(photographs)


def _write_description(out: Path, recipe: DatasetRecipe) -> None:
    """Write dataset.json. Raises InputError if the folder already holds samples of other settings, or other files."""
    asked, file = msgspec.to_builtins(recipe), out / "dataset.json"
    if file.exists():
        there = text_file.read_json(file)["recipe"]
        if there != asked:
            raise InputError(f"{out} was started with the settings {there}, not {asked}; choose another folder")
        return
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; choose another folder for the data set")
    decoding = f"x = {_KNEE} * expm1(value / 65535 * ln(1 + {_LARGEST} / {_KNEE}))"
    document = {
        "format": "polcap dataset 1",
        "recipe": asked,
        "frame": "camera: x right, y up, z toward the camera; row 0 on top; pixel centers at integers",
        "angles": "polarizer axis from image x toward image up, degrees; projected across each ray off axis",
        "unit": "the longest side of the object",
        "light": "one flash, in the camera frame (sample.json), with inverse-square fall-off; "
        "radiance 1: S0 of a white matt plane facing it at the object's middle depth; no interreflection",
        "files": {
            "I000.png … I135.png": f"HDR, 16 bit RGB, linear Rec.709 radiance {decoding}",
            "stokes.png": "16 bit: R 0.5; G, B (S1, S2)/√(S1² + S2²) * 0.5 + 0.5, from the photographs",
            "diffuse_color.png": "16 bit RGB: least intensity of each pixel's sinusoid, unit length",
            "normal.png": "16 bit: n * 0.5 + 0.5, camera frame",
            "depth.png": "16 bit: (depth − near)/(far − near) of sample.json, along the optical axis, growing away",
            "diffuse.png, specular.png": "16 bit RGB, linear: diffuse albedo; F0",
            "roughness.png": "16 bit, linear: perceptual roughness, GGX alpha = roughness²",
            "mask.png": "8 bit, 255 on the object; elsewhere every picture is 0",
        },
    }
    atomic.write_json(file, document)
