"""Benchmark of the mesh's cuts at occlusions: traced objects with known parts, against plain least squares.

python tests/benchmarks/bench_mesh.py FOLDER [--only NAME…] [--noise]     (POLCAP_DATA for the meshes)

Renders normals, depth and true contours of 20 objects as a camera of 24 MP shows them and of 12 as one of 2 MP does
(stored in FOLDER), integrates them by plain least squares and by the stage, and prints a row for each: CPU seconds,
depth error over the depth range after the best scale, pieces, slits (edges of the mesh inside a smooth surface, px
from the nearest true contour more than 6) and the share of the true contours that are cut. With --noise normals are
blurred, off by 5° in waves and noisy by 1°, as estimated ones are.

A link between pixels crosses a true contour where its depth step exceeds the least that may be cut (`surface.jump`)
and goes on exceeding it between ever nearer rays.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import msgspec
import numpy as np

from polcap.image_values import Bools, Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.optics import frames
from polcap.stage_values import SurfaceMaps
from polcap.stages import surface
from polcap.stages.surface.occlusion import least_step
from polcap.stages.surface.triangles import boundary_edges, measure_boundary
from polcap.synth import render, scenes, trace
from tests.experiments import arguments, data, head, plain_maps, rms, row, timed

LARGE = (
    "vase 5", "vase 1", "vase 2", "clusters 0", "clusters 1", "clusters 2", "clusters 3", "clusters 4", "bumps 0",
    "bumps 1", "test/mug 1", "test/mug 2", "train/teapot 3", "train/teapot 4", "test/hand 5", "test/spot 6",
    "test/demosthenes 7", "train/pitcher 8", "train/wingnut 9", "train/plane 10",
)  # fmt: skip
SMALL = (
    "vase 5", "vase 7", "clusters 10", "clusters 11", "clusters 12", "bumps 3", "test/mug 11", "test/mug 12",
    "train/teapot 13", "train/frypan 14", "train/wingnut 15", "test/penguin 16",
)  # fmt: skip
SIDE = {"24MP": 1200, "2MP": 346}  # px of half the picture's height, about what an object of 16 cm fills
BISECTIONS = 9  # the last step of a link is between rays 1/512 px from each other
NEAR = 6  # px within which a cut belongs to a true contour


@dataclass(frozen=True)
class Case:
    """An object as the camera sees it, without error."""

    maps: SurfaceMaps
    depth: Floats  # (H, W) m
    right: Bools  # (H, W−1) links across a true contour
    down: Bools  # (H−1, W)


def main() -> None:
    options = arguments(__doc__, "folder", "--noise", only=[""])
    options.folder.mkdir(parents=True, exist_ok=True)
    names = [f"{size} {name}" for size, of in (("2MP", SMALL), ("24MP", LARGE)) for name in of]
    figures = "plain: error", "s", "cut: error", "s", "pieces", "slit px", "contours cut"
    print(head("scene", "MP", "true pieces", *figures))
    for name in names:
        if any(part in name for part in options.only):
            print(row(name, *measure(case(options.folder, name), options.noise)), flush=True)


def measure(of: Case, noise: bool) -> list[float]:
    """Figures of a scene's row."""
    maps = noisy(of.maps) if noise else of.maps
    plain, plain_s = timed(lambda: surface.integrate(maps, None, surface.SurfaceSettings(stiffness=0.0)))
    mesh, seconds = timed(lambda: surface.integrate(maps, None, surface.SurfaceSettings()))
    cut = mesh.pieces, slits(mesh, of), cut_share(mesh, of)
    return [float(of.maps.mask.sum() / 1e6), true_pieces(of), error(plain, of), plain_s, error(mesh, of), seconds, *cut]


def error(mesh: ReliefMesh, of: Case) -> float:
    """RMS after the best scale, over the depth range."""
    inside = of.maps.mask & np.isfinite(mesh.depth)
    ours, true = mesh.depth[inside].astype(np.float64), of.depth[inside].astype(np.float64)
    return rms(ours * (ours @ true) / (ours @ ours) - true) / float(np.ptp(true))


def contours(of: Case) -> Bools:
    """Pixels (H, W) at a true contour."""
    at = np.zeros(of.maps.mask.shape, dtype=bool)
    at[:, :-1] |= of.right
    at[:, 1:] |= of.right
    at[:-1] |= of.down
    at[1:] |= of.down
    return at


def true_pieces(of: Case) -> int:
    """Number of parts joined by links that cross no true contour, without specks, as the mesh counts its own."""
    mask, (height, width) = of.maps.mask, of.maps.mask.shape
    number = np.arange(height * width).reshape(height, width)
    right, down = mask[:, :-1] & mask[:, 1:] & ~of.right, mask[:-1] & mask[1:] & ~of.down
    whole = right[:-1] & right[1:] & down[:, :-1] & down[:, 1:]  # one sheet under all four corners
    corners = [part[whole] for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])]
    faces = np.concatenate([np.stack([corners[k] for k in ks], axis=-1) for ks in ((0, 1, 2), (0, 2, 3))])
    return measure_boundary(
        np.stack(np.nonzero(np.ones_like(mask))[::-1], axis=-1), faces.astype(np.int32), mask, 1
    ).pieces


def mesh_rim(mesh: ReliefMesh, of: Case) -> Floats:
    """Middles (B, 2) of the mesh's boundary edges, x, y px."""
    height, width = of.maps.mask.shape
    rim = boundary_edges(mesh.faces)
    place = mesh.uv * [width, height] - 0.5
    return np.asarray((place[rim[:, 0]] + place[rim[:, 1]]) / 2)


def slits(mesh: ReliefMesh, of: Case) -> float:
    """Boundary edges far from outline and true contours."""
    mask = of.maps.mask
    far = cv2.distanceTransform((mask & ~contours(of)).astype(np.uint8), cv2.DIST_L2, 5)
    x, y = np.rint(mesh_rim(mesh, of)).astype(int).T
    padded = np.pad(mask, 1)[1:-1, 1:-1]
    edge = cv2.distanceTransform(np.pad(padded.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    return float((np.minimum(far, edge)[y, x] > NEAR).sum())


def cut_share(mesh: ReliefMesh, of: Case) -> float:
    """Share of the true contours' pixels that have an edge of the mesh within `NEAR` px; the outline's own left out."""
    mask = of.maps.mask
    inner = cv2.erode(np.pad(mask.astype(np.uint8), 1), np.ones((4 * NEAR + 1,) * 2, np.uint8))[1:-1, 1:-1] > 0
    wanted = contours(of) & inner
    drawn = np.ones(mask.shape, np.uint8)
    x, y = np.rint(mesh_rim(mesh, of)).astype(int).T
    drawn[y, x] = 0
    near = cv2.distanceTransform(drawn, cv2.DIST_L2, 5) <= NEAR
    return float(near[wanted].mean()) if wanted.any() else 1.0


def noisy(maps: SurfaceMaps) -> SurfaceMaps:
    """Normals as estimated ones err: blurred, off by 5° in waves, noisy by 1°."""
    random = np.random.default_rng(0)
    share = cv2.GaussianBlur(maps.mask.astype(np.float32), (0, 0), 1.0)[..., None]
    normal = cv2.GaussianBlur(maps.normal, (0, 0), 1.0) / np.maximum(share, 1e-3)
    size = np.sqrt(maps.mask.sum() / np.pi)
    waves = random.normal(size=(*maps.mask.shape, 2)).astype(np.float32)
    waves = cv2.GaussianBlur(waves, (0, 0), 0.15 * size)
    waves *= np.radians(5) / np.sqrt((waves**2).sum(axis=-1).mean())
    normal[..., :2] += waves + np.radians(1) * random.normal(size=waves.shape).astype(np.float32)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return replace(maps, normal=np.where(maps.mask[..., None], normal, 0).astype(np.float32))


def case(folder: Path, name: str) -> Case:
    """A scene, rendered once and stored in the folder."""
    file = folder / f"{name.replace(' ', '_').replace('/', '_')}.npz"
    if not file.exists():
        np.savez(file, allow_pickle=False, **rendered(name))
    with np.load(file) as stored:
        focal, x, y = (float(one) for one in stored["view"])
        maps = plain_maps(stored["normal"], stored["mask"], View(focal, (x, y), 2.0), error_deg=5.0)
        return Case(maps, stored["depth"], stored["right"], stored["down"])


def scene_of(kind: str, seed: int) -> render.Scene:
    """A random scene of a kind of object, or with a mesh such as test/mug."""
    if "/" in kind:
        return scenes.with_model(scenes.random_scene(seed, "vase"), data() / "meshes" / f"{kind}.npz", seed)
    return scenes.random_scene(seed, cast(scenes.Kind, kind))


def rendered(name: str) -> dict[str, Floats | Bools]:
    size, what, seed = name.split()
    half = SIDE[size] / 2
    scene = scene_of(what, int(seed))
    scene = msgspec.structs.replace(scene, position=(0.0, 0.0, scene.position[2]), chart=None)
    view = View(focal=half / 0.13, center=(half, half), scale=2.0)
    seen = render.gbuffer(scene, view, SIDE[size], SIDE[size])
    rows, columns = np.nonzero(seen.mask)
    top, left = max(rows.min() - 4, 0), max(columns.min() - 4, 0)
    crop = np.s_[top : rows.max() + 5, left : columns.max() + 5]
    mask = seen.mask[crop]
    view = View(view.focal, (half - left, half - top), 2.0)
    links = [true_links(scene, view, seen.depth[crop], mask, axis) for axis in (1, 0)]
    return {
        "normal": seen.normal[crop], "depth": seen.depth[crop], "mask": mask,
        "view": np.array([view.focal, *view.center]), "right": links[0], "down": links[1],
    }  # fmt: skip


def true_links(scene: render.Scene, view: View, depth: Floats, mask: Bools, axis: int) -> Bools:
    """Links along an axis with a depth step that does not shrink between ever nearer rays."""
    least = least_step(mask, surface.SurfaceSettings().jump)
    log = view.focal * np.log(np.where(mask, depth, 1).astype(np.float64))
    both = (mask[:, :-1] & mask[:, 1:]) if axis else (mask[:-1] & mask[1:])
    steps = np.diff(log, axis=axis)
    row, column = np.nonzero(both & (np.abs(steps) > least))
    along = np.array([0.0, 1.0]) if axis else np.array([1.0, 0.0])
    low, high = np.stack([row, column], axis=-1).astype(np.float64), np.stack([row, column], axis=-1) + along
    from_, to = log[row, column], log[row + (1 - axis), column + axis]
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        at = np.full(len(middle), np.inf)  # a gap between the two is a contour, too
        hits = trace.trace(scene.shape, scene.position, scene.turn, frames.rays_at(view, middle[:, 1], middle[:, 0]))
        at[hits.index] = view.focal * np.log(-hits.point[:, 2])
        first = np.abs(at - from_) >= np.abs(to - at)
        high, to = np.where(first[:, None], middle, high), np.where(first, at, to)
        low, from_ = np.where(first[:, None], low, middle), np.where(first, from_, at)
        from_, to = (np.where(np.isfinite(a), a, 1e9) for a in (from_, to))
    out = np.zeros(both.shape, dtype=bool)
    out[row, column] = np.abs(to - from_) > least
    return out


if __name__ == "__main__":
    main()
