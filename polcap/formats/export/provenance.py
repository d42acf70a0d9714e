"""The origin of an export (photographs, versions, settings), as a sidecar file and as texts for other formats."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec

from polcap import __version__
from polcap.formats import atomic, text_file

_PARTS = (
    "numpy", "scipy", "opencv-contrib-python-headless", "onnxruntime", "rawpy", "OpenImageIO", "trimesh",
    "colour-science",
)  # fmt: skip


class _Sidecar(msgspec.Struct, frozen=True):
    """Fields of a sidecar file that polcap reads."""

    stages: dict[str, str]
    files: dict[str, str]


def versions() -> dict[str, str]:
    """Installed versions of polcap and of the packages that affect pixels."""
    found = {"polcap": __version__}
    for name in _PARTS:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def record(about: Mapping[str, Any], catalog: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The origin of a result (photographs, versions, settings) and its verdict, from the content of its report.json.

    Fields of the capture's `CatalogEntry` follow, where stated; those of `catalog` replace them.
    """
    capture, model, error = about["capture"], about["model"], about.get("expected_error_deg")
    chart = about.get("figures", {}).get("chart", {}).get("reference_sha256")  # of a file of measurements
    return {
        "format": "polcap provenance 1",
        "name": capture["name"],
        **capture.get("catalog", {}),
        **(catalog or {}),
        "verdict": about["verdict"],
        **({} if error is None else {"expected_error_deg": error}),  # median of the normals
        "camera": capture["camera"],
        **{key: text for key in ("serial", "lens", "taken") if (text := capture.get(key))},
        **({"chart_sha256": chart} if chart else {}),
        "photographs": [  # after a space the digest names how the file was read
            {"file": frame["file"], "angle_deg": shot["angle_deg"], "sha256": frame["digest"].partition(" ")[0]}
            for shot in capture["shots"]
            for frame in shot["frames"]
        ],
        "versions": about.get("versions", {"polcap": about["polcap"]}),
        "model": model,  # of the network, from its file; described in calib/models/polcap.md; null: analytic
        "settings": about["settings"],
        "stages": about["keys"],
        "random_seeds": "fixed in the stages, part of their versions",
    }


def words(facts: Mapping[str, Any]) -> dict[str, str]:
    """The origin of a result as texts by key, for file formats that store only texts."""
    encode = json.JSONEncoder(separators=(",", ":")).encode
    return {key: value if isinstance(value, str) else encode(value) for key, value in facts.items()}


def write(path: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """Write the sidecar file of an export: its origin (`facts`) and the digest of each exported file.

    The sidecar of an earlier export with the same record also listed its files; those that exist stay in the list.
    """
    earlier = read(path)
    files = earlier.pop("files", {})
    if earlier != json.loads(json.dumps(facts)):
        files = {}
    files = {name: known for name, known in files.items() if os.path.exists(path.parent / name)} | dict(digests)
    atomic.write_json(path, {**facts, "files": dict(sorted(files.items()))})


def read(path: Path) -> dict[str, Any]:
    """The content of a sidecar file; empty if it is not one of polcap, or cannot be read."""
    try:
        about: dict[str, Any] = text_file.read_json(path)
        msgspec.convert(about, _Sidecar)
    except (OSError, ValueError):
        return {}
    return about
