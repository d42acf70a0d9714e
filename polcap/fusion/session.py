"""Processes all views of a session: one color calibration, one camera, poses from the board, masks, maps.

Each view is a capture that `polcap process` takes, with its result in viewNN/polcap. A view that cannot be used is left
out, with the reason; the others go on.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from polcap.config import Config
from polcap.errors import CaptureError, ChartError, InputError
from polcap.formats import onnx, own_folders
from polcap.formats.capture import layouts, reader
from polcap.fusion import board_corners, mask_agreement, poses, view_maps
from polcap.fusion.board_corners import BoardCorners
from polcap.fusion.board_eraser import erase
from polcap.fusion.poses import LEAST_VIEWS, PosedView, SessionCamera, SessionPoses
from polcap.fusion.silhouettes import Silhouette
from polcap.fusion.values import FusionView
from polcap.images import Bools, Capture, ChartRequest, Network
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import AUTO, UserInput
from polcap.results import Results
from polcap.stages import mask
from polcap.stages.mask import regions

_REFUSED = ("order",)  # gates of a view whose failure makes its normals wrong everywhere
Report = Callable[[str], None]  # of what is done


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


@dataclass
class Session:
    """The views of a session, as far as they are processed."""

    captures: dict[str, Capture]  # by name of the view
    left_out: dict[str, str] = field(default_factory=dict)  # reason, by name of the view
    supplied: dict[str, UserInput] = field(default_factory=dict)
    camera: SessionCamera | None = None
    posed: Mapping[str, PosedView] = field(default_factory=dict)
    about: dict[str, dict[str, Any]] = field(default_factory=dict)  # content of report.json of each view

    def each(self, work: Callable[[str], None]) -> None:
        """Do some work on every view; a view for which it fails is left out."""
        for name in self.captures:
            if name in self.left_out:
                continue
            try:
                work(name)
            except InputError as error:
                self.left_out[name] = _reason(name, error)

    @property
    def used(self) -> list[str]:
        """Names of the views that are not left out."""
        return [name for name in self.captures if name not in self.left_out]


def _reason(name: str, error: InputError) -> str:
    """Why a view is left out, without its name or folder."""
    return str(error).removeprefix(f"{name}: ")


def out_of(folder: Path, name: str) -> Path:
    """Result folder of a view."""
    return folder / name / own_folders.OUTPUT


def process(wanted: SessionInput, report: Report) -> tuple[Session, tuple[FusionView, ...]]:
    """Process all views below a folder; returns the session and the views' maps.

    Raises
    ------
    CaptureError
        There are too few views, or too few of them can be used.
    """
    session = _read(wanted)
    _calibrate_colors(session, wanted, report)
    corners = _find_boards(session, wanted, report)
    solved = _solve_poses(session, corners)
    session.each(lambda name: _mask_object(name, session, wanted, corners[name], solved))
    _enough(session)
    _compare_masks(session, wanted)
    session.each(lambda name: _make_maps(name, session, wanted, report))
    _enough(session)
    return session, tuple(_view(name, session, wanted) for name in session.used)


def _read(wanted: SessionInput) -> Session:
    """Read the captures of all folders view…/."""
    found = sorted(wanted.folder.glob("view*/"), key=lambda folder: layouts.natural(folder.name))
    if not found:
        raise CaptureError(f"{wanted.folder} holds no views; put each capture into a folder view01, view02, …")
    session = Session({})
    for folder in found:
        try:
            session.captures[folder.name] = reader.read(folder, wanted.angles_deg, wanted.clockwise)
        except InputError as error:
            session.left_out[folder.name] = _reason(str(folder), error)
    _enough(session)
    return session


def _enough(session: Session) -> None:
    if len(session.used) < LEAST_VIEWS:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in session.left_out.items())
        raise CaptureError(
            f"{len(session.used)} views can be used, {LEAST_VIEWS} are needed"
            + (f" ({reasons})" if reasons else "")
            + "; shoot more, 12 for a simple shape"
        )


def _run(name: str, session: Session, wanted: SessionInput, supplied: UserInput, until: str | None) -> Results:
    """Run the path of one view up to a stage; returns the results so far."""
    out = out_of(wanted.folder, name)
    about = pipeline.process(session.captures[name], supplied, wanted.config, out, until)
    if about is not None:
        session.about[name] = about
    return pipeline.reopen(out, until or "surface")[0]


def _calibrate_colors(session: Session, wanted: SessionInput, report: Report) -> None:
    """Give every view the color calibration of the first view that shows the chart, as a profile.

    Raises
    ------
    ChartError
        No view shows the chart.
    """
    plain = UserInput(wanted.chart, None, wanted.network, wanted.mask_network)
    charted, others = "", plain
    for name in session.used if wanted.chart.mode == "auto" else ():
        report(f"{name}: chart")
        try:
            color = _run(name, session, wanted, plain, "whitebalance").color
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


def _find_boards(session: Session, wanted: SessionInput, report: Report) -> dict[str, BoardCorners]:
    """Corners of the board in each view."""
    corners: dict[str, BoardCorners] = {}

    def detect(name: str) -> None:
        report(f"{name}: exposures and board")
        results = _run(name, session, wanted, session.supplied[name], "align")
        corners[name] = board_corners.detect(results.radiance, results.color, name)

    session.each(detect)
    _enough(session)
    return corners


def _solve_poses(session: Session, corners: Mapping[str, BoardCorners]) -> SessionPoses:
    seen = {name: corners[name] for name in session.used}
    solved = poses.solve(seen, session.captures[session.used[0]])
    session.left_out |= {name: reason.removeprefix(f"{name}: ") for name, reason in solved.left_out.items()}
    session.camera, session.posed = solved.camera, solved.views
    return solved


def _mask_object(
    name: str, session: Session, wanted: SessionInput, corners: BoardCorners, solved: SessionPoses
) -> None:
    """Find the object's mask of a view on its picture without the board."""
    results = pipeline.reopen(out_of(wanted.folder, name), "align")[0]
    posed = solved.camera, solved.views[name].pose
    erased = erase(results.radiance, results.alignment, results.color, corners.board, posed)
    settings = msgspec.structs.replace(wanted.config.mask, part=0)  # remains of the board are found in the next step
    found: Bools = mask.segment(
        erased, results.alignment, results.color, None, wanted.mask_network, onnx.run, settings
    ).mask
    session.supplied[name] = replace(session.supplied[name], mask=found)


def _compare_masks(session: Session, wanted: SessionInput) -> None:
    """Remove from the masks what no other view confirms, and leave out views whose masks contradict the others."""
    used, contradicting = mask_agreement.agreeing([_silhouette(name, session, wanted) for name in session.used])
    session.left_out |= contradicting
    for view in used:
        largest = regions.nth_part(view.mask, 1)  # what remains of the board is smaller
        session.supplied[view.name] = replace(session.supplied[view.name], mask=largest)


def _silhouette(name: str, session: Session, wanted: SessionInput) -> Silhouette:
    """The mask of a view, which is on the grid of the merged picture, with the session's camera on this grid."""
    found, camera = session.supplied[name].mask, session.camera
    assert found is not None and camera is not None
    scale = pipeline.reopen(out_of(wanted.folder, name), "align")[0].radiance.view.scale
    return Silhouette(name, found, camera.reduced(scale), session.posed[name].pose)


def _make_maps(name: str, session: Session, wanted: SessionInput, report: Report) -> None:
    report(f"{name}: maps")
    _run(name, session, wanted, session.supplied[name], None)
    for gate in session.about[name]["gates"]:
        if gate["name"] in _REFUSED and gate["state"] == "fail":
            raise CaptureError(f"{gate['says']}. {gate['remedy']}")


def _view(name: str, session: Session, wanted: SessionInput) -> FusionView:
    results = pipeline.reopen(out_of(wanted.folder, name), "infer")[0]
    assert session.camera is not None
    undistorted = results.radiance.equipment.distortion is not None and wanted.config.stokes.undistort
    return view_maps.fusion_view(name, results, session.camera, session.posed[name].pose, undistorted)
