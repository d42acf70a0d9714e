"""Names of files and folders that other programs put among photographs: ignored by all commands.

They are hidden, or thumbnails and bins of drives and systems, catalogs and sidecars of RAW developers, backups, and
files that are still being copied.
"""

import os
from collections.abc import Iterator
from pathlib import Path, PurePath

# in lower case
_FOLDERS = {
    "@eadir", "#recycle", "#snapshot", "@recycle", "@recently-snapshot", "@tmp", "~snapshot",  # Synology, QNAP, NetApp
    "$recycle.bin", "system volume information", "found.000",  # Windows
    "network trash folder", "temporary items", "__macosx", "lost+found",  # macOS, Linux
    "canonmsc", "eosmisc", "avf_info",  # of cards
    "captureone", "nksc_param", "silkypix_ds", "darktable_exported", "[originals]", "zbthumbnail",  # RAW developers
}  # fmt: skip
_CATALOGS = {".lrdata", ".lrcat-data", ".lrlibrary", ".cocatalog", ".photoslibrary"}  # folders too
_FILES = {"thumbs.db", "ehthumbs.db", "desktop.ini", "autorun.inf", "icon\r", "zbthumbnail.info", "picasa.ini"}
_SIDECARS = {
    ".xmp", ".acr", ".lrcat", ".aae",  # Adobe, Apple
    ".cos", ".cop", ".cot", ".cof", ".comask", ".cosessiondb", ".cocatalogdb",  # Capture One
    ".vrd", ".dr4", ".nksc", ".nka", ".spd", ".dop", ".pp2", ".pp3", ".arp", ".on1", ".onphoto",  # other developers
    ".thm", ".lrv", ".ctg", ".db", ".ini",  # of cameras and systems
    ".bak", ".orig", ".tmp", ".temp", ".part", ".partial", ".filepart", ".crdownload", ".download", ".swp",
}  # fmt: skip
_ENDS = ("~", "_original")  # backups of editors and of ExifTool

_RAW = {
    ".3fr", ".ari", ".arq", ".arw", ".bay", ".bmq", ".cap", ".cine", ".cr2", ".cr3", ".crw", ".cs1", ".dc2", ".dcr",
    ".dng", ".drf", ".dsc", ".eip", ".erf", ".fff", ".gpr", ".ia", ".iiq", ".k25", ".kc2", ".kdc", ".mdc", ".mef",
    ".mos", ".mrw", ".nef", ".nrw", ".orf", ".ori", ".pef", ".ptx", ".pxn", ".qtk", ".r3d", ".raf", ".raw", ".rdc",
    ".rw2", ".rwl", ".rwz", ".sr2", ".srf", ".srw", ".sti", ".x3f",
}  # fmt: skip
_PICTURES = {".exr", ".jpe", ".jpeg", ".jpg", ".png", ".tif", ".tiff"}


def is_ignored_folder(name: str) -> bool:
    """Whether a folder of this name is hidden, or belongs to another program."""
    low = name.lower()
    return low.startswith(".") or low in _FOLDERS or PurePath(low).suffix in _CATALOGS


def is_ignored_file(name: str) -> bool:
    """Whether a file of this name is hidden, a sidecar or backup of another program, or not copied yet."""
    low = name.lower()
    return low.startswith(".") or low in _FILES or low.endswith(_ENDS) or PurePath(low).suffix in _SIDECARS | _CATALOGS


def files_below(folder: Path, result: Path | None = None) -> Iterator[Path]:
    """All files below a folder, without those of other programs and those of a result folder."""
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not is_ignored_folder(name) and Path(place, name) != result]
        yield from (Path(place, name) for name in files if not is_ignored_file(name))


def is_photograph(name: str, among_raw: bool) -> bool:
    """Whether a file of this name is a photograph, by its suffix; `among_raw`: other files of the folder are RAW."""
    suffix = PurePath(name).suffix.lower()
    return suffix in _RAW or (suffix in _PICTURES and not among_raw)
