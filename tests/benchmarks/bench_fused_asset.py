"""Errors of a fused object against its truth, beside those of its single views.

polcap synth FOLDER --views 12 && polcap fuse FOLDER
python tests/benchmarks/bench_fused_asset.py FOLDER

Two distances, % of the object's size: of the true surface, where some view sees it, from the mesh; and of the texels
that a view saw from the true surface.

Of a folder with a second set (`--set laid=8`) also prints how well the sets are joined: errors of the turn [degrees]
and, at the object's middle, of the place [% of its size]; the share of the second set's surface that the first
confirms; the share of the mesh that views saw, and the mean distance of the whole true surface from it [%], from the
first set and from both; and this distance from a mesh of both with the true turn.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench_fusion import mean_distance, seen_points
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh
from trimesh.sample import sample_surface

import polcap
from polcap.fusion import fused_maps, joining, session
from polcap.fusion.fusion_path import FusionResults, FusionSettings, SessionConfig, path
from polcap.fusion.session import SessionInput
from polcap.fusion.shape import ShapeSettings, fuse_shape
from polcap.fusion.values import Pose
from polcap.images import Floats
from polcap.optics import color
from polcap.optics.mesh_tracer import Tracer, Triangles, smooth
from polcap.pipeline.cache import LazyCache, MemoryCache, StageResult
from polcap.pipeline.request import Request
from polcap.stages.asset import AssetSettings

LEAST_SEEN = 0.02  # weight of a texel
SAMPLES = 400_000  # of the true surface


class Errors(NamedTuple):
    """Mean errors: normal [°], luminance of albedo and of F0, roughness; and distances, shares of the object's size."""

    single: Floats  # (4,) mean over the views
    fused: Floats  # (4,) of the texels that a view saw
    distance: float  # of the seen truth from the mesh
    excess: float  # of the texels that a view saw from the truth


def main(folder: Path) -> None:
    found = errors(folder)
    print(f"{'':10}{'normal':>9}{'albedo':>9}{'F0':>9}{'roughness':>11}")
    print_row("single", found.single)
    print_row("fused", found.fused)
    print("reduction " + "".join(f"{100 * one:8.0f}%" for one in 1 - found.fused / found.single))
    print(f"seen truth to mesh {100 * found.distance:.2f} %, seen texels to truth {100 * found.excess:.2f} %")
    if (folder / "setB").exists():
        print(joined(folder))


def errors(folder: Path) -> Errors:
    """Errors of the object that was fused in a folder of `polcap synth --views`."""
    truth = dict(np.load(folder / "truth.npz"))
    surface = smooth(truth["vertices"], truth["faces"])
    source = fused_maps.read(folder / "fused" / "maps", AssetSettings())
    size = float(np.ptp(surface.vertices, axis=0).max())
    views = sorted([*folder.glob("view*/"), *folder.glob("set*/view*/")])
    singles = [single(view) for view in views if (view / "polcap" / "report.json").exists()]
    point = seen_points(Tracer(surface), true_lenses(folder))
    away = mean_distance(fused_maps.closed(source.atlas.mesh), point) / size
    excess = texel_distance(surface, source) / size
    return Errors(np.mean(singles, axis=0), against_truth(source, surface, truth), away, excess)


def true_lenses(folder: Path) -> list[Floats]:
    """Places (3,) m of the lens in the frame of the first set."""
    about = json.loads((folder / "truth.json").read_text())
    boards = [(one["name"], pose_of(one)) for one in about["views"]]
    laid = pose_of(about["laid"]) if "laid" in about else None
    return [(after(laid, pose) if laid and name.startswith("setB") else pose).center for name, pose in boards]


def pose_of(stated: dict[str, Any]) -> Pose:
    """A pose of truth.json."""
    return Pose(np.array(stated["rotation"]), np.array(stated["translation"]))


def joined(folder: Path) -> str:
    """Table row on the join of two sets."""
    session_input = SessionInput(folder, SessionConfig(), Request(threads=1))
    cache = LazyCache(folder / "fused")
    views = session.process(session.read(session_input), session_input, cache, lambda _: None).views
    both = path(views, FusionSettings(), MemoryCache())
    placed = joining.place(views.value, both.joined)
    truth, about = dict(np.load(folder / "truth.npz")), json.loads((folder / "truth.json").read_text())
    surface = Trimesh(truth["vertices"], truth["faces"], process=False)
    point, size = sample_surface(surface, 30_000, seed=0)[0], float(np.ptp(truth["vertices"], axis=0).max())
    laid = pose_of(about["laid"])
    boards = {one["name"]: pose_of(one) for one in about["views"]}
    first, second = ([view for view in placed if view.folder == name] for name in ("setA", "setB"))
    true = [after(laid, boards[view.name]) for view in second]
    pairs = [(view.pose, pose) for view, pose in zip(second, true)]
    turns = [Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude() for one, other in pairs]
    middle = (point.min(axis=0) + point.max(axis=0)) / 2
    places = [np.linalg.norm(move(one, middle) - move(other, middle)) for one, other in pairs]
    results = [path(StageResult("", tuple(first)), FusionSettings(), MemoryCache()), both]
    seen = [one.maps.seen[one.atlas.covered].mean() for one in results]
    right = first + [replace(view, pose=pose) for view, pose in zip(second, true)]
    meshes = [*(one.mesh for one in results), fuse_shape(right, ShapeSettings())]
    away = [100 * mean_distance(mesh, point) / size for mesh in meshes]
    return (
        f"| {folder.name} | {np.degrees(np.mean(turns)):.2f} | {100 * np.mean(places) / size:.2f} | "
        f"{both.joined[0].shared:.2f} | {seen[0]:.2f} → {seen[1]:.2f} | {away[0]:.2f} → {away[1]:.2f} | {away[2]:.2f} |"
    )


def after(first: Pose, second: Pose) -> Pose:
    """Two rigid motions, one after the other."""
    return Pose(second.rotation @ first.rotation, second.rotation @ first.translation + second.translation)


def move(pose: Pose, point: Floats) -> Floats:
    """A point (3,) in the camera frame, m."""
    return pose.rotation @ point + pose.translation


def print_row(name: str, row: Floats) -> None:
    print(f"{name:10}{row[0]:8.2f}°{row[1]:9.4f}{row[2]:9.4f}{row[3]:11.4f}")


def single(view: Path) -> Floats:
    """Mean errors of a view's maps: normal [°], luminance of albedo and of F0, roughness."""
    maps, truth = polcap.read_maps(view / "polcap"), dict(np.load(view / "truth.npz"))
    step = round(maps.view.scale)
    x0, y0 = (round(start * maps.view.scale) for start in maps.view.origin)
    height, width = maps.mask.shape

    def on_grid(name: str) -> Any:
        part = truth[name].astype(np.float64)[y0 : y0 + step * height, x0 : x0 + step * width]
        return part.reshape(height, step, width, step, *part.shape[2:]).mean(axis=(1, 3))

    inside = maps.mask & (on_grid("mask") == 1)
    return np.array(
        [
            mean_angle_deg(maps.normal[inside], on_grid("normal")[inside]),
            np.abs(color.luminance(maps.diffuse[inside]) - color.luminance(on_grid("diffuse")[inside])).mean(),
            np.abs(color.luminance(maps.specular[inside]) - color.luminance(on_grid("specular")[inside])).mean(),
            np.abs(maps.roughness[inside] - on_grid("roughness")[inside]).mean(),
        ]
    )


def against_truth(source: fused_maps.FusedSource | FusionResults, surface: Triangles, truth: dict[str, Any]) -> Floats:
    """The same of the atlas, over the texels that a view saw."""
    seen = source.maps.weight[source.atlas.covered] > LEAST_SEEN
    point = source.atlas.position[seen]
    corner = surface.vertices[surface.faces]
    normals = np.zeros_like(surface.vertices, np.float64)
    np.add.at(normals, surface.faces, surface.corner_normals)
    share = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])
    sample = np.einsum("sk,fkc->fsc", share, corner).reshape(-1, 3)

    def at(values: Floats) -> Floats:
        parts = np.einsum("sk,fkc->fsc", share, values.reshape(len(surface.vertices), -1)[surface.faces])
        return np.asarray(parts.reshape(len(sample), -1)[cKDTree(sample).query(point)[1]])

    maps = {name: getattr(source.maps, name)[source.atlas.covered][seen] for name in ("normal", "diffuse", "specular")}
    roughness = source.maps.roughness[source.atlas.covered][seen]
    return np.array(
        [
            mean_angle_deg(maps["normal"], at(normals)),
            np.abs(color.luminance(maps["diffuse"]) - color.luminance(at(truth["diffuse"]))).mean(),
            np.abs(color.luminance(maps["specular"]) - color.luminance(at(truth["specular"]))).mean(),
            np.abs(roughness - at(truth["roughness"])[:, 0]).mean(),
        ]
    )


def texel_distance(surface: Triangles, source: fused_maps.FusedSource) -> float:
    """Mean distance [m] of the texels that a view saw from the true surface, by the planes of its nearest samples."""
    truth = Trimesh(surface.vertices, surface.faces, process=False)
    sample, face = sample_surface(truth, SAMPLES, seed=0)
    point = source.atlas.position[source.maps.weight[source.atlas.covered] > LEAST_SEEN]
    near = cKDTree(sample).query(point)[1]
    return float(np.abs(np.sum((point - sample[near]) * truth.face_normals[face[near]], axis=1)).mean())


def mean_angle_deg(normal: Floats, truth: Floats) -> float:
    """Mean angle of unit vectors (N, 3) and vectors (N, 3), without those of length 0, as on folded triangles."""
    length = np.linalg.norm(truth, axis=-1)
    there = length > 0
    cosine = np.sum(normal[there] * truth[there], axis=-1) / length[there]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
