"""A session goes on without the views that cannot be used, and says why each is left out."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from polcap.config import Config
from polcap.errors import CaptureError
from polcap.formats.capture import reader
from polcap.formats.maps import png
from polcap.fusion import fuse_run, mask_agreement, poses, session_views, view_path
from polcap.fusion import session as sessions
from polcap.fusion.board_corners import BoardCorners, BoardSearch
from polcap.fusion.each_view import StepRunner
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.mask_agreement import AgreedMasks
from polcap.fusion.poses import PosedView, SessionCamera, SessionPoses
from polcap.fusion.session_views import Session, SessionInput
from polcap.fusion.values import ViewMask
from polcap.fusion.view_path import SessionView
from polcap.pipeline import run
from polcap.pipeline.cache import LazyCache, silent
from polcap.pipeline.path import UserInput
from polcap.pipeline.request import Request
from polcap.quality import flat_sample, fused_object
from polcap.quality.limits import FusedGateLimits, MaterialGateLimits
from polcap.stages import Stage
from tests.fusion import board_views

SWAPPED = {"name": "order", "state": "fail", "says": "90°, 45°, 0° fit better", "remedy": "rename the folders"}
ANALYTIC = Request(estimator="analytic")
SILENT = StepRunner(None, lambda _: None)


def session_of(folder: Path, *names: str) -> SessionInput[SessionConfig]:
    for name in names:
        (folder / name).mkdir()
    return SessionInput(folder, SessionConfig(), ANALYTIC)


def test_a_view_that_lacks_a_shot_is_left_out_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(folder: Path, *_: Any) -> Any:
        if folder.name == "view03":
            raise CaptureError(f"{folder}: 2 different polarizer angles where 3 are needed; add the missing shot")
        return board_views.capture()

    monkeypatch.setattr(reader, "read", read)
    found = session_views.read(session_of(tmp_path, "view01", "view02", "view03", "view05"))  # view04 was never shot
    assert list(found.views) == ["view01", "view02", "view05"]
    assert found.left_out == {"view03": "2 different polarizer angles where 3 are needed; add the missing shot"}


def test_a_copy_of_a_view_is_left_out(tmp_path: Path) -> None:
    for view in (1, 2, 3, 4):
        for angle in (0, 45, 90):
            photo = tmp_path / f"view{view:02d}/pol{angle:03d}/photo.png"
            photo.parent.mkdir(parents=True)
            photo.write_bytes(cv2.imencode(".png", np.full((8, 8, 3), view + angle, np.uint16))[1].tobytes())
    shutil.copytree(tmp_path / "view02", tmp_path / "view05")
    found = session_views.read(SessionInput(tmp_path, SessionConfig(), ANALYTIC))
    assert list(found.views) == ["view01", "view02", "view03", "view04"]
    assert found.left_out == {"view05": "holds photographs of view02"}


def test_a_missing_number_of_a_view_is_in_the_report() -> None:
    names = [f"view{number:02d}" for number in range(1, 13) if number != 5]
    gates = fused_object.views(names, {}, FusedGateLimits()), flat_sample.views(names, {}, MaterialGateLimits())
    assert [gate.message for gate in gates] == 2 * ["All 11 views are used; no folder view05"]


def test_three_views_are_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "read", lambda *_: board_views.capture())
    with pytest.raises(CaptureError, match="2 views can be used, 3 are needed"):
        session_views.read(session_of(tmp_path, "view01", "view02"))


def test_a_folder_without_views_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "pol000").mkdir()
    with pytest.raises(CaptureError, match="holds no views"):
        fuse_run.fuse(session_of(tmp_path), tmp_path / "fused", lambda _: None, silent)
    assert [path.name for path in tmp_path.iterdir()] == ["pol000"]


def session(names: Iterable[str], out: Path = Path("object")) -> Session:
    """A session of views without photographs."""
    made = {name: SessionView(name, board_views.capture(), UserInput(), Config(), out / name) for name in names}
    return Session(made, {})


def test_a_view_with_swapped_angles_is_left_out_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def process(_: Any, __: Any, ___: Any, out: Path) -> dict[str, Any]:
        return {"gates": [SWAPPED] if out.name == "view02" else []}

    monkeypatch.setattr(run, "process_once", process)
    found, made = SILENT("maps", view_path.make_maps, session(("view01", "view02", "view03", "view04")))
    assert found.left_out == {"view02": "90°, 45°, 0° fit better. rename the folders"}
    assert list(made) == list(found.views) == ["view01", "view03", "view04"]


def test_several_sets_need_the_board(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(view_path, "find_board", lambda view: BoardSearch(None, 0))
    names = [f"set{letter}/view0{k}" for letter in "AB" for k in (1, 2, 3)]
    with pytest.raises(CaptureError, match="several sets of views need"):
        sessions._find_poses_and_masks(session(names), LazyCache(tmp_path), SILENT)


def test_a_view_without_the_board_that_others_show_is_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    corners = BoardCorners(board_views.BOARD, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
    asked: dict[str, Any] = {}

    def solve(boards: dict[str, Any], capture: Any) -> SessionPoses:
        asked.update(boards)
        raise CaptureError("asked")

    monkeypatch.setattr(
        view_path, "find_board", lambda view: BoardSearch(None if view.name == "view03" else corners, 0)
    )
    monkeypatch.setattr(poses, "solve", Stage(solve, 1, True))
    with pytest.raises(CaptureError, match="asked"):
        sessions._find_poses_and_masks(session(f"view0{k}" for k in (1, 2, 3, 4)), LazyCache(tmp_path), SILENT)
    assert list(asked) == ["view01", "view02", "view04"]


def test_views_whose_masks_contradict_each_other_are_written_for_comparison(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def agree(views: Any) -> AgreedMasks:
        raise CaptureError("the masks of 3 of 3 views contradict the others")

    monkeypatch.setattr(mask_agreement, "agree", Stage(agree, 1, True))
    names = [f"setA/view0{k}" for k in (1, 2, 3)]
    camera = SessionCamera(board_views.FOCAL, 1.0, board_views.VIEW.center, 0.0, 0.0)
    posed = tuple(PosedView(name, board_views.pose(0), 20, 0.1, 0.1) for name in names)
    masks = {name: ViewMask(np.eye(4, dtype=bool), 2.0) for name in names}
    with pytest.raises(CaptureError, match="contradict"):
        sessions._with_agreed_masks(session(names), masks, SessionPoses(camera, posed, {}), LazyCache(tmp_path))
    pictures = sorted((tmp_path / mask_agreement.COMPARED).iterdir())
    assert [file.name for file in pictures] == [f"setA-view0{k}.png" for k in (1, 2, 3)]
    assert np.array_equal(png.read(pictures[0]) > 127, np.eye(4, dtype=bool))
