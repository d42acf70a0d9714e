"""Two held-out views under a moved light: a fused object against the nearest single view's result.

polcap synth FOLDER --views 12 --mesh spot.npz && polcap fuse FOLDER
python tests/benchmarks/bench_held_out.py FOLDER [--pictures FOLDER]

The held-out views are halfway between two views, on opposite sides. Their light is 30 cm right of the lens and 15 cm
above it. The fused mesh, and the relief of the nearest view at its true pose and median depth, are drawn with their
maps, with shadows, and compared with the true picture. Prints for each held-out view the mean error of S0, % of the
true mean, of both: over the pixels that the single view shows, and over the whole object, where missing surface is
black; and the share of these pixels where the fused object errs less, after a blur of 2 % of the object's width.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from polcap.formats.maps import png
from polcap.fusion import fused_maps
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Floats, View
from polcap.mesh_values import Mesh
from polcap.optics import color, frames, shade
from polcap.optics.mesh_tracer import Tracer, Triangles
from polcap.pipeline import run
from polcap.results import Results
from polcap.stage_values import SurfaceMaps
from polcap.stages.asset import AssetSettings
from polcap.synth import render, trace
from polcap.synth.render import Scene
from tests.experiments import arguments, head, row, true_pose

LIGHT = np.array([0.3, 0.15, 0.0])  # m, camera frame
INDEX = 1.5
BLUR = 0.02  # 1σ, of the object's width


class TexturedMesh(NamedTuple):
    """A mesh, its maps, and the pose of its frame before the camera."""

    mesh: Mesh
    maps: AtlasMaps | SurfaceMaps
    pose: Pose


def main() -> None:
    options = arguments(__doc__, "folder", pictures=Path)
    about = json.loads((options.folder / "truth.json").read_text())
    poses = {one["name"]: true_pose(one) for one in about["views"]}
    print(head("view", "shown by the single view", "error there %", "fused better", "error %", "fused better"))
    source = fused_maps.read(options.folder / "fused" / "maps", AssetSettings())
    for first in (0, len(poses) // 2):
        (name, near), (_, beyond) = list(poses.items())[first : first + 2]
        pose = between(near, beyond)
        view = View(about["focal_px"], tuple(about["principal_px"]), 1.0)
        width, height = about["size_px"]
        truth, mask, origin = true_picture(options.folder / name, pose, near, view, (height, width))
        fused = TexturedMesh(source.atlas.mesh, source.maps, pose)
        assets = (fused, relief(options.folder / name, near, pose, truth_depth(options.folder / name)))
        drawn = [picture(one, view, mask.shape, origin) for one in assets]
        print(row(name, *cells(truth, mask, drawn)), flush=True)
        if options.pictures:
            strip = np.hstack([truth, *(image for image, _ in drawn)]) / np.quantile(truth[mask], 0.998)
            png.write(options.pictures / f"{name}.png", color.srgb_eight_bits(strip))


def between(one: Pose, other: Pose) -> Pose:
    """The pose halfway between two."""
    turn = Slerp([0, 1], Rotation.from_matrix(np.stack([one.rotation, other.rotation])))(0.5)
    return Pose(turn.as_matrix(), (one.translation + other.translation) / 2)


def true_picture(
    folder: Path, pose: Pose, near: Pose, view: View, size: tuple[int, int]
) -> tuple[Floats, Bools, Floats]:
    """S0 (H, W, 3) and mask of the object in a pose of the board; origin (3,) of its own frame, m."""
    scene = msgspec.convert(json.loads((folder / "truth.json").read_text())["scene"], Scene)
    turn = pose.rotation @ near.rotation.T
    origin = turn @ (np.array(scene.position) - near.translation) + pose.translation
    moved = Rotation.from_matrix(turn) * scene.turn
    scene = msgspec.structs.replace(
        scene, position=tuple(origin), turn_deg=tuple(moved.as_rotvec(degrees=True)), light=tuple(LIGHT),
        chart=None, board=msgspec.UNSET,
    )  # fmt: skip
    mask = render.gbuffer(scene, view, *size).mask
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    return render.stokes(scene, view, x, y)[0] * mask[..., None], mask, origin


def truth_depth(folder: Path) -> float:
    """Median depth [m] of the object in a view."""
    with np.load(folder / "truth.npz") as truth:
        return float(np.median(truth["depth"][truth["mask"] > 0]))


def relief(folder: Path, near: Pose, pose: Pose, depth: float) -> TexturedMesh:
    """The result of a single view in another pose of the board, scaled to its true median depth."""
    results = run.reopen(folder / "polcap", Results)[0]
    mesh = replace(results.mesh, vertices=results.mesh.vertices * (depth / float(np.nanmedian(results.mesh.depth))))
    turn = pose.rotation @ near.rotation.T
    return TexturedMesh(mesh, results.maps, Pose(turn, pose.translation - turn @ near.translation))


def picture(asset: TexturedMesh, view: View, size: tuple[int, int], origin: Floats) -> tuple[Floats, Bools]:
    """S0 (H, W, 3) of a mesh with its maps, and its mask; light as in `render`, relative to the object's origin."""
    mesh, maps, pose = asset
    tracer = Tracer(Triangles(mesh.vertices, mesh.faces, mesh.normals[mesh.faces]))
    v = frames.rays(view, *size).reshape(-1, 3)
    met = tracer.meet(np.broadcast_to(pose.center, v.shape), -v @ pose.rotation)
    uv = (mesh.uv[mesh.faces[met.face]] * met.weight[..., None]).sum(axis=1)
    at = np.floor(uv * maps.mask.shape[::-1]).astype(int)
    column, row = np.clip(at, 0, np.array(maps.mask.shape[::-1]) - 1).T
    normal, diffuse, specular, roughness = (
        image[row, column].astype(float) for image in (maps.normal, maps.diffuse, maps.specular, maps.roughness)
    )
    source = (LIGHT - pose.translation) @ pose.rotation
    to_light = source - met.position
    squared = np.sum(to_light**2, axis=-1)
    ray = v[met.index]
    local = frames.to_ray_frame(frames.unit(normal) @ pose.rotation.T, ray)
    light = frames.to_ray_frame(to_light @ pose.rotation.T / np.sqrt(squared)[:, None], ray)
    lit = np.sum((LIGHT - origin) ** 2) / squared
    lit[tracer.hidden(met.position + trace.LIFT * met.normal, source)] = 0
    index = INDEX * np.ones(len(ray))
    s0 = shade.stokes(local, diffuse, specular, np.maximum(roughness, 0.05), index, light, lit)[0]
    out, there = np.zeros((len(v), 3)), np.zeros(len(v), bool)
    out[met.index], there[met.index] = s0, True
    return out.reshape(*size, 3), there.reshape(size)


def cells(truth: Floats, mask: Bools, drawn: Sequence[tuple[Floats, Bools]]) -> list[object]:
    """Cells of a view: share that the single view shows; mean errors of both, and the share that the fused one wins."""
    blur = BLUR * float(np.sqrt(4 * mask.sum() / np.pi))
    errors = [np.abs(color.luminance(image - truth)) for image, _ in drawn]
    smooth = [cv2.GaussianBlur(one * mask, (0, 0), blur) for one in errors]
    shown = mask & drawn[1][1]
    out: list[object] = [float(shown.sum() / mask.sum())]
    for where in (shown, mask):
        mean = color.luminance(truth)[where].mean()
        fused, single = (100 * one[where].mean() / mean for one in errors)
        out += [f"{single:.1f} → {fused:.1f}", float((smooth[0] <= smooth[1])[where].mean())]
    return out


if __name__ == "__main__":
    main()
