"""`polcap clean`: removes the stage cache of a result."""

from contextlib import suppress
from pathlib import Path

from polcap.errors import StorageError
from polcap.formats import own_files
from polcap.formats.capture import folder_names
from polcap.pipeline import result_folder

_HELD = ("lock", "owner")  # files in work/ that an open result needs


def clean(out: Path, dry_run: bool = False) -> int:
    """Remove polcap's files from work/: the stage cache and the pictures of `show`; returns their size in bytes.

    All other files in work/ stay. With `dry_run`, nothing is removed.

    Raises StorageError: there is no folder work/, another process works here, or a file cannot be removed.
    """
    work = out / "work"
    if folder_names.is_result(out) and not work.is_dir():
        raise StorageError(f"{out} holds no stage cache: there is nothing to remove")
    if not work.is_dir():
        raise StorageError(folder_names.without_result(out))
    if not own_files.is_claimed(out):
        raise StorageError(f"{out} holds no stage cache; give the result folder of `polcap process`")
    with own_files.opened(out) as own:
        files = [file for file in own.below(work) if file.name not in _HELD]
        size = sum(file.stat().st_size for file in files)
        if dry_run:
            return size
        with result_folder.locked(out):
            try:
                for file in files:
                    own.remove(file)
            except OSError as error:
                raise StorageError(f"{error.filename} cannot be removed: {error.strerror}") from error
        for folder in {file.parent for file in files if file.parent != work}:
            with suppress(OSError):  # it holds a file of another program
                folder.rmdir()
    return size
