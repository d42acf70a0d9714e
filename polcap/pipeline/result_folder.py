"""A result folder: its record and its lock."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from polcap.errors import StorageError
from polcap.formats import atomic, folder_lock, own_files, own_folders, system_errors, text_file

_PARTS = ("maps", "asset", "work", "report.html", "report.json", "color.toml", "compare.html")  # of a result


@contextmanager
def opened(out: Path) -> Iterator[None]:
    """Context manager: files are written into a result folder, which gets its record if it has none.

    Raises StorageError: it is an archive, or holds maps or other parts of a result that are not in a record of polcap.
    """
    if own_folders.is_archive(out):
        raise StorageError(f"{out} is an archive, which stays as it is; name a folder for the files with --out")
    own_files.claim(out, _PARTS)
    with own_files.opened(out):
        yield


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
            own.record({work / "lock": work / "lock"})
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


def check_edits(out: Path) -> None:
    """Raise a StorageError if somebody has edited a map, a file of the asset, or the report: the run would replace it.

    The run replaces no files in folders of asset/, where exports by presets are.
    """
    own, replaced = own_files.OwnFiles(out), (out / "maps", out / "asset")
    files = [file for folder in replaced for file in own.below(folder) if file.parent == Path(os.path.abspath(folder))]
    for file in [*files, out / "report.html"]:
        own.check(file)


def _owner(file: Path) -> str:
    """Process id in the file `owner`; "unknown" if it cannot be read."""
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
            for file in place.glob(".*.part*"):
                if atomic.is_temporary(file.name):
                    atomic.discard(file)
