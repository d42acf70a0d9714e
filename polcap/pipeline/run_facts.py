"""work/run.json of a result: facts of a run that `show` and `report` need when the photographs are missing."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from polcap import report
from polcap.errors import StorageError
from polcap.formats import atomic, own_folders, text_file
from polcap.formats.capture import folder_names
from polcap.pipeline.manifest import seal


def write(out: Path, about: Mapping[str, Any]) -> None:
    """Write work/run.json; a file of the same facts stays as it is, so that a finished result is recognized."""
    with suppress(StorageError):
        if read(out)["digest"] == seal(about):
            return
    atomic.write_json(out / "work" / "run.json", {**about, "digest": seal(about)}, synced=False)


def no_cache(out: Path) -> StorageError:
    """The error for a result folder without a stage cache, with the remedy."""
    if own_folders.is_archive(out):
        return StorageError(
            f"{out} is an archive, which holds no stage cache: see its report.html; `polcap export {out} --out NEW` "
            f"writes files from it, `polcap report {out} --compare OTHER --out NEW` compares it"
        )
    if not folder_names.is_result(out) and not (out / "work").is_dir():
        return StorageError(folder_names.without_result(out))
    return StorageError(f"{out} holds no stage cache of this polcap; run `polcap process` on its photographs")


def read(out: Path) -> dict[str, Any]:
    """Read work/run.json of a result folder. Raises StorageError: there is none, or it is damaged."""
    file = out / "work" / "run.json"
    try:
        about: dict[str, Any] = text_file.read_json(file)
        msgspec.convert(about, report.RunFacts)
    except OSError as error:
        raise no_cache(out) from error
    except ValueError as error:
        raise StorageError(f"{file} is no run of this polcap ({error}); run `polcap process` again") from error
    if about.get("digest") != seal(about):
        raise StorageError(f"{file} is damaged, or of another polcap; run `polcap process` again")
    return about
