"""A result folder: which folders it may be, its lock, the removal of the stage cache, and work/run.json.

A result is opened again from work/run.json.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
from filelock import FileLock, Timeout

from polcap import report
from polcap.errors import CaptureError, SettingError, StorageError
from polcap.formats import atomic, folder_lock, own_files, own_folders, system_errors, text_file
from polcap.formats.capture import capture_toml, folder_names
from polcap.formats.raw import probe
from polcap.pipeline.manifest import seal

_HELD = ("lock", "owner")  # files in work/ that an open result needs
_PARTS = ("maps", "asset", "work", "report.html", "report.json", "color.toml", "compare.html")  # of a result


def check(out: Path, photographs: Path) -> None:
    """Refuse a result folder that contains photographs, lies among those of a capture, or that no OpenEXR can have.

    Raises SettingError: the folder is one of these.
    """
    try:
        os.fspath(out).encode()
    except UnicodeEncodeError:
        raise SettingError(f"--out {out} is no UTF-8 text, as OpenEXR wants it; name another with --out") from None
    if "\0" in os.fspath(out):
        raise SettingError(f"--out {out} holds a NUL character; name another folder")
    here, there = Path(os.path.realpath(out)), Path(os.path.realpath(photographs))
    if here == there:
        raise SettingError(f"--out {out} is the capture itself; choose a folder of its own")
    if there.is_relative_to(here):
        raise SettingError(f"--out {out} contains the capture {photographs}; choose a folder of its own")
    if out.is_symlink() and here.parent != there and Path(os.path.realpath(out.parent)) == there:
        raise SettingError(f"--out {out} is a link; name the folder that it leads to")
    inside = here.relative_to(there).parts[:1] if here.is_relative_to(there) else ()
    names = folder_names.angle_folder_names(there)
    among = any(name in names or folder_names.is_angle_folder(name) for name in inside)
    if among or any(map(_holds_shots, (here, *here.parents))):
        raise SettingError(f"--out {out} lies among the capture's shots; choose {photographs / own_folders.OUTPUT}")
    held = folder_names.children(here) if here.is_dir() and not own_files.is_claimed(out) else []
    if photograph := next((path for path in held if path.is_file() and probe.kind(path) == "raw"), None):
        raise SettingError(f"--out {out} holds photographs ({photograph.name}); choose a folder of its own")


def _holds_shots(folder: Path) -> bool:
    """Whether a folder holds photographs of a capture: it is named for their angle, or a capture.toml lists them."""
    if folder_names.is_angle_folder(folder.name) or folder_names.is_one_angle(folder):
        return any(probe.kind(path) in ("raw", "photo") for path in folder_names.children(folder) if path.is_file())
    return any(_lists_files_in(folder, above) for above in folder.parents if (above / capture_toml.NAME).is_file())


def _lists_files_in(folder: Path, capture: Path) -> bool:
    """Whether the capture.toml of a capture lists a file in one of its sub-folders."""
    with suppress(CaptureError):  # it is no capture.toml of polcap
        return any((capture / frame.file).parent == folder for frame in capture_toml.load(capture).frame)
    return False


@contextmanager
def opened(out: Path) -> Iterator[None]:
    """Context manager: files are written into a result folder, which gets its record if it has none.

    Raises StorageError: the folder holds maps or other parts of a result that are not in a record of polcap.
    """
    own_files.claim(out, _PARTS)
    with own_files.opened(out):
        yield


def copy(result: Path, out: Path) -> None:
    """Make a result folder with the maps and the report of another one, such as an archive, which stays as it is.

    Raises SettingError: `out` holds something already, or lies in `result` or among the shots of a capture.
    StorageError: `result` is no result, or `out` is not writable.
    """
    here, there = (Path(os.path.realpath(folder)) for folder in (out, result))
    if here.is_relative_to(there):
        raise SettingError(f"--out {out} lies in {result}, which is to stay as it is; choose a folder outside")
    if any(map(_holds_shots, (here, *here.parents))):
        raise SettingError(f"--out {out} lies among the shots of a capture; choose another folder")
    if os.path.lexists(out) and (not out.is_dir() or any(out.iterdir())):
        raise SettingError(f"--out {out} is not an empty folder; choose another folder")
    report.read(result)
    with opened(out):
        for file in (result / "report.json", *sorted((result / "maps").iterdir())):
            if file.is_file():
                atomic.copy(file, out / file.relative_to(result))


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Context manager that locks and opens a result folder for this process; removes temporary files of a killed run.

    The operating system removes the lock when the process ends, so there are no stale locks.

    Raises StorageError: another process works here, the folder cannot be written, or as `opened`.
    """
    work = out / "work"
    lock, owner = FileLock(work / "lock", timeout=0), work / "owner"
    with opened(out), own_files.opened(out) as own:
        own.check(work / "lock")
        try:
            work.mkdir(parents=True, exist_ok=True)
            own.record([work / "lock"])
            folder_lock.acquire(lock)
        except Timeout as error:
            raise StorageError(
                f"{out}: process {_owner(owner)} is working here; wait for it or choose another --out"
            ) from error
        except OSError as error:
            raise system_errors.cannot_write(work / "lock", error) from error
        try:
            atomic.write(owner, f"{os.getpid()}\n", synced=False)
            _remove_temporary(out)
            yield
        finally:
            lock.release()


def _owner(file: Path) -> str:
    """Process id in the file `owner`."""
    try:
        return text_file.read_text(file, limit=20).strip()
    except (OSError, ValueError):
        return "unknown"


def _remove_temporary(out: Path) -> None:
    """Remove files and folders with temporary names, as a killed run leaves them, from the folders of a result."""
    asset = out / "asset"
    presets = [] if asset.is_symlink() or not asset.is_dir() else [path for path in asset.iterdir() if path.is_dir()]
    for place in (out, out / "work", out / "maps", asset, *presets):
        if place == out or not place.is_symlink():
            for left in place.glob(".*.part*"):
                if atomic.is_temporary(left.name):
                    atomic.discard(left)


def clean(out: Path, dry_run: bool = False) -> int:
    """Remove polcap's files from work/: the stage cache and the pictures of `show`; returns their size in bytes.

    All other files in work/ stay. With `dry_run`, nothing is removed.

    Raises StorageError: there is no folder work/, another process works here, or a file cannot be removed.
    """
    work = out / "work"
    if not work.is_dir() or not own_files.is_claimed(out):
        raise StorageError(f"{out} holds no stage cache; give the result folder of `polcap process`")
    with own_files.opened(out) as own:
        files = [file for file in own.below(work) if file.name not in _HELD]
        size = sum(file.stat().st_size for file in files)
        if dry_run:
            return size
        with locked(out):
            try:
                for file in files:
                    own.remove(file)
            except OSError as error:
                raise StorageError(f"{error.filename} cannot be removed: {error.strerror}") from error
        for folder in {file.parent for file in files if file.parent != work}:
            with suppress(OSError):  # it holds a file of another program
                folder.rmdir()
    return size


def write_run(out: Path, about: Mapping[str, Any]) -> None:
    """Write work/run.json: facts of a run that `show` and `report` need when the photographs are missing.

    A file of the same facts stays as it is, so that a finished result is recognized.
    """
    with suppress(StorageError):
        if read_run(out)["digest"] == seal(about):
            return
    atomic.write_json(out / "work" / "run.json", {**about, "digest": seal(about)}, synced=False)


def read_run(out: Path) -> dict[str, Any]:
    """Read work/run.json of a result folder.

    Raises StorageError: there is none, or it is damaged.
    """
    file = out / "work" / "run.json"
    try:
        about: dict[str, Any] = text_file.read_json(file)
        msgspec.convert(about, report.RunFacts)
    except OSError as error:
        raise StorageError(f"{out} holds no stage cache of this polcap; run `polcap process` again") from error
    except ValueError as error:
        raise StorageError(f"{file} is no run of this polcap ({error}); run `polcap process` again") from error
    if about.get("digest") != seal(about):
        raise StorageError(f"{file} is damaged, or of another polcap; run `polcap process` again")
    return about
