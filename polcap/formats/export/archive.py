"""Gathers a result's records next to an export, lists digests of all its files for `sha256sum -c`, and checks them."""

import os
from pathlib import Path

from polcap.formats import atomic, color_profile, own_files, own_folders, text_file
from polcap.formats.raw import file_bytes


def gather(out: Path, folder: Path) -> list[Path]:
    """Copy maps/ and color profile of the result `out` into the folder of an export; returns the copies.

    Copies of an earlier export that the result no longer has are removed.
    """
    out = Path(os.path.abspath(out))
    own, profile = own_files.OwnFiles(out), out / color_profile.NAME
    found = own.below(out / "maps") + [profile] * (profile.is_file() and not profile.is_symlink())
    copies = [folder / file.relative_to(out) for file in found]
    for file, copy in zip(found, copies):
        atomic.copy(file, copy)
    for old in (*(folder / "maps").glob("*"), folder / color_profile.NAME):
        if old not in copies:
            own.remove(old)
    return copies


def write_manifest(folder: Path) -> Path:
    """Write the digests of all files that polcap has written into a folder, those of earlier exports included.

    The lines are those of sha256sum, with paths relative to the folder.
    """
    manifest, absolute = folder / own_folders.MANIFEST, Path(os.path.abspath(folder))
    own = own_files.owner(manifest)
    files = [] if own is None else [file for file in own.below(absolute) if file != absolute / own_folders.MANIFEST]
    lines = [f"{file_bytes.digest(file.read_bytes())}  {file.relative_to(absolute).as_posix()}\n" for file in files]
    atomic.write(manifest, "".join(lines))
    return manifest


def altered(folder: Path) -> list[str]:
    """Files that an archive's manifest lists and that are missing or have another digest; none for other folders."""
    if not own_folders.is_archive(folder):
        return []
    try:
        listed = [line.split("  ", 1) for line in text_file.read_text(folder / own_folders.MANIFEST).splitlines()]
        return [
            name
            for digest, name in listed
            if not (folder / name).is_file() or file_bytes.digest((folder / name).read_bytes()) != digest
        ]
    except (OSError, ValueError):
        return [own_folders.MANIFEST]
