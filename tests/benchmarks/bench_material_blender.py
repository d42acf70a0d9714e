"""Blender's render of a material next to the photograph of a view that was left out.

PYTHONPATH=. python tests/benchmarks/bench_material_blender.py SESSION [--view view08]     (needs $POLCAP_BPY)

SESSION is one of `bench_material.py`. The material comes from the other views. Cycles renders its GLB from the pose of
the view that was left out, with a point light at its flash. Prints errors of S0, linear, after one scale, over the mean
of the photograph: median and 95th percentile over the sample without its outer 3 mm, of gray and of the worst color.
"""

import shutil
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from polcap.cli import app, options
from polcap.image_values import Floats
from polcap.material import material_path
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_grid import TO_WORLD, TexelGrid
from polcap.optics.projection import to_grid
from tests.blender import session
from tests.experiments import arguments

SAMPLES, EDGE_M = 64, 0.003


def main() -> None:
    given = arguments(__doc__, "session", view="view08")
    others = given.session.with_name(f"{given.session.name}-without-{given.view}")
    if not others.exists():
        shutil.copytree(given.session, others, ignore=shutil.ignore_patterns(given.view, "material", "without"))
    every, few = (material(folder) for folder in (given.session, others))
    (left_out,) = (view for view in every["views"] if view.name == given.view)
    (file,) = (others / "material" / "asset").glob("*.glb")
    photo, render = photograph(left_out), blender(others, file, left_out, few)
    inside = sample(left_out, few)
    scale = np.median(photo[inside].sum(axis=-1) / render[inside].sum(axis=-1))
    error = (scale * render - photo)[inside] / photo[inside].mean()
    gray, worst = (100 * np.percentile(one, (50, 95)) for one in (abs(error.mean(axis=-1)), abs(error).max(axis=-1)))
    print(f"{given.session.name} {given.view}: {gray.round(1)} %, {worst.round(1)} %", flush=True)
    np.savez(others / "pictures.npz", photograph=photo, render=scale * render, inside=inside)


def material(folder: Path) -> dict[str, Any]:
    """Run `polcap material`; the views, flash, heights and grid that it used."""
    found: dict[str, Any] = {}

    def path(inner: Any, views: Any, chart: Any, board: Any, grid: TexelGrid, *others: Any) -> Any:
        results = inner(views, chart, board, grid, *others)
        found.update(views=views.value, grid=grid, light=results.light, thickness=results.maps.thickness)
        return results

    again = patch.object(options, "print_finished", lambda *_: False)  # else a finished run is not repeated
    with again, patch.object(material_path, "path", partial(path, material_path.path)):
        app(["-q", "material", str(folder), "--out", str(folder / "material")], standalone_mode=False)
    return found


def photograph(view: PosedStokes) -> Floats:
    """S0 (H, W, 3), linear Rec.709."""
    return np.asarray(view.stokes.stokes[0] @ view.matrix.T)


def middle(made: dict[str, Any]) -> Floats:
    """World point (3,) [m] of the middle of a material's plane."""
    grid: TexelGrid = made["grid"]
    x, z = (first + (count - 1) / 2 * grid.texel for first, count in zip(grid.origin, grid.size, strict=True))
    return np.array([x, made["thickness"], z])


def sample(view: PosedStokes, made: dict[str, Any]) -> Any:
    """Pixels (H, W) of a view inside the material's plane."""
    grid: TexelGrid = made["grid"]
    height = np.full(grid.size[::-1], made["thickness"])
    edge = round(EDGE_M / grid.texel)
    x, y = view.pixels(grid.points(height)[edge:-edge, edge:-edge])
    inside = np.zeros(view.stokes.mask.shape, bool)
    inside[np.rint(y).astype(int), np.rint(x).astype(int)] = True
    return inside


def blender(folder: Path, file: Path, view: PosedStokes, made: dict[str, Any]) -> Floats:
    """Cycles' picture (H, W, 3) of a GLB through the camera of a view, with a light at its flash."""
    axes = view.pose.rotation @ TO_WORLD  # rows: the camera's in the frame of the plane
    origin = view.pose.to_camera(middle(made))
    grid = view.stokes.view
    center = [float(to_grid(p, grid.scale) - o) for p, o in zip(view.camera.principal_px, grid.origin, strict=True)]
    height, width = view.stokes.mask.shape
    camera = {
        "focal": view.camera.focal_px / grid.scale, "center": center, "size": [width, height],
        "position": (-origin @ axes).tolist(), "axes": axes.tolist(),
    }  # fmt: skip
    flash = (made["light"].place - origin) @ axes
    (answer,) = session.ask(folder, [file], camera=camera, lights=[flash.tolist()], lamp="POINT", samples=SAMPLES)
    return answer["light 0"]


if __name__ == "__main__":
    main()
