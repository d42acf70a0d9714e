"""In: a result's report and the files of an export. Out: what they were made from, as a sidecar and as words."""

import json
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from polcap import __version__
from polcap.formats import atomic
from polcap.formats.raw import photo_bytes

_PARTS = (
    "numpy", "scipy", "opencv-contrib-python-headless", "onnxruntime", "rawpy", "OpenImageIO", "trimesh",
    "colour-science",
)  # fmt: skip


def versions() -> dict[str, str]:
    """polcap and the packages that decide on pixels, as installed when they were first asked for."""
    return dict(_installed())


@cache
def _installed() -> dict[str, str]:
    """Read from files, which takes 25 ms."""
    found = {"polcap": __version__}
    for name in _PARTS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def record(about: Mapping[str, Any]) -> dict[str, Any]:
    """What report.json tells of where a result comes from."""
    capture, model = about["capture"], about["model"]
    return {
        "format": "polcap provenance 1",
        "name": capture["name"],
        "camera": capture["camera"],
        "photographs": [  # behind a digest may stand how the file was read
            {"file": frame["file"], "angle_deg": shot["angle_deg"], "sha256": frame["digest"].partition(" ")[0]}
            for shot in capture["shots"]
            for frame in shot["frames"]
        ],
        "versions": about.get("versions", {"polcap": about["polcap"]}),
        "model": model,  # of the network, as its file tells; its card is calib/models/polcap.md; null: analytic
        "settings": about["settings"],
        "stages": about["keys"],
        "random_seeds": "fixed in the stages, part of their versions",
    }


def words(facts: Mapping[str, Any]) -> dict[str, str]:
    """The same as texts, for formats that keep only those."""
    return {key: value if isinstance(value, str) else _plain(value) for key, value in facts.items()}


def write(path: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """The sidecar: the record, and the `digest` of every file of the export by its name.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    with atomic.path(path) as temporary:
        text = json.dumps({**facts, "files": dict(sorted(digests.items()))}, indent=1, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")  # names of files are bytes


def digest(file: Path) -> str:
    """What a sidecar tells of a file."""
    return photo_bytes.digest(file.read_bytes())


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=True, separators=(",", ":"))
