"""Processes all views of a session: one color calibration, one camera, poses, masks, maps.

Each view is a capture that `polcap process` takes, with its result in viewNN/polcap. A view that cannot be used is left
out, with the reason; the others go on. Between sets of views (setA/view01 …, setB/view01 …) the object was laid on
another side; their boards become one frame at the end. Without a board the poses come from features of the maps.
"""

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
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
from polcap.fusion import board_corners, feature_poses, joining, mask_agreement, poses, view_maps
from polcap.fusion.board_corners import BoardCorners, NoBoardError
from polcap.fusion.board_eraser import erase
from polcap.fusion.poses import LEAST_VIEWS, PosedView, SessionCamera, SessionPoses
from polcap.fusion.silhouettes import Silhouette
from polcap.fusion.values import FusionView, Pose
from polcap.images import Bools, Capture, ChartRequest, Network
from polcap.optics.board import Board
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import AUTO, UserInput
from polcap.stages import mask
from polcap.stages.mask import regions

_REFUSED = ("order",)  # gates of a view whose failure makes its normals wrong everywhere
# share of a set's surface that the first set confirms: correctly joined .84 or more, other objects mostly .5 or less
LEAST_SHARED = 0.7
_RETRIES = 1  # of a view, if its process died
# faults of a view, without which the others go on; settings, models and the disk are common to all
_FAULTS = (CaptureError, DecodeError, ChartError, AlignmentError, ObjectError)
Report = Callable[[str], None]  # of what is done
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class SessionInput:
    """A session's folder, and options for all its views."""

    folder: Path
    config: Config
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
    """The views of a session, as far as they are processed."""

    captures: dict[str, Capture]  # by name of the view
    left_out: dict[str, str] = field(default_factory=dict)  # reason, by name of the view
    supplied: dict[str, UserInput] = field(default_factory=dict)
    camera: SessionCamera | None = None
    posed: Mapping[str, PosedView] = field(default_factory=dict)
    board: bool = True  # poses come from the board
    metric: bool = True  # lengths are in metres
    about: dict[str, dict[str, Any]] = field(default_factory=dict)  # content of report.json of each view
    shared: dict[str, float] = field(default_factory=dict)  # of each further set: share that the first one confirms

    def place(self, solved: SessionPoses) -> None:
        """Take over camera and poses, and leave out the views without."""
        self.left_out |= {name: reason.removeprefix(f"{name}: ") for name, reason in solved.left_out.items()}
        self.camera, self.posed, self.metric = solved.camera, solved.views, solved.metric

    def each(
        self, work: Callable[[T], R], tasks: Mapping[str, T], pool: ProcessPool | None, done: Report
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


def process(session: Session, wanted: SessionInput, report: Report) -> tuple[FusionView, ...]:
    """Process all views of a session, which is changed; returns the views' maps.

    Raises CaptureError: too few views can be used.
    """
    _calibrate_colors(session, wanted, report)
    with ExitStack() as stack:
        pool = None
        if wanted.workers > 1:
            pool = stack.enter_context(ProcessPool(wanted.workers, _RETRIES, wanted.limits))
        boards = _find_boards(session, wanted, pool, report)
        if boards:
            session.place(poses.solve(boards, session.captures[session.used[0]]))
            masks = session.each(_mask_object, _mask_tasks(session, wanted, boards), pool, _says(report, "mask"))
            _enough(session)
            _compare_masks(session, wanted, masks)
        else:
            session.each(_make_maps, _tasks(session, wanted), pool, _says(report, "first maps"))
            _enough(session)
            _place_by_features(session, wanted, report)
        session.about = session.each(_make_maps, _tasks(session, wanted), pool, _says(report, "maps"))
    _enough(session)
    return _joined(session, wanted)


def _says(report: Report, what: str) -> Report:
    """A function that reports that something of a named view is done."""
    return lambda name: report(f"{name}: {what}")


def read(wanted: SessionInput) -> Session:
    """Read the captures of all folders view…/ and set…/view…/; nothing is written.

    Raises CaptureError: there are too few views.
    """
    names = folder_names.session_views(wanted.folder)
    if not names:
        raise CaptureError(f"{wanted.folder} holds no views; put each capture into a folder view01, view02, …")
    session = Session({})
    for name in names:
        folder = wanted.folder / name
        try:
            session.captures[name] = reader.read(folder, wanted.angles_deg, wanted.clockwise)
        except _FAULTS as error:
            session.left_out[name] = _reason(str(folder), error)
    _enough(session)
    return session


def _enough(session: Session) -> None:
    for folder, used in session.sets.items():
        if len(used) < LEAST_VIEWS:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in session.left_out.items())
            raise CaptureError(
                f"{len(used)} views {f'of {folder} ' * bool(folder)}can be used, {LEAST_VIEWS} are needed"
                + (f" ({reasons})" if reasons else "")
                + "; shoot more, 12 for a simple shape"
            )


def _tasks(session: Session, wanted: SessionInput) -> dict[str, ViewTask]:
    """Tasks of the views that are not left out, by name."""
    return {
        name: ViewTask(name, session.captures[name], session.supplied[name], wanted.config, out_of(wanted.folder, name))
        for name in session.used
    }


def _mask_tasks(session: Session, wanted: SessionInput, boards: Mapping[str, BoardCorners]) -> dict[str, MaskTask]:
    assert session.camera is not None
    return {
        name: MaskTask(task, boards[name].board, session.camera, session.posed[name].pose)
        for name, task in _tasks(session, wanted).items()
    }


def _calibrate_colors(session: Session, wanted: SessionInput, report: Report) -> None:
    """Give every view the color calibration of the first view that shows the chart, as a profile.

    Raises ChartError: no view shows the chart.
    """
    plain = UserInput(wanted.chart, None, wanted.network, wanted.mask_network)
    charted, others = "", plain
    for name in session.used if wanted.chart.mode == "auto" else ():
        report(f"{name}: chart")
        out = out_of(wanted.folder, name)
        try:
            pipeline.process(session.captures[name], plain, wanted.config, out, "whitebalance")
            color = pipeline.reopen(out, "whitebalance")[0].color
        except ChartError:
            continue
        profile = replace(color, source="profile", place=None)
        charted, others = name, replace(plain, chart=ChartRequest("profile", profile=profile))
        break
    else:
        if wanted.chart.mode == "auto":
            raise ChartError(
                "no view shows the ColorChecker; show it in one view, give a color profile with --chart, or --no-chart"
            )
    session.supplied = {name: plain if name == charted else others for name in session.used}


def _find_boards(
    session: Session, wanted: SessionInput, pool: ProcessPool | None, report: Report
) -> dict[str, BoardCorners]:
    """Corners of the board by view; none if no view shows a board.

    Raises CaptureError: no view shows a board, and there are several sets of views.
    """
    found = session.each(_find_board, _tasks(session, wanted), pool, _says(report, "exposures and board"))
    boards = {name: one for name, one in found.items() if isinstance(one, BoardCorners)}
    if found and not boards and len(session.sets) > 1:
        raise CaptureError(
            "no view shows a board, which several sets of views need; shoot with the object on the board of "
            "`polcap board`, or fuse one set"
        )
    if boards or not found:
        session.left_out |= {name: one for name, one in found.items() if isinstance(one, str)}
        _enough(session)
    return boards


def _find_board(task: ViewTask) -> BoardCorners | str:
    """Corners of the board in a view, or why there are none."""
    pipeline.process(task.capture, task.supplied, task.config, task.out, "align")
    results = pipeline.reopen(task.out, "align")[0]
    try:
        return board_corners.detect(results.radiance, results.color, task.name)
    except NoBoardError as error:
        return _reason(task.name, error)


def _place_by_features(session: Session, wanted: SessionInput, report: Report) -> None:
    """Give a session without a board its poses, from features of the views' maps, and compare its masks."""
    report("no board: poses from features of the object")
    seen = {name: pipeline.reopen(out_of(wanted.folder, name), "infer")[0] for name in session.used}
    session.board = False
    session.place(feature_poses.solve(seen, session.captures[session.used[0]]))
    _compare_masks(session, wanted, {name: np.asarray(seen[name].object_.mask) for name in session.used})


def _mask_object(task: MaskTask) -> Bools:
    """Find the object's mask of a view on its picture without the board."""
    view = task.view
    results = pipeline.reopen(view.out, "align")[0]
    erased = erase(results.radiance, results.alignment, results.color, task.board, (task.camera, task.pose))
    settings = msgspec.structs.replace(view.config.mask, part=0)  # remains of the board are found in the next step
    return mask.segment(
        erased, results.alignment, results.color, None, view.supplied.mask_network, onnx.run, settings
    ).mask


def _compare_masks(session: Session, wanted: SessionInput, masks: Mapping[str, Bools]) -> None:
    """Remove from the masks what no other view confirms, and leave out views whose masks contradict the others."""
    for names in session.sets.values():
        views = [_silhouette(name, masks[name], session, wanted) for name in names]
        used, contradicting = mask_agreement.agreeing(views)
        session.left_out |= contradicting
        for view in used:
            largest = regions.nth_part(view.mask, 1)  # what remains of the board is smaller
            session.supplied[view.name] = replace(session.supplied[view.name], mask=largest)


def _silhouette(name: str, found: Bools, session: Session, wanted: SessionInput) -> Silhouette:
    """The mask of a view, which is on its merged picture, with the session's camera in merged px."""
    assert session.camera is not None
    scale = pipeline.reopen(out_of(wanted.folder, name), "align")[0].radiance.view.scale
    return Silhouette(name, found, session.camera.reduced(scale), session.posed[name].pose)


def _make_maps(task: ViewTask) -> dict[str, Any]:
    """Run the path of a view; returns the content of its report.json."""
    about = pipeline.process(task.capture, task.supplied, task.config, task.out)
    assert about is not None  # only `until` leaves it out
    for gate in about["gates"]:
        if gate["name"] in _REFUSED and gate["state"] == "fail":
            raise CaptureError(f"{gate['says']}. {gate['remedy']}")
    return about


def _view(name: str, session: Session, wanted: SessionInput) -> FusionView:
    results = pipeline.reopen(out_of(wanted.folder, name), "infer")[0]
    assert session.camera is not None
    undistorted = results.radiance.equipment.distortion is not None and wanted.config.stokes.undistort
    found = view_maps.fusion_view(name, results, session.camera, session.posed[name].pose, undistorted)
    return replace(found, metric=session.metric)


def _joined(session: Session, wanted: SessionInput) -> tuple[FusionView, ...]:
    """The maps of all used views, in the frame of the first set's board.

    Raises CaptureError: a set does not show the object of the first one.
    """
    first, *others = ([_view(name, session, wanted) for name in names] for names in session.sets.values())
    out = list(first)
    for folder, views in zip(list(session.sets)[1:], others, strict=True):
        joined, session.shared[folder] = joining.join(first, views)
        if session.shared[folder] < LEAST_SHARED:
            raise CaptureError(
                f"{folder}: the first set confirms {session.shared[folder]:.0%} of this set's surface, "
                f"{LEAST_SHARED:.0%} are needed; show the same object, with some sides in both sets"
            )
        out += joined
    return tuple(out)
