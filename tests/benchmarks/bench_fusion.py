"""Benchmark of the fused shape: traced views of six meshes with simulated errors, to one closed mesh.

POLCAP_DATA=FOLDER python tests/benchmarks/bench_fusion.py [--views 12 24] [--only NAME…] [--pictures FOLDER]

Two thirds of the views stand on a ring at 25° about the object, one third on a ring after it is laid on its side. Of
the mug, half of the views look into it after it is laid. Errors of normals, albedo and poses: `traced_views`. Prints
for each object the mean distance of the seen true surface from the bare hull and from the fused mesh, % of the
object's size, the Euler numbers, CPU seconds, vertices and the process's peak memory.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh, triangles

from polcap.formats.scene_files import read_mesh
from polcap.fusion.closed_mesh import is_closed, iso_surface
from polcap.fusion.hull import visual_hull
from polcap.fusion.shape import ShapeSettings, fuse_shape
from polcap.fusion.small_views import reduce_views
from polcap.fusion.values import ClosedMesh
from polcap.image_values import Floats
from polcap.optics.frames import dot, unit
from polcap.optics.mesh_tracer import Tracer, smooth
from tests.experiments import arguments, data, head, peak_mb, row, timed
from tests.fusion import traced_views
from tests.fusion.traced_views import Body, capture, ring, solid

OBJECTS = ("spot", "demosthenes", "penguin", "hand", "scorpion", "mug")
POINTS = 30_000  # on the true surface, of which the seen ones count
FACING = 0.1  # least cosine between normal and ray of a point that a view sees
NEAREST = 24  # triangles of which the distance is computed


def main() -> None:
    options = arguments(__doc__, views=[12, 24], only=list(OBJECTS), pictures=Path)
    names = "normals °", "hull %", "fused %", "Euler: truth", "hull", "fused", "closed", "s", "vertices", "MB"
    print(head("views", "object", *names))
    for count in options.views:
        for name in options.only:
            print(row(count, name, *measure(name, count, options.pictures)), flush=True)


def measure(name: str, count: int, pictures: Path | None) -> list[object]:
    """Fuse views of an object; returns the cells of its row."""
    vertices, faces = read_mesh(data() / "meshes/test" / f"{name}.npz")
    body = traced_views.stand(vertices, faces, Rotation.from_euler("x", -90, degrees=True) if name == "mug" else None)
    poses = (traced_views.into_the_opening if name == "mug" else traced_views.all_around)(body, count)
    rng = np.random.default_rng(0)
    true = [capture(body, pose) for pose in poses]
    views = [traced_views.with_errors(body, view, rng) for view in true]
    off = float(np.mean([traced_views.mean_error_deg(*pair) for pair in zip(true, views)]))
    point = seen_points(body.tracer, [pose.center for pose in poses])
    fused, seconds = timed(lambda: fuse_shape(views, ShapeSettings()))
    hull = iso_surface(visual_hull(reduce_views(views), ShapeSettings().grid))
    percent = [100 * mean_distance(mesh, point) / body.size for mesh in (hull, fused)]
    closed = "yes" if is_closed(fused) and solid(fused).volume > 0 else "no"
    if pictures:
        cv2.imwrite(str(pictures / f"{name}{count}.png"), picture(fused))
    euler = true_euler(vertices, faces), solid(hull).euler_number, solid(fused).euler_number
    return [off, *percent, *euler, closed, round(seconds), len(fused.vertices), round(peak_mb())]


def true_euler(vertices: Floats, faces: NDArray[np.int64]) -> int:
    """Euler number of the true mesh, corners at one place counted as one."""
    mesh = Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    return int(mesh.euler_number)


def seen_points(surface: Tracer, lenses: Sequence[Floats]) -> Floats:
    """Points (N, 3) m, even over the parts of the true surface that are seen from some of the lenses (3,)."""
    rng = np.random.default_rng(1)
    corner = surface.mesh.vertices[surface.mesh.faces].astype(np.float64)
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(area, axis=1)
    face = rng.choice(len(corner), POINTS, p=size / size.sum())
    point = np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), POINTS), corner[face])
    seen = np.zeros(POINTS, bool)
    for lens in lenses:
        way = unit(lens - point)
        facing = dot(unit(area[face]), way)
        seen |= (facing > FACING) & ~surface.hidden(point + way * (1e-4 * surface.size), lens)
    return np.asarray(point[seen])


def mean_distance(mesh: ClosedMesh, point: Floats) -> float:
    """Mean distance [m] of points (N, 3) from a mesh."""
    corner = mesh.vertices[mesh.faces].astype(np.float64)
    _, near = cKDTree(corner.mean(axis=1)).query(point, NEAREST)
    repeated = np.repeat(point, NEAREST, axis=0)
    closest = triangles.closest_point(corner[near.ravel()], repeated)
    return float(np.linalg.norm(closest - repeated, axis=1).reshape(len(point), -1).min(axis=1).mean())


def picture(mesh: ClosedMesh) -> Floats:
    """The mesh from three sides and from above, shaded."""
    triangles_ = smooth(mesh.vertices, mesh.faces)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    body = Body(triangles_, Tracer(triangles_), (low + high) / 2, float((high - low).max()))
    shown = [capture(body, pose) for pose in ring(body, 3) + ring(body, 1, 80)]
    shaded = [np.clip(dot(v.normal, np.array([0.4, 0.4, 0.8])) * 200 + 40, 0, 255) * v.mask for v in shown]
    return np.hstack(shaded).astype(np.uint8)


if __name__ == "__main__":
    main()
