"""The views of a session: read from their folders, less those that cannot be used; the session's result folder.

A session is a folder with view01, view02, …. If the object was laid on another side in between, it has a folder of
views for each side: setA/view01, …, setB/view01, …. Each view is a capture that `polcap process` takes.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from polcap.capture_values import Capture
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
from polcap.formats import own_folders
from polcap.formats.capture import folder_names
from polcap.fusion.poses import LEAST_VIEWS
from polcap.fusion.view_path import SessionView
from polcap.pipeline import result_folder, result_place
from polcap.pipeline.cache import LazyCache, Progress
from polcap.pipeline.request import Request

# faults of a view, without which the others go on; settings, models and the disk are common to all
FAULTS = (CaptureError, DecodeError, ChartError, AlignmentError, ObjectError)
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
        return list(dict.fromkeys(map(folder_names.set_of_view, sorted([*self.views, *self.left_out]))))

    @property
    def capture(self) -> Capture:
        """Capture of the first view, for the geometry of the camera of all."""
        return next(iter(self.views.values())).capture

    def without(self, reasons: Mapping[str, str]) -> "Session":
        """The session without the views in `reasons`, which are left out for these.

        Raises CaptureError: too few views of a set are left.
        """
        used = {name: view for name, view in self.views.items() if name not in reasons}
        left = Session(used, {**self.left_out, **reasons})
        for folder in left.folders:
            count = sum(folder_names.set_of_view(name) == folder for name in used)
            if count < LEAST_VIEWS:
                listed = "; ".join(f"{name}: {reason}" for name, reason in left.left_out.items())
                raise CaptureError(
                    f"{count} views {f'of {folder} ' if folder else ''}can be used, {LEAST_VIEWS} are needed"
                    + (f" ({listed})" if listed else "")
                    + "; shoot more, 12 for a simple shape, 9 for a flat sample"
                )
        return left

    def with_inputs(self, change: Callable[[SessionView], SessionView]) -> "Session":
        """The session with other inputs of its views."""
        return Session({name: change(view) for name, view in self.views.items()}, self.left_out)


@contextmanager
def opened(session_input: SessionInput[Any], out: Path, progress: Progress) -> Iterator[tuple[Session, LazyCache]]:
    """Context manager: the views of a session, and the cache of its result folder `out`, which is locked.

    Raises SettingError, CaptureError: as `read`, and if `out` is not allowed. StorageError: `out` is locked.
    """
    session = read(session_input)  # first: a folder without views stays as it is
    for view in folder_names.session_views(session_input.folder):
        result_place.check(out, session_input.folder / view)
    with result_folder.locked(out):
        result_folder.check_edits(out)
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
        except FAULTS as error:
            left_out[name] = reason(error, str(folder / name))
            continue
        photographs = [frame.digest for shot in capture.shots for frame in shot.frames]
        if earlier := next((seen[digest] for digest in photographs if digest in seen), None):
            left_out[name] = f"holds photographs of {earlier}"
            continue
        views[name] = SessionView(name, capture, supplied, request.config, folder / name / own_folders.OUTPUT)
        seen |= dict.fromkeys(photographs, name)
    return Session(views, {}).without(left_out)


def reason(error: InputError, name: str) -> str:
    """Why a view is left out, without its name or folder at the beginning."""
    return str(error).removeprefix(f"{name}: ")
