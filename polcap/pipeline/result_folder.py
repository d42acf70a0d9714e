"""A result folder: its lock, the removal of temporary files and of the stage cache, and work/run.json.

A result is opened again from work/run.json.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from polcap.errors import SettingError, StorageError
from polcap.formats import atomic, folder_lock, own_folders, text_file
from polcap.formats.capture import folder_names
from polcap.pipeline.cache import seal
from polcap.pipeline.path import STAGES

_ANIMATIONS = [f"{motion}.{kind}" for motion in ("light", "turntable") for kind in ("webp", "mp4")]
_WORK_FILES = (
    "run.json",
    "unchanged.json",
    "compared_mask.png",
    *(f"{stage}.png" for stage in STAGES),
    *_ANIMATIONS,
)  # outside the folders of the stages


def check(out: Path, photographs: Path) -> None:
    """Refuse a result folder inside the photographs' folders, or with a name that no OpenEXR file can have.

    Raises SettingError: the folder is one of these, or its name is no UTF-8 text.
    """
    try:
        os.fspath(out).encode()
    except UnicodeEncodeError:
        raise SettingError(f"--out {out} is no UTF-8 text, as OpenEXR wants it; name another with --out") from None
    here, there = Path(os.path.realpath(out)), Path(os.path.realpath(photographs))
    inside = here.relative_to(there).parts if here.is_relative_to(there) else ("elsewhere",)
    if not inside:
        raise SettingError(f"--out {out} is the capture itself; choose a folder of its own")
    of_angle = any(folder_names.is_angle_folder(name) for name in inside)
    if of_angle or inside[0] in folder_names.angle_folder_names(there):
        raise SettingError(f"--out {out} lies among the capture's shots; choose {photographs / own_folders.OUTPUT}")


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Context manager that locks a result folder for this process and removes temporary files of a killed run.

    The operating system removes the lock when the process ends, so there are no stale locks.

    Raises StorageError: another process works here, or the folder cannot be written.
    """
    work = out / "work"
    lock, owner = FileLock(work / "lock", timeout=0), work / "owner"
    try:
        work.mkdir(parents=True, exist_ok=True)
        folder_lock.acquire(lock)
    except Timeout as error:
        other = owner.read_text(encoding="utf-8", errors="replace")[:20].strip() if owner.exists() else "unknown"
        raise StorageError(f"{out}: process {other} is working here; wait for it or choose another --out") from error
    except OSError as error:
        raise atomic.failure(work / "lock", error) from error
    try:
        atomic.write(owner, f"{os.getpid()}\n", synced=False)
        for place in (work, out, out / "maps", out / "asset", *(out / "asset").glob("*/")):
            for left in [*place.glob(".*.part*"), *place.glob(".*.old")]:
                atomic.discard(left)
        yield
    finally:
        lock.release()


def clean(out: Path, dry_run: bool = False) -> int:
    """Remove the stage cache and the pictures of `show` from work/; returns their size in bytes.

    All other files in work/ stay. With `dry_run`, nothing is removed.

    Raises StorageError: there is no folder work/, another process works here, or a file cannot be removed.
    """
    work = out / "work"
    if not work.is_dir():
        raise StorageError(f"{out} holds no stage cache; give the result folder of `polcap process`")
    stages = [manifest.parent for manifest in work.glob("[0-9][0-9]-*/manifest.json")]
    cached = [file for stage in stages for file in stage.iterdir() if file.suffix in (".npy", ".json")]
    files = [*cached, *(work / name for name in _WORK_FILES if (work / name).is_file())]
    size = sum(file.stat().st_size for file in files)
    if not dry_run:
        with locked(out):
            try:
                for file in files:
                    file.unlink(missing_ok=True)
            except OSError as error:
                raise StorageError(f"{error.filename} cannot be removed: {error.strerror}") from error
            for stage in stages:
                with suppress(OSError):  # it holds a file of another program
                    stage.rmdir()
    return size


def write_run(out: Path, about: Mapping[str, Any]) -> None:
    """Write work/run.json: facts of a run that `show` and `report` need when the photographs are missing."""
    atomic.write_json(out / "work" / "run.json", {**about, "digest": seal(about)}, synced=False)


def read_run(out: Path) -> dict[str, Any]:
    """Read work/run.json of a result folder.

    Raises StorageError: there is none, or it is damaged.
    """
    file = out / "work" / "run.json"
    try:
        about = text_file.read_json(file)
    except (OSError, ValueError) as error:
        raise StorageError(f"{out} holds no stage cache of this polcap; run `polcap process` again") from error
    if not isinstance(about, dict) or about.get("digest") != seal(about):
        raise StorageError(f"{file} is damaged, or of another polcap; run `polcap process` again")
    return about
