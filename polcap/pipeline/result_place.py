"""Which folders polcap's files may be written into: none that holds photographs or lies among those of a capture."""

import os
from contextlib import suppress
from pathlib import Path

from polcap.errors import CaptureError, SettingError
from polcap.formats import own_files, own_folders
from polcap.formats.capture import capture_toml, folder_names
from polcap.formats.raw import probe


def check(out: Path, photographs: Path) -> None:
    """Refuse a result folder for the capture in the folder `photographs`.

    Raises SettingError: `out` contains the capture, lies among its shots, is a link out of it, or as `check_free`.
    """
    target, capture = _real(out), Path(os.path.realpath(photographs))
    if target == capture:
        raise SettingError(f"--out {out} is the capture itself; choose a folder of its own")
    if capture.is_relative_to(target):
        raise SettingError(f"--out {out} contains the capture {photographs}; choose a folder of its own")
    if out.is_symlink() and target.parent != capture and Path(os.path.realpath(out.parent)) == capture:
        raise SettingError(f"--out {out} is a link; name the folder that it leads to")
    inside = target.relative_to(capture).parts[:1] if target.is_relative_to(capture) else ()
    if any(name in folder_names.angle_folder_names(capture) or folder_names.is_angle_folder(name) for name in inside):
        raise SettingError(f"--out {out} lies among the capture's shots; choose {photographs / own_folders.OUTPUT}")
    check_free(out)


def check_free(out: Path) -> None:
    """Refuse a folder for files of polcap that holds photographs or lies among those of a capture.

    Raises SettingError: it is one of these, or OpenEXR cannot open a file of its name.
    """
    target = _real(out)
    if any(map(_holds_shots, (target, *target.parents))):
        raise SettingError(f"--out {out} lies among the capture's shots; choose another folder")
    files = folder_names.children(target) if target.is_dir() and not own_files.is_claimed(out) else []
    if photograph := next((path for path in files if path.is_file() and probe.kind(path) == "raw"), None):
        raise SettingError(f"--out {out} holds photographs ({photograph.name}); choose a folder of its own")


def _real(out: Path) -> Path:
    """The folder without links. Raises SettingError: its name is not UTF-8, or holds a NUL character."""
    try:
        os.fspath(out).encode()
    except UnicodeEncodeError:
        raise SettingError(f"--out {out} is no UTF-8 text, as OpenEXR wants it; name another with --out") from None
    if "\0" in os.fspath(out):
        raise SettingError(f"--out {out} holds a NUL character; name another folder")
    return Path(os.path.realpath(out))


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
