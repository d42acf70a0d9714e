"""Errors of a fused object against its truth, and those of its single views at the same texels.

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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench_fusion import mean_distance, seen_points
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh
from trimesh.sample import sample_surface

from polcap.config import restore
from polcap.formats.capture.folder_names import set_of_view
from polcap.fusion import baking, fused_maps, joining, session, session_views
from polcap.fusion.fusion_path import FusionResults, FusionSettings, SessionConfig, path
from polcap.fusion.session_views import SessionInput
from polcap.fusion.shape import ShapeSettings, fuse_shape
from polcap.fusion.values import FusionView, Pose
from polcap.image_values import Floats
from polcap.optics import color, frames
from polcap.optics.mesh_tracer import Tracer, Triangles, smooth
from polcap.pipeline.cache import LazyCache, MemoryCache, StageResult
from polcap.pipeline.request import Request
from tests.experiments import row, true_pose

LEAST_SEEN = 0.02  # weight of a texel
SAMPLES = 400_000  # of the true surface


class Errors(NamedTuple):
    """Mean errors: normal [°], luminance of albedo and of F0, roughness; and distances, shares of the object's size."""

    single: Floats  # (V, 4) of each view, at the texels that it sees
    fused: Floats  # (V, 4) of the fused object, at the same texels
    distance: float  # of the seen truth from the mesh
    excess: float  # of the texels that a view saw from the truth

    @property
    def best(self) -> int:
        """The view with the best normals."""
        return int(np.argmin(self.single[:, 0]))


def main(folder: Path) -> None:
    found = errors(folder)
    print(f"{'':20}{'normal °':>11}{'albedo':>11}{'F0':>11}{'roughness':>11}")
    for name, part in (("best view", found.best), ("mean of views", slice(None))):
        single, fused = (np.mean(np.atleast_2d(rows[part]), axis=0) for rows in (found.single, found.fused))
        for text, figures in ((name, single), ("  same texels, fused", fused), ("  reduction", 1 - fused / single)):
            print(f"{text:20}" + "".join(f"{one:11.4f}" for one in figures))
    print(f"seen truth to mesh {100 * found.distance:.2f} %, seen texels to truth {100 * found.excess:.2f} %")
    if (folder / "setB").exists():
        print(joined(folder))


def errors(folder: Path) -> Errors:
    """Errors of the object that was fused in a folder of `polcap synth --views`, from its stage caches."""
    truth = dict(np.load(folder / "truth.npz"))
    surface = smooth(truth["vertices"], truth["faces"])
    views, results = fused(folder)
    size = float(np.ptp(surface.vertices, axis=0).max())
    true = material(surface, truth, results.atlas.position)
    single, baked = [], []
    for view, visible in zip(views, baking.visible_texels(views, results.atlas)):
        good = visible.weight > LEAST_SEEN
        normal = frames.unit(visible.sample(view.normal)) @ view.pose.rotation
        own = [normal, *(visible.sample(part) for part in (view.diffuse, view.specular, view.roughness))]
        texel = visible.texel[good]
        single.append(mean_errors([part[good] for part in own], [part[texel] for part in true]))
        baked.append(mean_errors([part[texel] for part in textures(results)], [part[texel] for part in true]))
    point = seen_points(Tracer(surface), true_lenses(folder))
    away = mean_distance(fused_maps.weld(results.atlas.mesh), point) / size
    return Errors(np.array(single), np.array(baked), away, texel_distance(surface, results) / size)


def fused(folder: Path) -> tuple[tuple[FusionView, ...], FusionResults]:
    """The views of a fused folder in one frame, and its results, read from the stage caches."""
    about = json.loads((folder / "fused" / "report.json").read_text())
    config = restore(SessionConfig, about, folder / "fused" / "report.json")
    session_input = SessionInput(folder, config, Request(threads=1))
    cache = LazyCache(folder / "fused")
    views = session.process(session_views.read(session_input), session_input, cache, lambda _: None).views
    results = path(views, config.fusion, cache)
    return joining.place(views.value, results.joined), results


def true_lenses(folder: Path) -> list[Floats]:
    """Places (3,) m of the lens in the frame of the first set."""
    about = json.loads((folder / "truth.json").read_text())
    boards = [(one["name"], true_pose(one)) for one in about["views"]]
    laid = true_pose(about["laid"]) if "laid" in about else None
    return [(after(laid, pose) if laid and name.startswith("setB") else pose).center for name, pose in boards]


def joined(folder: Path) -> str:
    """Table row on the join of two sets."""
    placed, both = fused(folder)
    truth, about = dict(np.load(folder / "truth.npz")), json.loads((folder / "truth.json").read_text())
    surface = Trimesh(truth["vertices"], truth["faces"], process=False)
    point, size = sample_surface(surface, 30_000, seed=0)[0], float(np.ptp(truth["vertices"], axis=0).max())
    laid = true_pose(about["laid"])
    boards = {one["name"]: true_pose(one) for one in about["views"]}
    first, second = ([view for view in placed if set_of_view(view.name) == name] for name in ("setA", "setB"))
    true = [after(laid, boards[view.name]) for view in second]
    pairs = [(view.pose, pose) for view, pose in zip(second, true)]
    turns = [Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude() for one, other in pairs]
    middle = (point.min(axis=0) + point.max(axis=0)) / 2
    places = [np.linalg.norm(one.to_camera(middle) - other.to_camera(middle)) for one, other in pairs]
    results = [path(StageResult("", tuple(first)), FusionSettings(), MemoryCache()), both]
    seen = [one.maps.seen[one.atlas.covered].mean() for one in results]
    right = first + [replace(view, pose=pose) for view, pose in zip(second, true)]
    meshes = [*(one.mesh for one in results), fuse_shape(right, ShapeSettings())]
    away = [100 * mean_distance(mesh, point) / size for mesh in meshes]
    changes = (f"{one:.2f} → {two:.2f}" for one, two in (seen, away[:2]))
    place = 100 * float(np.mean(places)) / size
    return row(folder.name, float(np.degrees(np.mean(turns))), place, both.joined[0].shared, *changes, away[2])


def after(first: Pose, second: Pose) -> Pose:
    """Two rigid motions, one after the other."""
    return Pose(second.rotation @ first.rotation, second.rotation @ first.translation + second.translation)


def textures(results: FusionResults) -> list[Floats]:
    """Normal, albedo, F0 and roughness of all N texels, (N, 3) or (N,)."""
    maps, covered = results.maps, results.atlas.covered
    return [maps.normal[covered], maps.diffuse[covered], maps.specular[covered], maps.roughness[covered]]


def material(surface: Triangles, truth: dict[str, Any], point: Floats) -> list[Floats]:
    """True normal, albedo, F0 and roughness at points (N, 3), from the nearest of four samples of each triangle."""
    normals = np.zeros_like(surface.vertices, np.float64)
    np.add.at(normals, surface.faces, surface.corner_normals)
    share = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])

    def sampled(values: Floats) -> Floats:
        parts = values.reshape(len(surface.vertices), -1)[surface.faces]
        return np.asarray(np.einsum("sk,fkc->fsc", share, parts).reshape(len(share) * len(surface.faces), -1))

    nearest = cKDTree(sampled(surface.vertices)).query(point)[1]
    parts = normals, *(truth[name] for name in ("diffuse", "specular", "roughness"))
    return [sampled(part)[nearest] for part in parts]


def mean_errors(found: Sequence[Floats], true: Sequence[Floats]) -> Floats:
    """Mean errors (4,) of normals [°], luminance of albedo and of F0, and roughness."""
    albedo, f0 = (np.abs(color.luminance(found[k]) - color.luminance(true[k])).mean() for k in (1, 2))
    return np.array([mean_angle_deg(found[0], true[0]), albedo, f0, np.abs(found[3].ravel() - true[3].ravel()).mean()])


def texel_distance(surface: Triangles, source: FusionResults) -> float:
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
