"""Processes all views of a session: one color calibration, one camera, poses, masks, maps. `process` has the order.

The result of a view is in viewNN/polcap; `view_path.py` has its stages. A view that cannot be used is left out, with
the reason; the others go on. Without a board the poses come from features of the maps. Where the object was laid on
another side between sets of views, `joining.py` afterwards moves all sets into the frame of the first one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.errors import CaptureError, ChartError
from polcap.formats.maps import png
from polcap.fusion import each_view, feature_poses, mask_agreement, poses, view_maps, view_path
from polcap.fusion.board_corners import BoardSearch
from polcap.fusion.board_eraser import PosedBoard
from polcap.fusion.each_view import Notify, StepRunner
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.poses import SessionPoses
from polcap.fusion.session_views import Session, SessionInput
from polcap.fusion.silhouettes import Silhouette
from polcap.fusion.values import FusionView, ViewMask
from polcap.fusion.view_path import SessionView
from polcap.pipeline import run
from polcap.pipeline.cache import DeferredResult, LazyCache, StageResult, together
from polcap.pipeline.manifest import digest
from polcap.results import ResultsUntilInfer


@dataclass(frozen=True)
class ProcessedSession:
    """Maps and reports of the used views of a session, and their camera and poses."""

    views: StageResult[tuple[FusionView, ...]]
    poses: SessionPoses
    reports: Mapping[str, Mapping[str, Any]]  # content of report.json, by view
    left_out: Mapping[str, str]  # reason, by view


def process(
    session: Session, session_input: SessionInput[SessionConfig], cache: LazyCache, notify: Notify
) -> ProcessedSession:
    """Process all views of a session; `cache` stores the stages that need all views.

    Raises CaptureError: too few views can be used. ChartError: no view shows the chart.
    """
    session = with_colors(session, notify)
    with each_view.step_runner(session_input, notify) as run_step:
        session, solved, masks = _find_poses_and_masks(session, cache, run_step)
        session = _with_agreed_masks(session, masks, solved, cache)
        session, reports = run_step("maps", view_path.make_maps, session)
    views = [_fusion_view(view, solved, reports[name], cache) for name, view in session.views.items()]
    return ProcessedSession(together(views), solved, reports, session.left_out)


def with_colors(session: Session, notify: Notify) -> Session:
    """Give all other views the color calibration of the first view that shows the chart, as a profile.

    Raises ChartError: no view shows the chart.
    """
    if any(view.supplied.chart.mode != "auto" for view in session.views.values()):
        return session
    for charted, view in session.views.items():
        notify(f"{charted}: chart")
        try:
            profile = replace(view_path.find_chart(view), source="profile", place=None)
            break
        except ChartError:
            continue
    else:
        raise ChartError(
            "no view shows the ColorChecker; show it in one view, give a color profile with --chart, or --no-chart"
        )
    chart = ChartRequest("profile", profile=profile)

    def with_chart(view: SessionView) -> SessionView:
        return view if view.name == charted else replace(view, supplied=replace(view.supplied, chart=chart))

    return session.with_inputs(with_chart)


def _find_poses_and_masks(
    session: Session, cache: LazyCache, run_step: StepRunner
) -> tuple[Session, SessionPoses, dict[str, ViewMask]]:
    """Poses and masks of the views: from the board if a view shows one, else from features of the object.

    Raises CaptureError: too few views can be used, or several sets of views show no board.
    """
    session, boards = run_step("exposures and board", view_path.find_board, session)
    if any(one.corners is not None for one in boards.values()):
        session, solved = pose_by_board(session, boards, cache)
        session, masks = run_step("mask", view_path.find_mask, _with_boards(session, solved))
        return session, solved, masks
    if len(session.folders) > 1:
        raise CaptureError(
            "no view shows a board, which several sets of views need; shoot with the object on the board of "
            "`polcap board`, or fuse one set"
        )
    run_step.notify("no board: poses from features of the object")
    session, features = run_step("first maps", view_path.find_features, session)
    solved = cache.run(feature_poses.solve, features, session.capture).value
    return session.without(solved.left_out), solved, {name: one.mask for name, one in features.items()}


def pose_by_board(
    session: Session, boards: Mapping[str, BoardSearch], cache: LazyCache
) -> tuple[Session, SessionPoses]:
    """Poses of the views from their boards, and the session without views that have no board or no pose.

    Raises CaptureError: too few views are left.
    """
    session = session.without({name: one.missing for name, one in boards.items() if one.corners is None})
    corners = {name: boards[name].corners for name in session.views}
    solved = cache.run(poses.solve, corners, session.capture).value
    return session.without(solved.left_out), solved


def _with_boards(session: Session, solved: SessionPoses) -> Session:
    """The session with the board's place in each view's input, so that the board can be erased there."""
    assert solved.board is not None
    boards = {name: PosedBoard(solved.board, solved.camera, one.pose) for name, one in solved.views.items()}
    return session.with_inputs(lambda view: replace(view, board=boards[view.name]))


def _with_agreed_masks(
    session: Session, masks: Mapping[str, ViewMask], solved: SessionPoses, cache: LazyCache
) -> Session:
    """Give every view its mask without parts that no other view confirms; leave out views that contradict the others.

    Where views contradict each other, the masks are written as pictures for the user to compare.

    Raises CaptureError: too many views contradict the others.
    """
    silhouettes = tuple(
        Silhouette(name, masks[name].mask, solved.camera.reduced(masks[name].scale), solved.views[name].pose)
        for name in session.views
    )
    try:
        agreed = cache.run(mask_agreement.agree, silhouettes).value
    except CaptureError:
        _write_compared(cache.folder, silhouettes)
        raise
    if agreed.left_out:
        _write_compared(cache.folder, silhouettes)
    masked = dict(zip(agreed.names, agreed.masks))
    used = session.without(agreed.left_out)
    return used.with_inputs(lambda view: replace(view, supplied=replace(view.supplied, mask=masked[view.name])))


def _write_compared(out: Path, silhouettes: tuple[Silhouette, ...]) -> None:
    """Write masks as pictures into the result folder `out` of the session."""
    for one in silhouettes:
        name = one.name.replace("/", "-")
        png.write(out / mask_agreement.COMPARED / f"{name}.png", np.where(one.mask, 255, 0).astype(np.uint8))


def _fusion_view(
    view: SessionView, solved: SessionPoses, report: Mapping[str, Any], cache: LazyCache
) -> StageResult[FusionView]:
    """Maps of a processed view with its pose, which are read when they are needed."""
    results = DeferredResult(digest(report["keys"]), lambda: run.reopen(view.out, ResultsUntilInfer)[0])
    pose, undistort = solved.views[view.name].pose, view.config.stokes.undistort
    return cache.derive(view_maps.fusion_view, view.name, results, solved.camera, pose, solved.metric, undistort)
