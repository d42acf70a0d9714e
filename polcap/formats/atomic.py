"""Writes a file or folder completely or not at all (temporary name, then rename); turns any text into a safe file name.

In a folder that `own_files` has opened, such as a result, only polcap's own files are replaced, and links are refused.

A file is written under a temporary name, synced to the disk and renamed. So the final name always leads to a complete
file. The new name reaches the disk with the system's next journal write; after a power cut the old file may be there.
All functions of polcap that write files raise StorageError where a file or folder cannot be written.
"""

import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Any

import msgspec

from polcap import parallel
from polcap.errors import StorageError
from polcap.formats import own_files, system_errors

_SYNCED_AT_ONCE = 8  # files; the system then writes its journal once for all of them
_FORBIDDEN = set('/\\:*?"<>|')  # path separators, and characters that Windows refuses
_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.part(\.\w+)?")  # process id and random number
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(10))}  # of Windows
_NAME_BYTES = 60  # Windows allows 260 characters for the whole path
_UNSYNCED = {  # errors of fsync on drives without it
    *system_errors.MISSING, errno.EINVAL, errno.EBADF, errno.EISDIR, errno.EACCES, errno.EPERM,
}  # fmt: skip


def write(final: str | Path, content: str | bytes, synced: bool = True) -> None:
    """Write `content` into the file `final`, as `path` does; text is encoded as UTF-8."""
    if isinstance(content, str):
        content = content.encode("utf-8", "backslashreplace")  # the name of a file may not be text
    with path(final, synced) as temporary:
        temporary.write_bytes(content)


def write_json(final: str | Path, content: Any, synced: bool = True) -> None:
    """Write plain data, msgspec structs and dataclasses as a JSON file, as `path` does; NaN is a ValueError."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False, default=msgspec.to_builtins)
    write(final, text + "\n", synced)


@contextmanager
def path(final: str | Path, synced: bool = True) -> Iterator[Path]:
    """Context manager: a temporary path to write to, renamed to `final` when the block ends without an exception.

    Parent folders are made. The temporary file is new and empty; its random name has the same suffix, for writers that
    choose a format by it. On any exception it is removed, and an old file under `final` is untouched. Without `synced`
    the file may be incomplete after a power cut: for files that their reader checks.

    Raises StorageError: any OSError of making, writing, syncing or renaming, inside the block too; a file that polcap
    did not write is in the place of `final`, or a link leads there.
    """
    final = Path(final)
    own = None if is_temporary(final.parent.name) else own_files.owner(final)
    temporary = _temporary(final, final.suffix)
    try:
        if own is not None:
            own.check(final)
        if final.is_symlink():
            raise StorageError(f"cannot write {final}: it is a link; remove it, or choose another path")
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        if synced:
            sync(temporary)
        if own is not None:
            own.record({final: temporary})
        os.replace(temporary, final)
    except OSError as error:
        raise system_errors.cannot_write(final, error) from error
    finally:
        discard(temporary)


def copy(source: Path, final: Path) -> None:
    """Write a copy of the content of a file, as `path` does."""
    with path(final) as temporary:
        shutil.copyfile(source, temporary)


@contextmanager
def new_folder(final: str | Path) -> Iterator[Path]:
    """Context manager: a temporary folder to fill, renamed to `final` at the end; `final` may be an empty folder."""
    with _temporary_folder(Path(final)) as temporary:
        yield temporary
        _sync_all(temporary)
        if os.name == "nt" and Path(final).is_dir():  # Windows does not rename onto an empty folder
            Path(final).rmdir()
        os.replace(temporary, final)


@contextmanager
def folder_of_files(final: str | Path, index: str, synced: bool = True) -> Iterator[Path]:
    """Context manager: a temporary folder to fill with files, which are moved into the folder `final` at the end.

    Files of polcap that `final` held before are replaced or removed; others stay. `index` is the file without which
    readers do not accept the folder: it is removed first and moved last, so they never see files of two generations.
    """
    final = Path(final)
    with _temporary_folder(final) as temporary:
        yield temporary
        if synced:
            _sync_all(temporary)
        own = own_files.owner(final)
        names = sorted((file.name for file in temporary.iterdir()), key=lambda name: name == index)
        if own is not None:
            for name in names:
                own.check(final / name)
        final.mkdir(exist_ok=True)
        if own is not None:
            own.record({final / name: temporary / name for name in names})
            for old in (final / index, *own.below(final)):
                if old.name == index or old.name not in names:
                    own.remove(old)
        for name in names:
            os.replace(temporary / name, final / name)


@contextmanager
def _temporary_folder(final: Path) -> Iterator[Path]:
    """Context manager: a temporary folder next to `final`, removed at the end if it is still there."""
    temporary = _temporary(final, "")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        yield temporary
    except OSError as error:
        raise system_errors.cannot_write(final, error) from error
    except StorageError as error:  # of a file inside: named as in `final`
        raise StorageError(str(error).replace(str(temporary), str(final))) from error
    finally:
        discard(temporary)


def _temporary(final: Path, suffix: str) -> Path:
    """A temporary name in the folder of `final` that no other program can foresee."""
    return final.with_name(f".{final.stem if suffix else final.name}.{os.getpid()}-{token_hex(4)}.part{suffix}")


def is_temporary(name: str) -> bool:
    """Whether a file or folder has a temporary name of this module, as after a killed run."""
    return _TEMPORARY.fullmatch(name) is not None


def _sync_all(folder: Path) -> None:
    parallel.results([partial(sync, one) for one in (*sorted(folder.rglob("*")), folder)], _SYNCED_AT_ONCE)


def sync(target: Path) -> None:
    """Force a file's content, or a folder's list of names, onto the disk (fsync) if its drive can. Raises OSError."""
    if os.name == "nt" and target.is_dir():  # Windows cannot sync a folder
        return
    try:
        handle = os.open(target, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in _UNSYNCED:
            raise


def discard(target: Path) -> None:
    """Remove a file or folder if possible; errors are ignored."""
    with suppress(OSError):  # the error that led here is the one to report
        if target.is_dir():
            shutil.rmtree(target, ignore_errors=True)
        else:
            target.unlink()


def safe_name(text: str) -> str:
    """Turn any text into a valid file name: forbidden characters become _.

    The name is never empty, hidden, or a reserved device name such as CON.
    """
    name = "".join("_" if c in _FORBIDDEN or not c.isprintable() else c for c in text)
    name = name.encode("utf-8", "replace")[:_NAME_BYTES].decode("utf-8", "ignore")
    name = name.strip(". ") or "capture"
    return f"_{name}" if name.partition(".")[0].rstrip().upper() in _DEVICES else name
