"""Probes the files of one folder: photographs by their content, and the names of files that are none."""

import os
import unicodedata
from functools import partial
from pathlib import Path

from polcap import parallel
from polcap.errors import CaptureError, DecodeError
from polcap.formats.capture import foreign_files
from polcap.formats.capture.folder_names import children
from polcap.formats.raw import file_kind, probe
from polcap.formats.raw.probe import Probe

_AT_ONCE = 2  # files read in parallel: as many child processes as decode them later


def read(path: Path) -> Probe:
    """Metadata of a photograph, or the kind of another file. Raises CaptureError or DecodeError."""
    if path.is_symlink() and not path.exists():
        raise CaptureError(
            f"{path}: is a link to {os.readlink(path)}, which is missing; restore that file, or remove the link"
        )
    found = probe.read(path)
    if found.kind == "unknown":
        raise CaptureError(f"{path}: not a picture, a RAW that LibRaw knows, or text; restore the file, or remove it")
    return found


def read_all(folder: Path) -> tuple[dict[Path, Probe], list[str]]:
    """Metadata of all readable files of a folder, and the names of the others.

    A file that cannot be read is an error only if it may be a missing photograph: it has a photograph's suffix, and no
    RAW has the same name before its suffix. Otherwise another program wrote it.

    Raises CaptureError or DecodeError: a photograph cannot be read, or the folder cannot be listed.
    """
    files = [path for path in children(folder) if not path.is_dir()]
    outcomes = parallel.results([partial(_outcome, path) for path in files], min(_AT_ONCE, parallel.threads()))
    found = {path: outcome for path, outcome in zip(files, outcomes) if isinstance(outcome, Probe)}
    raws = [path for path, one in found.items() if one.kind == "raw"]
    suffixes = {path.suffix.lower() for path in raws or [path for path, one in found.items() if one.kind == "photo"]}
    stems = {stem(path) for path in raws}
    unread = []
    for path, outcome in zip(files, outcomes):
        if not isinstance(outcome, Probe):
            photograph = path.suffix.lower() in suffixes or foreign_files.is_photograph(path.name, bool(raws))
            if photograph and stem(path) not in stems:
                raise outcome
            unread.append(path.name)
    return found, unread


def kind(path: Path) -> file_kind.Kind:
    """Kind of a file: by its content, or by its name where it is damaged."""
    try:
        found = probe.kind(path)
        found = probe.read(path).kind if found == "unknown" else found
    except DecodeError:
        found = "unknown"
    if found == "unknown" and foreign_files.is_photograph(path.name, among_raw=False):
        return "raw" if foreign_files.is_photograph(path.name, among_raw=True) else "photo"
    return found


def stem(path: Path) -> str:
    """Name of a file without its suffix, for comparison: one Unicode form, small letters."""
    return unicodedata.normalize("NFC", path.stem).lower()


def _outcome(path: Path) -> Probe | CaptureError | DecodeError:
    """Metadata of a file, or the error of its reading."""
    try:
        return read(path)
    except (CaptureError, DecodeError) as error:
        return error
