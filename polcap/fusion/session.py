"""Processes all views of a session: one color calibration, one camera, poses, masks, maps.

Each view is a capture that `polcap process` takes, with its result in viewNN/polcap; `view_path.py` has its stages. A
view that cannot be used is left out, with the reason; the others go on. Between sets of views (setA/view01 …,
setB/view01 …) the object was laid on another side; `joining.py` gives them one frame later. Without a board the poses
come from features of the maps.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest, ColorCalibration
from polcap.config import Config
from polcap.errors import CaptureError, ChartError, SettingError
from polcap.formats import own_folders
from polcap.formats.capture import folder_names
from polcap.formats.maps import png
from polcap.fusion import each_view, feature_poses, mask_agreement, poses, view_maps, view_path
from polcap.fusion.board_corners import BoardSearch
from polcap.fusion.board_eraser import PosedBoard
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.poses import LEAST_VIEWS, SessionPoses
from polcap.fusion.silhouettes import Silhouette
from polcap.fusion.values import FusionView, ViewMask
from polcap.fusion.view_path import SessionView
from polcap.pipeline import result_folder, run
from polcap.pipeline.cache import DeferredResult, LazyCache, Progress, StageResult, digest
from polcap.pipeline.request import Request
from polcap.process_pool import Limits, ProcessPool

Notify = Callable[[str], None]  # is called with a line on the step that is done
R = TypeVar("R")
C = TypeVar("C", bound=Config)


@dataclass(frozen=True)
class SessionInput(Generic[C]):
    """A session's folder and settings, and the request that is the same for all its views."""

    folder: Path
    config: C
    request: Request  # of each view; threads and memory are limits of each process
    workers: int = 1  # views at a time, each in a process


@dataclass(frozen=True)
class Session:
    """The views that can be used, by name, and the reasons why others are left out."""

    views: Mapping[str, SessionView]
    left_out: Mapping[str, str]

    @property
    def folders(self) -> list[str]:
        """Folders of the sets of views, such as setA; one empty name if there are no sets."""
        return list(dict.fromkeys(name.rpartition("/")[0] for name in sorted([*self.views, *self.left_out])))

    @property
    def capture(self) -> Capture:
        """Capture of the first view, for the geometry of the camera of all."""
        return next(iter(self.views.values())).capture

    def without(self, reasons: Mapping[str, str]) -> "Session":
        """The session without some views.

        Raises CaptureError: too few views of a set are left.
        """
        used = {name: view for name, view in self.views.items() if name not in reasons}
        left = Session(used, {**self.left_out, **reasons})
        for folder in left.folders:
            count = sum(name.rpartition("/")[0] == folder for name in used)
            if count < LEAST_VIEWS:
                listed = "; ".join(f"{name}: {reason}" for name, reason in left.left_out.items())
                raise CaptureError(
                    f"{count} views {f'of {folder} ' * bool(folder)}can be used, {LEAST_VIEWS} are needed"
                    + (f" ({listed})" if listed else "")
                    + "; shoot more, 12 for a simple shape, 9 for a flat sample"
                )
        return left

    def with_inputs(self, change: Callable[[SessionView], SessionView]) -> "Session":
        """The session with other inputs of its views."""
        return Session({name: change(view) for name, view in self.views.items()}, self.left_out)


def shots(captures: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Facts of all shots, with files named from the session's folder; `captures` are the facts of each view."""
    return [
        {**shot, "frames": [{**frame, "file": f"{view}/{frame['file']}"} for frame in shot["frames"]]}
        for view, capture in captures.items()
        for shot in capture["shots"]
    ]


@dataclass(frozen=True)
class ProcessedSession:
    """Maps and reports of the used views of a session, and their camera and poses."""

    views: StageResult[tuple[FusionView, ...]]
    poses: SessionPoses
    reports: Mapping[str, Mapping[str, Any]]  # content of report.json, by view
    left_out: Mapping[str, str]  # reason, by view


@dataclass(frozen=True)
class StepRunner:
    """Runs a step on all views of a session, and reports it."""

    pool: ProcessPool | None
    notify: Notify

    def __call__(self, step: str, work: Callable[[SessionView], R], session: Session) -> tuple[Session, dict[str, R]]:
        """Results of the step by view, and the session without the views in which it failed.

        Raises CaptureError: too few views are left.
        """
        done = partial(self._report, step)
        results, failed = each_view.run(work, session.views, self.pool, done)
        return session.without(failed), results

    def _report(self, step: str, name: str) -> None:
        self.notify(f"{name}: {step}")


@contextmanager
def opened(session_input: SessionInput[Any], out: Path, progress: Progress) -> Iterator[tuple[Session, LazyCache]]:
    """Context manager: the views of a session, and the cache of its result folder `out`, which is locked.

    Raises SettingError: there is no such folder, or `out` is not allowed. CaptureError: there are too few views.
    StorageError: `out` is locked.
    """
    session = read(session_input)  # first: a folder without views stays as it is
    for view in folder_names.session_views(session_input.folder):
        result_folder.check(out, session_input.folder / view)
    with result_folder.locked(out):
        yield session, LazyCache(out, progress)


def read(session_input: SessionInput[Any]) -> Session:
    """Read the captures of all folders view…/ and set…/view…/; nothing is written.

    Raises SettingError: there is no such folder. CaptureError: there are too few views.
    """
    folder, request = session_input.folder, session_input.request
    if not folder.is_dir():
        raise SettingError(f"{folder}: no such folder; give the folder that holds view01, view02, …")
    names = folder_names.session_views(folder)
    if not names:
        raise CaptureError(f"{folder} holds no views; put each capture into a folder view01, view02, …")
    supplied = request.supplied()
    views, left_out = dict[str, SessionView](), dict[str, str]()
    seen: dict[str, str] = {}  # name of the view, by digest of a photograph
    for name in names:
        try:
            capture = request.read(folder / name)
        except each_view.FAULTS as error:
            left_out[name] = each_view.reason(error, str(folder / name))
            continue
        photographs = [frame.digest for shot in capture.shots for frame in shot.frames]
        if earlier := next((seen[digest] for digest in photographs if digest in seen), None):
            left_out[name] = f"holds photographs of {earlier}"
            continue
        views[name] = SessionView(name, capture, supplied, request.config, folder / name / own_folders.OUTPUT)
        seen |= dict.fromkeys(photographs, name)
    return Session(views, {}).without(left_out)


def process(
    session: Session, session_input: SessionInput[SessionConfig], cache: LazyCache, notify: Notify
) -> ProcessedSession:
    """Process all views of a session; `cache` stores the stages that need all views.

    Raises CaptureError: too few views can be used. ChartError: no view shows the chart.
    """
    session = with_colors(session, notify)
    with process_pool(session_input) as pool:
        run_step = StepRunner(pool, notify)
        session, solved, masks = _find_poses_and_masks(session, cache, run_step)
        session = _with_agreed_masks(session, masks, solved, cache)
        session, reports = run_step("maps", view_path.make_maps, session)
    views = tuple(_fusion_view(view, solved, reports[name], cache) for name, view in session.views.items())
    together = DeferredResult(digest([view.key for view in views]), lambda: tuple(view.value for view in views))
    return ProcessedSession(together, solved, reports, session.left_out)


@contextmanager
def process_pool(session_input: SessionInput[Any]) -> Iterator[ProcessPool | None]:
    """Context manager: the child processes of `workers`; None if there is one worker."""
    if session_input.workers == 1:
        yield None
        return
    limits = Limits(session_input.request.threads, session_input.request.memory_gb)
    with ProcessPool(session_input.workers, each_view.RETRIES, limits) as pool:
        yield pool


def with_colors(session: Session, notify: Notify) -> Session:
    """Give all other views the color calibration of the first view that shows the chart, as a profile.

    Raises ChartError: no view shows the chart.
    """
    if any(view.supplied.chart.mode != "auto" for view in session.views.values()):
        return session
    charted, profile = _find_chart(session, notify)
    chart = ChartRequest("profile", profile=profile)

    def with_chart(view: SessionView) -> SessionView:
        return view if view.name == charted else replace(view, supplied=replace(view.supplied, chart=chart))

    return session.with_inputs(with_chart)


def _find_chart(session: Session, notify: Notify) -> tuple[str, ColorCalibration]:
    """The first view that shows the chart, and its color calibration as a profile. Raises ChartError: none shows it."""
    for name, view in session.views.items():
        notify(f"{name}: chart")
        try:
            return name, replace(view_path.find_chart(view), source="profile", place=None)
        except ChartError:
            continue
    raise ChartError(
        "no view shows the ColorChecker; show it in one view, give a color profile with --chart, or --no-chart"
    )


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
    """The session with the board before each view."""
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
    silhouettes = tuple(_silhouette(name, masks[name], solved) for name in session.views)
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


def _silhouette(name: str, found: ViewMask, solved: SessionPoses) -> Silhouette:
    """The mask of a view, which is on its merged picture, with the session's camera in merged px."""
    return Silhouette(name, found.mask, solved.camera.reduced(found.scale), solved.views[name].pose)


def _write_compared(out: Path, silhouettes: tuple[Silhouette, ...]) -> None:
    """Write masks as pictures; StorageError."""
    for one in silhouettes:
        name = one.name.replace("/", "-")
        png.write(out / mask_agreement.COMPARED / f"{name}.png", np.where(one.mask, 255, 0).astype(np.uint8))


def _fusion_view(
    view: SessionView, solved: SessionPoses, report: Mapping[str, Any], cache: LazyCache
) -> StageResult[FusionView]:
    """Maps of a processed view with its pose, which are read when they are needed."""
    results = DeferredResult(digest(report["keys"]), lambda: run.reopen(view.out, "infer")[0])
    undistort = view.config.stokes.undistort
    pose = solved.views[view.name].pose
    return cache.derive(view_maps.fusion_view, view.name, results, solved.camera, pose, solved.metric, undistort)
