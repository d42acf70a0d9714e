"""READ FIRST, before `fusion_path.py`. The path of one view of a session, one line per stage.

A stage runs when its result is first needed: the session first asks all views for their boards, or for features of the
object. These give the poses. Then it asks for masks, compares them, and processes each view like a single capture.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from polcap.capture_values import Capture
from polcap.chart_values import ColorCalibration
from polcap.config import Config
from polcap.errors import CaptureError
from polcap.formats import onnx
from polcap.fusion import board_corners, mask_without_board, object_features
from polcap.fusion.board_corners import BoardSearch
from polcap.fusion.board_eraser import PosedBoard
from polcap.fusion.object_features import ObjectFeatures
from polcap.fusion.values import ViewMask
from polcap.pipeline import path as single
from polcap.pipeline import run
from polcap.pipeline.cache import LazyCache, StageResult
from polcap.pipeline.path import UserInput

T = TypeVar("T")
_REFUSED = ("order",)  # gates of a view whose failure makes its normals wrong everywhere


@dataclass(frozen=True)
class SessionView:
    """A view of a session, with all inputs of its path."""

    name: str
    capture: Capture
    supplied: UserInput  # the color calibration of the session; at the end, the mask
    config: Config
    out: Path  # result folder
    board: PosedBoard | None = None  # None: not yet known, or there is none


@dataclass(frozen=True)
class ViewStages:
    """Results of a view that its session needs; each is made when its value is read."""

    color: StageResult[ColorCalibration]
    board: StageResult[BoardSearch]
    features: StageResult[ObjectFeatures]
    mask: StageResult[ViewMask]


def path(view: SessionView, cache: LazyCache) -> ViewStages:
    """Lay out the stages in order; none runs before its result is needed."""
    single.run_stages(view.capture, view.supplied, view.config, cache)
    names = ("hdr", "whitebalance", "align", "mask", "selfcal", "stokes", "infer")
    radiance, color, alignment, object_, calibration, stokes, maps = (cache.results[name] for name in names)
    board = cache.run(board_corners.detect, radiance, color)
    features = cache.run(object_features.find, radiance, color, object_, calibration, stokes, maps)
    search = (radiance, alignment, color, view.board, view.supplied.mask_network, onnx.run)
    mask = cache.run(mask_without_board.find, *search, config=view.config.mask)
    return ViewStages(color, board, features, mask)


def _value(view: SessionView, choose: Callable[[ViewStages], StageResult[T]]) -> T:
    """The value of a stage of a view, from its stage cache or computed; the folder is locked."""
    cache = LazyCache(view.out)
    with run.opened(view.capture, view.supplied, view.config, cache):
        return choose(path(view, cache)).value


def find_chart(view: SessionView) -> ColorCalibration:
    """Color calibration of a view. Raises ChartError: it shows no chart."""
    return _value(view, lambda stages: stages.color)


def find_board(view: SessionView) -> BoardSearch:
    """Search of the board in a view. Raises CaptureError: as `board_corners.detect`."""
    return _value(view, lambda stages: stages.board)


def find_features(view: SessionView) -> ObjectFeatures:
    """Features of the object, and a first mask. Raises CaptureError: as `object_features.find`."""
    return _value(view, lambda stages: stages.features)


def find_mask(view: SessionView) -> ViewMask:
    """The mask of the object in front of the board. Raises ObjectError: no object is found."""
    return _value(view, lambda stages: stages.mask)


def make_maps(view: SessionView) -> dict[str, Any]:
    """Process a view like a single capture, unless this was done; returns the content of its report.json.

    Raises CaptureError: a gate shows that its normals are wrong everywhere.
    """
    about = run.process_once(view.capture, view.supplied, view.config, view.out)
    for gate in about["gates"]:
        if gate["name"] in _REFUSED and gate["state"] == "fail":
            raise CaptureError(f"{gate['says']}. {gate['remedy']}")
    return about
