"""Faults of one view in a fusion: what the report names, which views are left out, and errors of the fused object.

python tests/benchmarks/bench_fusion_faults.py FOLDER

FOLDER is new. Twelve small views of a generated object are simulated, as by `polcap synth FOLDER/session --views 12
--seed 0 --set width=480 --set height=360 --set samples=1 --set exposures=1`. For each fault, view05 of a copy is
changed and the copy is fused. Prints the mean distance of the seen truth from the mesh [% of the object's size], the
mean errors of the fused normals and of the albedo, and the gate on views with those that do not pass, or the error.
"""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import bench_fused_asset
import cv2
import msgspec
import numpy as np

from polcap.errors import InputError
from polcap.fusion import fuse_run
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.session_views import SessionInput
from polcap.image_values import Bools, Floats
from polcap.optics import projection
from polcap.optics.board import BOARDS
from polcap.pipeline.cache import silent
from polcap.pipeline.request import Request
from polcap.synth import all_around, shooting
from polcap.synth.all_around import AroundShoot, ObjectPose
from polcap.synth.laid_board import LaidBoard
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import ShotPose, Studio

VIEW = "view05"
SHOOT = AroundShoot(seed=0, width=480, height=360, samples=1, exposures=1)
EDGE = 0.02  # m, of the page, which stays visible where the board is hidden


class ChangedStudio(Studio):
    """A studio whose pictures hold `light` (H, W, 3), or nothing, in some pixels."""

    hidden: Bools  # (H, W)
    light: Callable[[ShotPose], Floats] | None = None

    def radiance(self, pose: ShotPose, crossed: bool = False) -> Floats:
        other = self.light(pose) if self.light else 0.0
        return np.where(self.hidden[..., None], other, super().radiance(pose, crossed))


def main(folder: Path) -> None:
    session = folder / "session"
    all_around.write(session, random_scene(0, "bumps"), SHOOT, 12)
    print("| fault | mesh % | normals ° | albedo | outcome |\n| --- | --- | --- | --- | --- |")
    for fault, change in FAULTS.items():
        copy = folder / fault.replace(" ", "_")
        shutil.copytree(session, copy)
        change(copy / VIEW)
        print(f"| {fault} | {outcome(copy)} |", flush=True)


def outcome(folder: Path) -> str:
    """Cells of a session's row."""
    session_input = SessionInput(folder, SessionConfig(), Request(threads=1))
    try:
        about = fuse_run.fuse(session_input, folder / "fused", lambda _: None, silent)
    except InputError as error:
        return f"– | – | – | refused: {error}"
    found = bench_fused_asset.errors(folder)
    shown = [gate for gate in about["gates"] if gate["name"] == "views" or gate["state"] != "pass"]
    named = "; ".join(f"{gate['name']}: {gate['says']}" for gate in shown)
    normal, albedo = found.fused[:, :2].mean(axis=0)
    return f"{100 * found.distance:.2f} | {normal:.2f} | {albedo:.4f} | {named}"


def scene_of(view: Path) -> Scene:
    return msgspec.convert(json.loads((view / "truth.json").read_text())["scene"], Scene)


def board_of(scene: Scene) -> LaidBoard:
    assert isinstance(scene.board, LaidBoard)
    return scene.board


def studio_of(view: Path, scene: Scene) -> ChangedStudio:
    """The studio of a view with another scene, which hides nothing yet."""
    about = json.loads((view / "truth.json").read_text())
    exposure = about["files"][0]["relative_exposure"]
    studio = ChangedStudio(scene, msgspec.convert(about["shoot"], AroundShoot), exposure)
    studio.hidden = np.zeros_like(studio.buffer.mask)
    return studio


def write(view: Path, studio: Studio) -> None:
    """Photograph a view again."""
    shutil.rmtree(view)
    shooting.write_capture(view, studio)


def swap_angles(view: Path) -> None:
    (view / "pol045").rename(view / "pol")
    (view / "pol090").rename(view / "pol045")
    (view / "pol").rename(view / "pol090")


def hide_left_half(object_too: bool) -> Callable[[Path], None]:
    def change(view: Path) -> None:
        studio = studio_of(view, scene_of(view))
        studio.hidden = ~studio.buffer.mask | object_too
        studio.hidden[:, SHOOT.width // 2 :] = False
        write(view, studio)

    return change


def hide_board(view: Path) -> None:
    """Lay a black cloth around the object, up to the edge of the page."""
    studio = studio_of(view, scene_of(view))
    studio.hidden = page(studio, EDGE) & ~studio.buffer.mask
    write(view, studio)


def add_board(view: Path) -> None:
    """Put a second board behind the first one, on the same table."""
    scene = scene_of(view)
    studio, laid = studio_of(view, scene), board_of(scene)
    behind = tuple((np.array(laid.position) + BOARDS[laid.size].page_m[0] * backwards(scene)).tolist())
    moved = msgspec.structs.replace(scene, board=msgspec.structs.replace(laid, position=behind))
    studio.hidden = ~page(studio, 0.0) & ~studio.buffer.mask
    studio.light = studio_of(view, moved).radiance
    write(view, studio)


def page(studio: Studio, margin_m: float) -> Bools:
    """Pixels (H, W) of the board's page without a margin, as if nothing were on it."""
    laid = board_of(studio.scene)
    corner = (BOARDS[laid.size].page_m[0] / 2 - margin_m) * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    at = projection.project(studio.shoot.view, laid.turn.apply(corner) + laid.position)
    out = np.zeros(studio.buffer.mask.shape, np.uint8)
    cv2.fillConvexPoly(out, np.rint(at).astype(np.int32), 1)
    return out > 0


def backwards(scene: Scene) -> Floats:
    """Unit vector (3,) on the board, away from the lens, before a camera that does not roll; camera frame."""
    return np.cross(board_of(scene).normal, [1.0, 0.0, 0.0])


def slide(share: float, away: bool) -> Callable[[Path], None]:
    """Slide the object by a share of its size, away from the lens or to the right."""

    def change(view: Path) -> None:
        scene = scene_of(view)
        way = backwards(scene) if away else np.array([1.0, 0.0, 0.0])
        size = np.ptp(all_around.surface(scene).vertices, axis=0).max()
        position = tuple((np.array(scene.position) + share * size * way).tolist())
        write(view, studio_of(view, msgspec.structs.replace(scene, position=position)))

    return change


def repeat_view(view: Path) -> None:
    shutil.rmtree(view)
    shutil.copytree(view.with_name("view04"), view)


def turn_over(view: Path) -> None:
    """Lay the object on its side."""
    scene = scene_of(view)
    laid, placed = board_of(scene), ObjectPose(all_around.surface(scene), all_around._LAID)
    turned = all_around._view(scene, SHOOT, laid.turn, np.array(laid.position), placed)
    write(view, studio_of(view, msgspec.structs.replace(turned, chart=None)))


FAULTS: dict[str, Callable[[Path], None]] = {
    "none": lambda view: None,
    "view missing": shutil.rmtree,
    "shot missing": lambda view: shutil.rmtree(view / "pol045"),
    "angles swapped": swap_angles,
    "left half black": hide_left_half(object_too=True),
    "left half black but for the object": hide_left_half(object_too=False),
    "board hidden but for its edges": hide_board,
    "second board": add_board,
    "slid by 13 % across": slide(0.13, away=False),
    "slid by 13 % away": slide(0.13, away=True),
    "slid by 30 % across": slide(0.3, away=False),
    "slid by 30 % away": slide(0.3, away=True),
    "view twice": repeat_view,
    "object turned over": turn_over,
}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
