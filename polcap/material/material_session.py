"""Processes the views of a flat sample up to their Stokes parameters: color calibration, board, poses, texel grid.

Views and steps are those of `polcap fuse` (`fusion/session_views.py`, `fusion/view_path.py`); a view that cannot be
used is left out, with the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from polcap.errors import SettingError
from polcap.fusion import each_view, view_path
from polcap.fusion import session as sessions
from polcap.fusion.each_view import Notify
from polcap.fusion.poses import SessionPoses
from polcap.fusion.session_views import Session, SessionInput
from polcap.fusion.values import Pose
from polcap.fusion.view_path import SessionView
from polcap.material import board_focus, stokes_view
from polcap.material.flash_light import ChartInView
from polcap.material.material_path import MaterialConfig
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_grid import TexelGrid
from polcap.optics.board import RING, SQUARES, Board
from polcap.pipeline import run
from polcap.pipeline.cache import DeferredResult, LazyCache, StageResult, together
from polcap.results import ResultsUntilStokes

Region = tuple[float, float, float, float]  # m, left, lower, right, upper side, from the board's middle; y up the page
_MARGIN_M = 0.0015  # between the sample and the border of the board's black middle
_LEAST_TEXELS, _MOST_TEXELS = 8, 8192  # along a side


@dataclass(frozen=True)
class FlatSession:
    """Stokes parameters of the used views of a flat sample, and what they share."""

    views: StageResult[tuple[PosedStokes, ...]]
    names: tuple[str, ...]
    poses: SessionPoses
    chart: ChartInView | None
    board: Board
    grid: TexelGrid
    left_out: Mapping[str, str]  # reason, by view
    tilt_deg: Mapping[str, float]  # between the page's normal and the direction to the lens, by view
    blur_px: Mapping[str, float]  # 1σ of the board's edges, merged px, by view


def process(
    session: Session,
    session_input: SessionInput[MaterialConfig],
    region: Region | None,
    texel: float | None,
    cache: LazyCache,
    notify: Notify,
) -> FlatSession:
    """Process all views; `texel` [m] is the texel's size, by default that of the camera's pixels.

    Raises CaptureError: too few views can be used. ChartError: no view shows the chart. SettingError: the region or
    the texel does not fit the board.
    """
    session = session.with_inputs(lambda view: replace(view, config=stokes_view.of_flat_views(view.config)))
    session = sessions.with_colors(session, notify)
    with each_view.step_runner(session_input, notify) as run_step:
        session, boards = run_step("exposures and board", view_path.find_board, session)
        session, solved = sessions.pose_by_board(session, boards, cache)
        board = solved.board
        assert board is not None
        masked = session.with_inputs(lambda view: _with_mask(view, solved, board))
        masked, keys = run_step("Stokes parameters", stokes_view.solve, masked)
    posed = {name: _posed(view, solved, keys[name], cache) for name, view in masked.views.items()}
    sight = cache.run(board_focus.measure, together(list(posed.values())), board).value
    used = masked.without(board_focus.left_out(tuple(posed), sight))
    names = tuple(used.views)
    return FlatSession(
        views=together([posed[name] for name in names]),
        names=names,
        poses=solved,
        chart=_find_chart([session.views[name] for name in names]),
        board=board,
        grid=make_grid(solved, board, [posed[name] for name in names], names, region, texel),
        left_out=used.left_out,
        tilt_deg={name: _tilt_deg(solved.views[name].pose) for name in names},
        blur_px={name: blur for name, blur in zip(posed, sight.blur, strict=True) if name in names},
    )


def _with_mask(view: SessionView, solved: SessionPoses, board: Board) -> SessionView:
    """The view with a mask in its input: the part of its picture that shows the board."""
    pose = solved.views[view.name].pose
    mask = stokes_view.board_mask(view.capture.size_px, solved.camera, pose, board)
    return replace(view, supplied=replace(view.supplied, mask=mask))


def _posed(view: SessionView, solved: SessionPoses, key: str, cache: LazyCache) -> StageResult[PosedStokes]:
    """Stokes parameters of a view with its pose; they are read when they are needed."""
    results = DeferredResult(key, lambda: run.reopen(view.out, ResultsUntilStokes)[0])
    return cache.derive(posed_stokes, view.name, results, solved, solved.views[view.name].pose)


def posed_stokes(name: str, results: ResultsUntilStokes, solved: SessionPoses, pose: Pose) -> PosedStokes:
    """The Stokes parameters of a view's results, with its pose and the session's camera."""
    return PosedStokes(
        name, results.stokes, np.asarray(results.selfcal.angle), np.asarray(results.color.matrix), pose, solved.camera
    )


def _find_chart(views: Sequence[SessionView]) -> ChartInView | None:
    """The first view that shows the chart, if there is one."""
    for number, view in enumerate(views):
        if view.supplied.chart.mode in ("auto", "corners"):
            color = view_path.find_chart(view)
            if color.place is not None:
                return ChartInView(number, color)
    return None


def _tilt_deg(pose: Pose) -> float:
    """Angle between the page's normal and the direction to the lens [degrees]."""
    return float(np.degrees(np.arccos(pose.center[1] / np.linalg.norm(pose.center))))


def make_grid(
    solved: SessionPoses,
    board: Board,
    views: Sequence[StageResult[PosedStokes]],
    names: Sequence[str],
    region: Region | None,
    texel: float | None,
) -> TexelGrid:
    """Grid of the sample: by default over the board's middle, with texels as large as the nearest view's pixels.

    `region` is left, lower, right, upper [m] from the board's middle, y up; `texel` is in m. Raises SettingError: the
    region reaches beyond the board, or has too few or too many texels.
    """
    half = (SQUARES / 2 - RING) * board.square_m - _MARGIN_M
    left, lower, right, upper = region or (-half, -half, half, half)
    edge = board.page_m[0] / 2
    if not (-edge <= left < right <= edge and -edge <= lower < upper <= edge):
        raise SettingError(
            f"--region {', '.join(f'{1000 * a:g}' for a in (left, lower, right, upper))} mm: x0 < x1 and y0 < y1 must "
            f"lie within ±{1000 * edge:g} mm, the board's page"
        )
    if texel is None:
        nearest = min(float(np.linalg.norm(solved.views[name].pose.translation)) for name in names)
        texel = float(f"{nearest * views[0].value.stokes.view.scale / solved.camera.focal_px:.3g}")
    size = tuple(int(side / texel) for side in (right - left, upper - lower))
    if not _LEAST_TEXELS <= min(size) <= max(size) <= _MOST_TEXELS:
        raise SettingError(
            f"{size[0]} × {size[1]} texels of {1000 * texel:g} mm: {_LEAST_TEXELS} to {_MOST_TEXELS} along a side are "
            "possible; change --texel or --region"
        )
    # the middle of the first texel; rows run down, the region's y runs up
    origin = ((left + right) / 2 - (size[0] - 1) / 2 * texel, -(lower + upper) / 2 - (size[1] - 1) / 2 * texel)
    return TexelGrid(origin, texel, (size[0], size[1]))
