"""A session goes on without the views that cannot be used, and says why each is left out."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.formats.capture import reader
from polcap.fusion import fuse_run
from polcap.fusion import session as sessions
from polcap.fusion.board_corners import BoardCorners
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.session import Session, SessionInput
from polcap.pipeline import run as pipeline
from polcap.pipeline.cache import silent
from polcap.pipeline.path import UserInput
from polcap.quality import fused_object
from polcap.quality.limits import FusedGateLimits
from tests.fusion import board_views

SWAPPED = {"name": "order", "state": "fail", "says": "90°, 45°, 0° fit better", "remedy": "rename the folders"}


def session_of(folder: Path, *names: str) -> SessionInput:
    for name in names:
        (folder / name).mkdir()
    return SessionInput(folder, SessionConfig())


def test_a_view_that_lacks_a_shot_is_left_out_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(folder: Path, *_: Any) -> Any:
        if folder.name == "view03":
            raise CaptureError(f"{folder}: 2 different polarizer angles where 3 are needed; add the missing shot")
        return board_views.capture()

    monkeypatch.setattr(reader, "read", read)
    found = sessions.read(session_of(tmp_path, "view01", "view02", "view03", "view05"))  # view04 was never shot
    assert found.used == ["view01", "view02", "view05"]
    assert found.left_out == {"view03": "2 different polarizer angles where 3 are needed; add the missing shot"}


def test_a_copy_of_a_view_is_left_out(tmp_path: Path) -> None:
    for view in (1, 2, 3, 4):
        for angle in (0, 45, 90):
            photo = tmp_path / f"view{view:02d}/pol{angle:03d}/photo.png"
            photo.parent.mkdir(parents=True)
            photo.write_bytes(cv2.imencode(".png", np.full((8, 8, 3), view + angle, np.uint16))[1].tobytes())
    shutil.copytree(tmp_path / "view02", tmp_path / "view05")
    found = sessions.read(SessionInput(tmp_path, SessionConfig()))
    assert found.used == ["view01", "view02", "view03", "view04"]
    assert found.left_out == {"view05": "holds photographs of view02"}


def test_a_missing_number_of_a_view_is_in_the_report() -> None:
    gate = fused_object.views([f"view{number:02d}" for number in range(1, 13) if number != 5], {}, FusedGateLimits())
    assert gate.message == "All 11 views are used; no folder view05"


def test_three_views_are_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "read", lambda *_: board_views.capture())
    with pytest.raises(CaptureError, match="2 views can be used, 3 are needed"):
        sessions.read(session_of(tmp_path, "view01", "view02"))


def test_a_folder_without_views_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "pol000").mkdir()
    with pytest.raises(CaptureError, match="holds no views"):
        fuse_run.fuse(session_of(tmp_path), tmp_path / "fused", lambda _: None, silent)
    assert [path.name for path in tmp_path.iterdir()] == ["pol000"]


def test_a_view_with_swapped_angles_is_left_out_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("view01", "view02", "view03", "view04")
    found = Session({name: board_views.capture() for name in names}, supplied={name: UserInput() for name in names})

    def process(_: Any, __: Any, ___: Any, out: Path) -> dict[str, Any]:
        return {"gates": [SWAPPED] if out.parent.name == "view02" else []}

    monkeypatch.setattr(pipeline, "process", process)
    made = found.each(sessions._make_maps, sessions._tasks(found, session_of(tmp_path)), None, lambda _: None)
    assert found.left_out == {"view02": "90°, 45°, 0° fit better. rename the folders"}
    assert list(made) == found.used == ["view01", "view03", "view04"]


def test_several_sets_need_the_board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"set{letter}/view0{k}" for letter in "AB" for k in (1, 2, 3)]
    found = Session({name: board_views.capture() for name in names}, supplied={name: UserInput() for name in names})
    monkeypatch.setattr(sessions, "_find_board", lambda task: "no board is visible")
    with pytest.raises(CaptureError, match="several sets of views need"):
        sessions._find_boards(found, session_of(tmp_path), None, lambda _: None)


def test_a_view_without_the_board_that_others_show_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"view0{k}" for k in (1, 2, 3, 4)]
    found = Session({name: board_views.capture() for name in names}, supplied={name: UserInput() for name in names})
    corners = BoardCorners(board_views.BOARD, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
    monkeypatch.setattr(
        sessions, "_find_board", lambda task: "no board is visible" if task.name == "view03" else corners
    )
    boards = sessions._find_boards(found, session_of(tmp_path), None, lambda _: None)
    assert list(boards) == found.used == ["view01", "view02", "view04"]
    assert found.left_out == {"view03": "no board is visible"}
