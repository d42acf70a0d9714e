"""In: a final path. Out: a file or folder that is there whole, or not at all.

Written beside, fsynced, renamed: whoever finds the final name finds a complete file. The new name itself reaches the
disk when the system next writes its journal; should the power fail before, what stood there before is there again.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from polcap.errors import StorageError

_TOGETHER = 8  # files that are synced at a time: the system writes its journal once for all of them
REASONS = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EACCES: "permission denied; choose a folder that may be written",
    errno.EPERM: "permission denied; choose a folder that may be written",
    errno.EEXIST: "a file stands where a folder is needed; choose another path",
    errno.ENOTDIR: "a file stands where a folder is needed; choose another path",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EFBIG: "the file is larger than the file system allows; choose another folder",
    errno.EIO: "the disk reports an input/output error; check the disk",
}


def failure(target: Path, error: OSError) -> StorageError:
    """The one line for a write that the system refused."""
    reason = REASONS.get(error.errno or 0, error.strerror or str(error))
    return StorageError(f"cannot write {target}: {reason}")


class Held:
    """Files that are whole, and wait for their final names."""

    def __init__(self) -> None:
        self._files: list[tuple[Path, Path]] = []

    def take(self, temporary: Path, final: Path) -> None:
        """From here on a file is this one's."""
        self._files.append((temporary, final))

    def release(self) -> None:
        """Give all their names.

        Raises
        ------
        StorageError
            The system refused one; those behind it go on waiting.
        """
        while self._files:
            _rename(*self._files[0])
            del self._files[0]

    def drop(self) -> None:
        """Remove those that wait."""
        for temporary, _ in self._files:
            discard(temporary)


@contextmanager
def path(final: str | Path, synced: bool = True, held: Held | None = None) -> Iterator[Path]:
    """A temporary path beside `final`, which becomes `final` when the block ends well, or later, where it is `held`.

    Parent folders are made. The temporary keeps the suffix, so that writers which choose
    their format by name see the right one. On any exception it is removed and whatever stood
    under `final` is untouched.

    Parameters
    ----------
    final
        The path.
    synced
        Bring the file to the disk before its name; not where whoever reads it notices that it is not whole, and can do
        without it.
    held
        Gives the file its name later.

    Raises
    ------
    StorageError
        Any OSError of making, writing, syncing or renaming, inside the block too.
    """
    final = Path(final)
    temporary = final.with_name(f".{final.stem}.{os.getpid()}.part{final.suffix}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if synced:
            sync(temporary)
    except OSError as error:
        discard(temporary)
        raise failure(final, error) from error
    except BaseException:
        discard(temporary)
        raise
    if held is not None:
        held.take(temporary, final)
        return
    try:
        _rename(temporary, final)
    finally:
        discard(temporary)


def _rename(temporary: Path, final: Path) -> None:
    try:
        os.replace(temporary, final)
    except OSError as error:
        raise failure(final, error) from error


@contextmanager
def folder(final: str | Path, synced: bool = True) -> Iterator[Path]:
    """The same for a folder; a folder that stood under `final` is replaced as a whole.

    Parameters
    ----------
    final, synced
        As of `path`.

    Raises
    ------
    StorageError
        Any OSError of making, writing, syncing or renaming, inside the block too.
    """
    final = Path(final)
    temporary = final.with_name(f".{final.name}.{os.getpid()}.part")
    aside = final.with_name(f".{final.name}.{os.getpid()}.old")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        yield temporary
        if synced:
            with ThreadPoolExecutor(_TOGETHER) as pool:
                list(pool.map(sync, [*sorted(temporary.rglob("*")), temporary]))
        if final.exists():
            os.replace(final, aside)
        os.replace(temporary, final)
    except OSError as error:
        if aside.exists() and not final.exists():
            os.replace(aside, final)
        raise failure(final, error) from error
    finally:
        discard(temporary)
        discard(aside)


def sync(target: Path) -> None:
    """Bring a file's bytes, or a folder's names, to the disk."""
    if os.name == "nt" and target.is_dir():  # knows no such call
        return
    handle = os.open(target, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def discard(target: Path) -> None:
    """Remove a file or folder, whatever stands in the way."""
    with suppress(OSError):  # the failure that led here is the one to tell
        if target.is_dir():
            shutil.rmtree(target, ignore_errors=True)
        else:
            target.unlink()
