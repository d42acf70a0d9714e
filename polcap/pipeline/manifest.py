"""Manifest of a stored stage result: its key and files, and a seal that detects changes."""

import json
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from polcap.formats import text_file

FORMAT = 3  # of work/; raised when older folders can no longer be read
_NOT_SEALED = ("seconds", "digest")  # fields of a manifest that its digest leaves out: no two runs take the same time


class _Manifest(msgspec.Struct, frozen=True):
    """Fields of a manifest.json; `read_manifest` checks them, because another program may have changed the file."""

    format: int
    stage: str
    version: int | list[Any]  # with those of used stages
    settings: dict[str, Any] | None
    inputs: list[str]
    key: str
    seconds: Annotated[float, Meta(ge=0, le=1e9)]
    files: dict[str, tuple[int, str]]
    value: Any
    digest: str


def read_manifest(place: Path) -> dict[str, Any]:
    """Read the manifest of a stored stage result; empty if there is none or it is damaged."""
    try:
        about: dict[str, Any] = text_file.read_json(place / "manifest.json")
        msgspec.convert(about, _Manifest)
    except (OSError, ValueError):
        return {}
    return about if about["format"] == FORMAT and about["digest"] == seal(about) else {}


def seal(about: Mapping[str, Any]) -> str:
    """Digest of a manifest's content, stored in it to detect later changes."""
    return digest({name: value for name, value in about.items() if name not in _NOT_SEALED})


def contents(folder: Path) -> list[dict[str, Any]]:
    """Manifests of all stored stage results of a result folder, in the order of the stages, with sizes in bytes."""
    found = []
    for place in sorted((folder / "work").glob("[0-9][0-9]-*")):
        if about := read_manifest(place):
            size = sum(entry.lstat().st_size for entry in place.iterdir())
            found.append({**about, "folder": place.name, "bytes": size})
    return found


def digest(value: Any) -> str:
    """Digest of plain, nested data; used as a cache key."""
    return blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()
