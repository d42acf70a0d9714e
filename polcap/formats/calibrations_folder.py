"""Where the user's calibrations lie, and which there are; imports nothing that takes time.

`$POLCAP_CALIB` names the folder; else it is where the system keeps a user's settings.
"""

import os
import sys
from pathlib import Path


def folder() -> Path:
    """Where the user's calibrations lie; it need not exist."""
    if stated := os.environ.get("POLCAP_CALIB"):
        return Path(stated)
    home = Path(os.path.expanduser("~"))  # never raises, whatever account this runs under
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA", home / "AppData" / "Roaming")) / "polcap" / "calib"
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "polcap" / "calib"
    return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "polcap" / "calib"


def files() -> list[Path]:
    """All calibration files of the user, by name."""
    try:
        there = [path for path in folder().iterdir() if path.suffix == ".toml" and path.is_file()]
        return sorted(path for path in there if not path.name.startswith("."))  # ._ of macOS, .part of a killed run
    except OSError:
        return []
