"""Captures from all sides: one board under the object, seen from every side, with its true poses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from polcap.image_values import Floats, View
from polcap.optics import board as boards
from polcap.optics import frames, projection
from polcap.synth import all_around, laid_board, render
from polcap.synth.all_around import AroundShoot
from polcap.synth.distance_fields import Cluster
from polcap.synth.laid_board import LaidBoard
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material

GREY = Coat((Material((0.6, 0.6, 0.6), (0.6, 0.6, 0.6), "plain", roughness=(0.5, 0.5)),))
PEAR = Scene(shape=Cluster(((0, 0, 0, 0.04), (0.02, 0.04, 0, 0.025))), coat=GREY)
SMALL = AroundShoot(width=288, height=216, exposures=1, samples=1, nudge_px=0.0, nudge_deg=0.0)


def covers(folder: Path, truth: dict[str, Any], view: dict[str, Any], point: Floats) -> bool:
    """Whether points (N, 3) of the world frame project onto the mask of a view, within 1.5 px of its sides."""
    with np.load(folder / view["name"] / "truth.npz") as maps:
        seen = np.argwhere(maps["mask"])[:, ::-1]
    camera = View(truth["focal_px"], tuple(truth["principal_px"]), 1.0)
    place = projection.project(camera, point @ np.array(view["rotation"]).T + view["translation"])
    return bool(np.allclose([place.min(0), place.max(0)], [seen.min(0), seen.max(0)], atol=1.5, rtol=0))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("around") / "session"
    all_around.write(folder, PEAR, SMALL, 3)
    return folder, json.loads((folder / "truth.json").read_text())


def test_every_view_is_a_capture_with_the_exposure_of_the_first_which_has_the_chart(
    session: tuple[Path, dict[str, Any]],
) -> None:
    folder, truth = session
    views = [json.loads((folder / view["name"] / "truth.json").read_text()) for view in truth["views"]]
    for view in views:
        assert [Path(file["file"]).parent.name for file in view["files"]] == ["pol000", "pol045", "pol090"]
    assert [view["chart"] is not None for view in views] == [True, False, False]
    assert len({file["relative_exposure"] for view in views for file in view["files"]}) == 1


def test_the_true_surface_projects_onto_the_true_mask_of_every_view(session: tuple[Path, dict[str, Any]]) -> None:
    folder, truth = session
    with np.load(folder / "truth.npz") as surface:
        vertices, faces = surface["vertices"].astype(float), surface["faces"]
    assert vertices[:, 1].min() == pytest.approx(0, abs=1e-6)  # its lowest point is on the board
    corner = vertices[faces]
    volume = np.sum(corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])) / 6
    assert volume > 0.9 * 4 / 3 * np.pi * 0.04**3  # outward
    assert all(covers(folder, truth, view, vertices) for view in truth["views"])


def test_the_surface_laid_on_its_side_projects_onto_the_masks_of_the_second_set(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    all_around.write(folder, PEAR, replace(SMALL, laid=1), 3)
    truth = json.loads((folder / "truth.json").read_text())
    assert [view["name"] for view in truth["views"]] == ["setA/view01", "setA/view02", "setA/view03", "setB/view01"]
    with np.load(folder / "truth.npz") as surface:
        vertices = surface["vertices"].astype(float)
    laid = vertices @ np.array(truth["laid"]["rotation"]).T + truth["laid"]["translation"]
    assert laid[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert covers(folder, truth, truth["views"][-1], laid)


def test_a_board_seen_from_above_has_its_squares_where_they_project() -> None:
    laid = LaidBoard((0.0, 0.0, -0.7), (90.0, 0.0, 0.0))
    view = View(800.0, (159.5, 119.5), 1.0)
    y, x = np.mgrid[:240, :320].astype(float)
    at, reach, albedo = laid_board.intersect(laid, frames.rays_at(view, x, y).reshape(-1, 3))
    picture = np.full(x.size, np.nan)
    picture[at] = albedo[:, 0]
    board = boards.BOARDS["A4"]
    cell = board.square_m / boards.CELLS
    for row, column in ((0, 0), (0, 9), (12, 20), (63, 63), (32, 32)):
        px = 159.5 + ((column + 0.5) * cell - board.side_m / 2) * 800 / 0.7
        py = 119.5 + ((row + 0.5) * cell - board.side_m / 2) * 800 / 0.7
        assert (picture.reshape(240, 320)[round(py), round(px)] < 0.1) == boards.ink(board)[row, column]
    assert reach.min() == pytest.approx(0.7, abs=0.01)


def test_the_object_hides_and_shades_the_board() -> None:
    laid = LaidBoard((0.0, -0.03, -0.7), (25.0, 0.0, 0.0))
    place = {"position": (0.0, 0.0, -0.7), "light": (0.3, 0.3, 0.0)}
    scene = replace(PEAR, **place, chart=None, board=laid, cast_shadows=True)
    view = View(600.0, (159.5, 119.5), 1.0)
    y, x = np.mgrid[:240, :320].astype(float)
    with_object = render.stokes(scene, view, x, y)[0, ..., 1]
    away = replace(scene, position=(0.0, 3.0, -0.7))
    mask = render.gbuffer(scene, view, 240, 320).mask
    bare = render.stokes(away, view, x, y)[0, ..., 1]
    shadow = ~mask & (with_object == 0) & (bare > 0)
    assert shadow.sum() > 100
    assert mask.sum() > 1000
