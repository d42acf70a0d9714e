"""Processes all views of a session: one color calibration, one camera, poses, masks, maps.

Each view is a capture that `polcap process` takes, with its result in viewNN/polcap. A view that cannot be used is left
out, with the reason; the others go on. Between sets of views (setA/view01 …, setB/view01 …) the object was laid on
another side; `joining.py` gives them one frame later. Without a board the poses come from features of the maps.
"""

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from polcap.batch.processes import UNLIMITED, Died, Limits, ProcessPool
from polcap.config import Config
from polcap.errors import (
    AlignmentError,
    CaptureError,
    ChartError,
    DecodeError,
    InputError,
    ObjectError,
    SettingError,
)
from polcap.formats import onnx, own_folders
from polcap.formats.capture import folder_names, reader
from polcap.formats.maps import png
from polcap.fusion import board_corners, bright_parts, feature_poses, mask_agreement, mask_border, poses, view_maps
from polcap.fusion.board_corners import BoardCorners, NoBoardError
from polcap.fusion.board_eraser import erase
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.poses import LEAST_VIEWS, SessionCamera, SessionPoses
from polcap.fusion.silhouettes import Silhouette
from polcap.fusion.values import FusionView, Pose
from polcap.images import Bools, Capture, ChartRequest, Network
from polcap.optics.board import Board
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import AUTO, UserInput
from polcap.results import Results
from polcap.stages import mask
from polcap.stages.mask import regions

_REFUSED = ("order",)  # gates of a view whose failure makes its normals wrong everywhere
_RETRIES = 1  # of a view, if its process died
# faults of a view, without which the others go on; settings, models and the disk are common to all
_FAULTS = (CaptureError, DecodeError, ChartError, AlignmentError, ObjectError)
Notify = Callable[[str], None]  # is called with a line on the step that is done
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class SessionInput:
    """A session's folder, and options for all its views."""

    folder: Path
    config: SessionConfig
    chart: ChartRequest = AUTO
    network: Network | None = None
    mask_network: Network | None = None
    angles_deg: tuple[float, ...] | None = None
    clockwise: bool = False
    workers: int = 1  # views at a time, each in a process
    limits: Limits = UNLIMITED  # of each of these processes


@dataclass(frozen=True)
class ViewTask:
    """A view, and what is needed to run the path of captures on it in another process."""

    name: str
    capture: Capture
    supplied: UserInput
    config: Config
    out: Path


@dataclass(frozen=True)
class MaskTask:
    """A view in which the object is searched, with the board in it."""

    view: ViewTask
    board: Board
    camera: SessionCamera
    pose: Pose


@dataclass
class Session:
    """The captures of a session, what is supplied to each, and which views are left out."""

    captures: dict[str, Capture]  # by name of the view
    left_out: dict[str, str] = field(default_factory=dict)  # reason, by name of the view
    supplied: dict[str, UserInput] = field(default_factory=dict)  # color calibration, networks and, at the end, mask

    def leave_out(self, reasons: Mapping[str, str]) -> None:
        """Leave out views, by name.

        Raises CaptureError: too few are left.
        """
        self.left_out |= {name: reason.removeprefix(f"{name}: ") for name, reason in reasons.items()}
        self.require_views()

    def require_views(self) -> None:
        """Raise a CaptureError if too few views of a set can be used."""
        for folder, used in self.sets.items():
            if len(used) < LEAST_VIEWS:
                reasons = "; ".join(f"{name}: {reason}" for name, reason in self.left_out.items())
                raise CaptureError(
                    f"{len(used)} views {f'of {folder} ' * bool(folder)}can be used, {LEAST_VIEWS} are needed"
                    + (f" ({reasons})" if reasons else "")
                    + "; shoot more, 12 for a simple shape"
                )

    def each(
        self, work: Callable[[T], R], tasks: Mapping[str, T], pool: ProcessPool | None, done: Notify
    ) -> dict[str, R]:
        """Do some work on views, by name; a view for which it fails is left out. `done` is called with each name."""
        outcomes = {}
        for name, outcome in _outcomes(work, tasks, pool):
            outcomes[name] = outcome
            done(name)
        found = {}
        for name in tasks:  # in their order, not in that of their ends
            outcome = outcomes[name]
            if isinstance(outcome, _FAULTS):
                self.left_out[name] = _reason(name, outcome)
            elif isinstance(outcome, Exception):
                raise outcome
            elif isinstance(outcome, Died):
                raise SettingError(
                    f"{name}: its process died {outcome.attempts} times, most often from lack of memory; "
                    "run fewer --workers"
                )
            else:
                found[name] = outcome
        return found

    @property
    def used(self) -> list[str]:
        """Names of the views that are not left out."""
        return [name for name in self.captures if name not in self.left_out]

    @property
    def sets(self) -> dict[str, list[str]]:
        """Used views by the folder of their set, which is empty for views without one."""
        found: dict[str, list[str]] = {}
        for name in self.captures:
            names = found.setdefault(name.rpartition("/")[0], [])
            if name not in self.left_out:
                names.append(name)
        return found


@dataclass(frozen=True)
class ProcessedSession:
    """Maps and reports of the used views of a session, and their camera and poses."""

    views: tuple[FusionView, ...]
    poses: SessionPoses
    reports: Mapping[str, Mapping[str, Any]]  # content of report.json, by view
    left_out: Mapping[str, str]  # reason, by view


def _outcomes(
    work: Callable[[T], R], tasks: Mapping[str, T], pool: ProcessPool | None
) -> Iterator[tuple[str, R | Exception | Died]]:
    """Name and outcome of each task, in child processes or one after the other."""
    if pool is not None:
        for (name, _), outcome in pool.run(partial(_outcome, work), list(tasks.items())):
            yield name, outcome
        return
    for name, task in tasks.items():
        try:
            yield name, work(task)
        except _FAULTS as error:
            yield name, error


def _outcome(work: Callable[[T], R], named: tuple[str, T], _: int) -> R | Exception:
    """Result of a task, or its error with a traceback for the process that raises it again."""
    try:
        return work(named[1])
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error


def _reason(name: str, error: InputError) -> str:
    """Why a view is left out, without its name or folder."""
    return str(error).removeprefix(f"{name}: ")


def out_of(folder: Path, name: str) -> Path:
    """Result folder of a view."""
    return folder / name / own_folders.OUTPUT


def process(session: Session, session_input: SessionInput, notify: Notify) -> ProcessedSession:
    """Process all views of a session, which notes the views that are left out.

    Raises CaptureError: too few views can be used.
    """
    _calibrate_colors(session, session_input, notify)
    with ExitStack() as stack:
        pool = None
        if session_input.workers > 1:
            pool = stack.enter_context(ProcessPool(session_input.workers, _RETRIES, session_input.limits))
        boards = _find_boards(session, session_input, pool, notify)
        if boards:
            solved = poses.solve(boards, session.captures[session.used[0]])
            session.leave_out(solved.left_out)
            tasks = _mask_tasks(session, session_input, boards, solved)
            masks = session.each(_mask_object, tasks, pool, _notify_of(notify, "mask"))
            session.require_views()
        else:
            session.each(_make_maps, _tasks(session, session_input), pool, _notify_of(notify, "first maps"))
            session.require_views()
            notify("no board: poses from features of the object")
            solved, masks = _solve_by_features(session, session_input)
            session.leave_out(solved.left_out)
        _compare_masks(session, session_input, masks, solved)
        reports = session.each(_make_maps, _tasks(session, session_input), pool, _notify_of(notify, "maps"))
    session.require_views()
    views = tuple(_view(name, session_input, solved) for name in session.used)
    return ProcessedSession(views, solved, reports, session.left_out)


def _solve_by_features(session: Session, session_input: SessionInput) -> tuple[SessionPoses, dict[str, Bools]]:
    """Poses from features of the views' first maps, and copies of the masks of these maps."""
    results = {name: _reopen(name, session_input, "infer") for name in session.used}
    solved = feature_poses.solve(results, session.captures[session.used[0]])
    return solved, {name: np.array(found.object_.mask) for name, found in results.items()}


def _notify_of(notify: Notify, step: str) -> Notify:
    """A function that notes that a step of a named view is done."""
    return lambda name: notify(f"{name}: {step}")


def read(session_input: SessionInput) -> Session:
    """Read the captures of all folders view…/ and set…/view…/; nothing is written.

    Raises CaptureError: there are too few views.
    """
    folder = session_input.folder
    names = folder_names.session_views(folder)
    if not names:
        raise CaptureError(f"{folder} holds no views; put each capture into a folder view01, view02, …")
    session = Session({})
    views: dict[str, str] = {}  # by digest of a photograph
    for name in names:
        try:
            capture = reader.read(folder / name, session_input.angles_deg, session_input.clockwise)
        except _FAULTS as error:
            session.left_out[name] = _reason(str(folder / name), error)
            continue
        photographs = [frame.digest for shot in capture.shots for frame in shot.frames]
        if earlier := next((views[digest] for digest in photographs if digest in views), None):
            session.left_out[name] = f"holds photographs of {earlier}"
            continue
        session.captures[name] = capture
        views |= dict.fromkeys(photographs, name)
    session.require_views()
    return session


def _tasks(session: Session, session_input: SessionInput) -> dict[str, ViewTask]:
    """Tasks of the views that are not left out, by name."""
    return {
        name: ViewTask(
            name,
            session.captures[name],
            session.supplied[name],
            session_input.config.of_views,
            out_of(session_input.folder, name),
        )
        for name in session.used
    }


def _mask_tasks(
    session: Session, session_input: SessionInput, boards: Mapping[str, BoardCorners], solved: SessionPoses
) -> dict[str, MaskTask]:
    return {
        name: MaskTask(task, boards[name].board, solved.camera, solved.views[name].pose)
        for name, task in _tasks(session, session_input).items()
    }


def _calibrate_colors(session: Session, session_input: SessionInput, notify: Notify) -> None:
    """Give every view the color calibration of the first view that shows the chart, as a profile.

    Raises ChartError: no view shows the chart.
    """
    plain = UserInput(session_input.chart, None, session_input.network, session_input.mask_network)
    charted, others = "", plain
    for name in session.used if session_input.chart.mode == "auto" else ():
        notify(f"{name}: chart")
        out = out_of(session_input.folder, name)
        try:
            pipeline.process(session.captures[name], plain, session_input.config.of_views, out, "whitebalance")
            color = pipeline.reopen(out, "whitebalance")[0].color
        except ChartError:
            continue
        profile = replace(color, source="profile", place=None)
        charted, others = name, replace(plain, chart=ChartRequest("profile", profile=profile))
        break
    else:
        if session_input.chart.mode == "auto":
            raise ChartError(
                "no view shows the ColorChecker; show it in one view, give a color profile with --chart, or --no-chart"
            )
    session.supplied = {name: plain if name == charted else others for name in session.used}


def _find_boards(
    session: Session, session_input: SessionInput, pool: ProcessPool | None, notify: Notify
) -> dict[str, BoardCorners]:
    """Corners of the board by view; none if no view shows a board.

    Raises CaptureError: no view shows a board, and there are several sets of views.
    """
    found = session.each(_find_board, _tasks(session, session_input), pool, _notify_of(notify, "exposures and board"))
    boards = {name: one for name, one in found.items() if isinstance(one, BoardCorners)}
    if found and not boards and len(session.sets) > 1:
        raise CaptureError(
            "no view shows a board, which several sets of views need; shoot with the object on the board of "
            "`polcap board`, or fuse one set"
        )
    if boards or not found:
        session.leave_out({name: one for name, one in found.items() if isinstance(one, str)})
    return boards


def _find_board(task: ViewTask) -> BoardCorners | str:
    """Corners of the board in a view, or why there are none."""
    pipeline.process(task.capture, task.supplied, task.config, task.out, "align")
    results = pipeline.reopen(task.out, "align")[0]
    try:
        return board_corners.detect(results.radiance, results.color, task.name)
    except NoBoardError as error:
        return _reason(task.name, error)


def _mask_object(task: MaskTask) -> Bools:
    """Find the object's mask of a view on its picture without the board."""
    view = task.view
    results = pipeline.reopen(view.out, "align")[0]
    erased = erase(results.radiance, results.alignment, results.color, task.board, (task.camera, task.pose))
    settings = view.config.mask
    found = mask.segment(erased, results.alignment, results.color, None, view.supplied.mask_network, onnx.run, settings)
    picture = mask.mean_picture(erased, results.alignment, results.color)
    board = np.any(erased.value != results.radiance.value, axis=(0, -1))
    return mask_border.refine(picture, bright_parts.add(picture, found.mask, board))


def _compare_masks(
    session: Session, session_input: SessionInput, masks: Mapping[str, Bools], solved: SessionPoses
) -> None:
    """Remove from the masks what no other view confirms, and leave out views whose masks contradict the others."""
    for names in session.sets.values():
        views = [_silhouette(name, masks[name], session_input, solved) for name in names]
        for view in views:  # for the user, where it contradicts the others
            file = out_of(session_input.folder, view.name) / mask_agreement.COMPARED
            png.write(file, np.where(view.mask, 255, 0).astype(np.uint8))
        used, contradicting = mask_agreement.agreeing(views)
        session.left_out |= contradicting
        for view in used:
            largest = regions.nth_part(view.mask, 1)  # what remains of the board is smaller
            session.supplied[view.name] = replace(session.supplied[view.name], mask=largest)


def _silhouette(name: str, found: Bools, session_input: SessionInput, solved: SessionPoses) -> Silhouette:
    """The mask of a view, which is on its merged picture, with the session's camera in merged px."""
    scale = _reopen(name, session_input, "align").radiance.view.scale
    return Silhouette(name, found, solved.camera.reduced(scale), solved.views[name].pose)


def _reopen(name: str, session_input: SessionInput, until: str) -> Results:
    """Results of a view up to a stage."""
    return pipeline.reopen(out_of(session_input.folder, name), until)[0]


def _make_maps(task: ViewTask) -> dict[str, Any]:
    """Run the path of a view; returns the content of its report.json."""
    about = pipeline.process(task.capture, task.supplied, task.config, task.out)
    assert about is not None  # only `until` leaves it out
    for gate in about["gates"]:
        if gate["name"] in _REFUSED and gate["state"] == "fail":
            raise CaptureError(f"{gate['says']}. {gate['remedy']}")
    return about


def _view(name: str, session_input: SessionInput, solved: SessionPoses) -> FusionView:
    """Maps of a view, with its pose."""
    results = _reopen(name, session_input, "infer")
    undistorted = results.radiance.equipment.distortion is not None and session_input.config.stokes.undistort
    view = view_maps.fusion_view(name, results, solved.camera, solved.views[name].pose, undistorted)
    return replace(view, metric=solved.metric)
