"""Benchmark of the object's mask: overlap with the true mask on 60 scenes of meshes not used in training.

    python -m tests.benchmarks.bench_mask OUT calib/models/mask.onnx

Scenes are stored in OUT/scenes; OUT/mask.json holds every IoU, OUT/NAME.png outlines for a person to look at.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polcap.chart_values import ChartPlace, ColorCalibration
from polcap.errors import ObjectError
from polcap.formats import onnx
from polcap.image_values import Floats, View
from polcap.optics import mueller
from polcap.optics.mesh_tracer import Tracer, Triangles, centred
from polcap.stage_values import Alignment, AngleStack, Network, ObjectMask, single_frames
from polcap.stages import mask
from polcap.stages.mask.mask_channels import ENCODING
from polcap.training import mask_scenes, mask_views, materials, traced_views
from polcap.training.mask_views import ViewKind
from tests.experiments import arguments, data, overlap

SIZE = (360, 480)
NEAR, FAR = (0.0, 0.12), (0.3, 0.7)  # flash from the lens [object distances]
DIFFICULTIES: dict[str, tuple[ViewKind, mask_scenes.Mode, float]] = {  # view, materials, how likely the chart touches
    "dark backdrop": (ViewKind("whole", "wall", NEAR), "dark", 0.0),
    "black gloss on black cloth": (ViewKind("whole", "cloth", NEAR), "black", 0.0),
    "white on white": (ViewKind("whole", "table", NEAR), "white", 0.0),
    "deep shadow": (ViewKind("whole", "wall", FAR), "shadow", 0.0),
    "patterned backdrop": (ViewKind("whole", "table", NEAR), "printed", 0.0),
    "chart touching": (ViewKind("whole", "wall", NEAR), "any", 1.0),
    "cut by the frame": (ViewKind("cut", "wall", NEAR), "dark", 0.0),
    "several parts": (ViewKind("whole", "table", NEAR), "any", 0.0),
    "backdrop's color": (ViewKind("whole", "cloth", NEAR), "alike", 0.0),
    "fills the frame": (ViewKind("full", "wall", NEAR), "any", 0.0),
}


@dataclass(frozen=True)
class Case:
    """A capture as the stage gets it, and the truth."""

    name: str
    radiance: AngleStack
    color: ColorCalibration
    alignment: Alignment
    truth: NDArray[np.bool_]  # (H, W)


def cases(source: Path, folder: Path) -> Iterator[Case]:
    """The sixty scenes, made once and stored in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    files = sorted((source / "meshes" / "test").glob("*.npz"))
    library = materials.MaterialLibrary(source / "materials" / "test", torch.device("cpu"))
    meshes = {file.stem: centred(traced_views.read_mesh(file)) for file in files}
    for number, difficulty in enumerate(DIFFICULTIES):
        for own, (stem, mesh) in enumerate(meshes.items()):
            rng = np.random.default_rng([77, number, own])
            file = folder / f"{number:02d}-{stem}.npz"
            if not file.exists():
                torch.manual_seed(1000 * number + own)
                if difficulty == "several parts":
                    mesh = mask_views.side_by_side([mesh, meshes[files[(own + 1) % len(files)].stem]], rng)
                _write(file, mesh, DIFFICULTIES[difficulty], library, rng)
            yield _photographed(f"{difficulty}: {stem}", file, np.random.default_rng([78, number, own]))


def _write(
    file: Path, mesh: Triangles, wanted: tuple[ViewKind, mask_scenes.Mode, float], library: materials.MaterialLibrary,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    kind, mode, touching = wanted
    tracer, traced = Tracer(mesh), None
    while traced is None:
        traced = mask_views.trace_view(tracer, kind, SIZE, rng)
    picture = mask_scenes.make_scene(traced, library, mode, rng, charted=1.0 if touching else 0.7, touching=touching)
    stokes = picture.stokes / np.percentile(picture.stokes[0], 97)
    corners = np.zeros((0, 2)) if picture.corners is None else picture.corners
    np.savez_compressed(file, stokes=stokes.astype(np.float16), mask=picture.mask, corners=corners)


def _photographed(name: str, file: Path, rng: np.random.Generator) -> Case:
    """Three shots of the scene with noise, gains of 1.5 % and nudges, which are registered to 0.05 px."""
    stored = np.load(file)
    stokes, corners = stored["stokes"].astype(np.float32), stored["corners"]
    shots, transforms = [], []
    angle = np.radians([0.0, 45.0, 90.0])
    for k, weights in enumerate(mueller.analyzer(angle)):
        shift = rng.uniform(-1.5, 1.5, 2) * (k > 0)
        move = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
        passed = np.einsum("s,shwc->hwc", weights, stokes).astype(np.float32) * rng.normal(1, 0.015)
        moved = cv2.warpAffine(passed, move[:2], SIZE[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        variance = 0.003**2 * np.maximum(moved, 0) + 2e-4**2
        shots.append(moved + np.sqrt(variance) * rng.standard_normal(moved.shape))
        found = move.copy()
        found[:2, 2] += rng.normal(0, 0.05, 2)
        transforms.append(found)
    value = np.stack(shots).astype(np.float32)
    height, width = SIZE
    radiance = AngleStack(
        value=value, variance=np.full_like(value, 1e-6), quality=np.zeros(value.shape[:3], np.uint8), angle=angle,
        view=View(1000.0, ((width - 1) / 2, (height - 1) / 2), 2.0), bracket=single_frames(3),
    )  # fmt: skip
    charted = len(corners) > 0
    place = ChartPlace(np.zeros((24, 4, 2)), corners) if charted else None
    color = ColorCalibration(np.eye(3), "chart" if charted else "none", place=place)
    return Case(name, radiance, color, Alignment(np.stack(transforms), np.zeros(3), np.ones(3)), stored["mask"])


def found(case: Case, network: Network | None) -> ObjectMask | None:
    """Mask found by the stage; None if it finds no object."""
    try:
        return mask.segment(case.radiance, case.alignment, case.color, None, network, onnx.run, mask.MaskSettings())
    except ObjectError:
        return None


def picture(case: Case, object_: ObjectMask | None) -> Floats:
    """The scene as log radiance, with the true outline in green and the found one in red."""
    light = case.radiance.value.mean((0, -1))
    shown = np.clip(np.log2(np.maximum(light, 0) / np.percentile(light, 97) + 2**-8) / 8 + 1, 0, 1)
    out = cv2.cvtColor((255 * shown).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    for outline, paint in ((case.truth, (0, 255, 0)), (object_.mask if object_ else case.truth & False, (0, 0, 255))):
        lines, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, lines, -1, paint, 1)
    return np.asarray(out)


def main(out: Path, model: Path) -> None:
    network = onnx.load(model, threads=1, encoding=ENCODING)
    rows: dict[str, dict[str, float]] = {}
    for case in cases(data(), out / "scenes"):
        learned, plain = found(case, network), found(case, None)
        rows[case.name] = {
            name: 0.0 if one is None else overlap(one.mask, case.truth)
            for name, one in (("network", learned), ("training-free", plain))
        }
        cv2.imwrite(str(out / f"{case.name.replace(' ', '-').replace(':', '')}.png"), picture(case, learned))
        print(f"{case.name:40}" + "  ".join(f"{k} {v:.3f}" for k, v in rows[case.name].items()), flush=True)
    for column in ("network", "training-free"):
        values = np.array([row[column] for row in rows.values()])
        print(f"{column}: mean {values.mean():.3f}, least {values.min():.3f}, below .90: {(values < 0.9).sum()}")
    (out / "mask.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    options = arguments(__doc__, "out", "model")
    main(options.out, options.model)
