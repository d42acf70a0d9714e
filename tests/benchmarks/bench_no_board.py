"""Poses and mesh of an object with a fine pattern, fused without a board and with one.

POLCAP_DATA=FOLDER python tests/benchmarks/bench_no_board.py OUT MESH VIEWS [STEP]

Renders OUT/none and OUT/A4, fuses each (every STEP-th view), and prints a row: mean and largest error of the views'
rotations [°], rms of the features or corners [px], and mean distance of the mesh from the true surface [% of its size],
over the texels that a view saw. Without a board the mesh is first placed on the true one, and scaled, by iterative
closest points.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bench_fused_asset
import numpy as np
from msgspec.structs import replace
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh
from trimesh.registration import procrustes
from trimesh.sample import sample_surface

from polcap.fusion import session, session_views
from polcap.fusion.fusion_path import FusionResults, FusionSettings, SessionConfig, path
from polcap.fusion.session_views import SessionInput
from polcap.fusion.values import FusionView, Pose
from polcap.image_values import Floats
from polcap.pipeline.cache import LazyCache, MemoryCache
from polcap.pipeline.request import Request
from polcap.synth import all_around, scenes
from tests.experiments import data, row, true_pose

PATTERN_M = 0.006  # size of the pattern
ROUNDS, NEAR = 20, 0.9  # of the placing; share of the nearest points that it uses
TEXELS = 10  # every tenth is compared


def main(out: Path, mesh: str, views: int, step: int) -> None:
    for board in ("none", "A4"):
        folder = out / board
        if not folder.exists():
            render(folder, mesh, board, views)
        session_input = SessionInput(folder, SessionConfig(), Request(threads=1))
        found = session_views.read(session_input)
        found = session_views.Session(dict(list(found.views.items())[::step]), {})
        processed = session.process(found, session_input, LazyCache(folder / "fused"), print)
        results = path(processed.views, FusionSettings(), MemoryCache())
        pairs = true_poses(folder, processed.views.value)
        turns = rotation_errors(pairs)
        residual = np.mean([one.residual_px for one in processed.poses.views.values()])
        away = 100 * distance(folder, results, processed.poses.metric, pairs)
        used, by = f"{mesh}, {len(turns)} of {len(found.views)} views", "board" if board != "none" else "features"
        print(row(used, by, f"{turns.mean():.2f}, {turns.max():.2f}", float(residual), away))


def render(folder: Path, mesh: str, board: Any, views: int) -> None:
    """Views of 1500 × 1000 px of a mesh with two fine patterns."""
    file = data() / "meshes" / "test" / f"{mesh}.npz"
    scene = scenes.with_model(scenes.random_scene(0, "bumps"), file, 0)
    fine = zip(scene.coat.materials, ("veins", "noise"))
    materials = tuple(replace(one, size=PATTERN_M, pattern=pattern) for one, pattern in fine)
    shoot = all_around.AroundShoot(seed=0, width=1500, height=1000, samples=1, exposures=1, board=board)
    all_around.write(folder, replace(scene, coat=replace(scene.coat, materials=materials)), shoot, views)


def true_poses(folder: Path, views: Sequence[FusionView]) -> list[tuple[Pose, Pose]]:
    """Found and true pose of each used view."""
    stated = json.loads((folder / "truth.json").read_text())["views"]
    true = {one["name"]: true_pose(one) for one in stated}
    return [(view.pose, true[view.name]) for view in views]


def world(pairs: list[tuple[Pose, Pose]]) -> Floats:
    """Rotation (3, 3) from the true world to the found one that fits the rotations of all views best."""
    return Rotation.from_matrix([one.rotation.T @ true.rotation for one, true in pairs]).mean().as_matrix()


def rotation_errors(pairs: list[tuple[Pose, Pose]]) -> Floats:
    """Angles [°] between the found and the true rotations of all views, in the world frame that fits them best."""
    turn = world(pairs)
    return np.degrees([Rotation.from_matrix(one.rotation @ turn @ true.rotation.T).magnitude() for one, true in pairs])


def distance(folder: Path, results: FusionResults, metric: bool, pairs: list[tuple[Pose, Pose]]) -> float:
    """Mean distance of the seen texels from the true surface, over its size."""
    atlas, truth = results.atlas, dict(np.load(folder / "truth.npz"))
    surface = Trimesh(truth["vertices"], truth["faces"], process=False)
    tree, size = cKDTree(sample_surface(surface, 400_000, seed=0)[0]), float(np.ptp(truth["vertices"], axis=0).max())
    point = atlas.position[results.maps.weight[atlas.covered] > bench_fused_asset.LEAST_SEEN][::TEXELS]
    point = point if metric else placed(point, pairs, tree)
    return float(np.mean(tree.query(point)[0])) / size


def placed(point: Floats, pairs: list[tuple[Pose, Pose]], tree: cKDTree) -> Floats:
    """Points (N, 3) placed on those of a tree by similarities, first by that of the poses."""
    turn = world(pairs)
    terms = np.concatenate([np.hstack([one.translation[:, None], -true.rotation]) for one, true in pairs])
    scale, *shift = np.linalg.lstsq(terms, np.concatenate([true.translation for _, true in pairs]))[0]
    moved = scale * point @ turn + shift
    for _ in range(ROUNDS):
        away, near = tree.query(moved)
        use = away < np.quantile(away, NEAR)
        matrix = procrustes(moved[use], tree.data[np.asarray(near)[use]], reflection=False)[0]
        moved = moved @ matrix[:3, :3].T + matrix[:3, 3]
    return np.asarray(moved)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]) if len(sys.argv) > 4 else 1)
