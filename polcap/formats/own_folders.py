"""Paths of polcap's folders: results among photographs, and the user's calibrations.

Imports no library: a run that finds nothing changed needs only these names.
"""

import os
import sys
from pathlib import Path

OUTPUT = "polcap"  # default folder of results
FUSED = "fused"  # default folder of the result of `polcap fuse`, next to the views
BATCH = "polcap-batch"  # folder of a batch's records, in ROOT or in --out; safe to delete
MATERIAL = "material"  # default folder of the result of `polcap material`, next to the views
MANIFEST = "manifest-sha256.txt"  # of an archive: digests of its files
OURS = (OUTPUT, BATCH)  # these folders hold no photographs


def find_result(named: Path) -> Path:
    """The result folder that a path names: itself, or the result in the folder of a capture or of views."""
    if not any((named / name).exists() for name in ("work", "report.json", "maps")):
        for inside in (named / name for name in (OUTPUT, FUSED, MATERIAL)):
            if (inside / "report.json").exists() or (inside / "work").is_dir():
                return inside
    return named


def is_archive(folder: Path) -> bool:
    """Whether a folder is an archive of `polcap export --preset archive`, or a copy of one."""
    return (folder / MANIFEST).is_file() and not (folder / "work").is_dir()


def calibrations() -> Path:
    """Path of the folder with the user's calibrations; it may not exist."""
    if stated := os.environ.get("POLCAP_CALIB"):
        return Path(stated)
    home = Path(os.path.expanduser("~"))  # no error without a home, unlike Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA", home / "AppData" / "Roaming")) / "polcap" / "calib"
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "polcap" / "calib"
    return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "polcap" / "calib"


def ball_accuracies() -> Path:
    """Path of the folder with the measurements of `polcap validate`; it may not exist."""
    return calibrations() / "balls"


def toml_files(folder: Path) -> list[Path]:
    """TOML files of a folder by name, without hidden ones of macOS or a killed run; none if it cannot be opened."""
    try:
        return sorted(path for path in folder.glob("[!.]*.toml") if path.is_file())
    except OSError:
        return []
