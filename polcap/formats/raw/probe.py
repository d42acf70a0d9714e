"""A path in, all that a file tells without its pixels out: kind, digest of its bytes, EXIF, size.

One call into the worker a file, and one reading of it: tags and digest are of the same bytes.
"""

import io
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from polcap.errors import DecodeError
from polcap.formats.raw import exif, photo, photo_bytes, plausible, sniff, worker
from polcap.formats.raw import libraw as raw
from polcap.images import Exif

_LIMIT_S, _LIMIT_GIB = 30.0, 2.0  # a sound file takes milliseconds and thrice its size


@dataclass(frozen=True)
class Probe:
    """What one file tells of itself."""

    kind: sniff.Kind
    digest: str = ""  # of the bytes of a photograph
    exif: Exif = Exif()  # noqa: RUF009 — frozen
    channels: int = 0  # of a finished picture: 1 grey, 3 in color
    bits: int = 0  # of a finished picture, per channel
    lossy: bool = False  # a RAW of 8 bits under a curve


def read(path: str | Path) -> Probe:
    """Kind, digest and metadata of a file, with its size in visible RAW pixels.

    What LibRaw knows and nobody else is a RAW too.

    Raises
    ------
    DecodeError
        The file cannot be read, no decoder recognises it, it is cut short or of a form that polcap refuses.
    """
    answer, _ = worker.call(examine, path, limit_s=_LIMIT_S, limit_gib=_LIMIT_GIB)
    found = msgspec.convert(answer["probe"], Probe)
    if answer["doubtful"]:  # decoding tells; some cameras note odd places for previews
        raw.read(path) if found.kind == "raw" else photo.read(path)
    return found


def kind(path: str | Path) -> sniff.Kind:
    """The kind alone, by the first bytes. Raises DecodeError where the file cannot be read."""
    answer, _ = worker.call(sniffed, path, limit_s=_LIMIT_S, limit_gib=_LIMIT_GIB)
    found: sniff.Kind = answer["kind"]
    return found


def sniffed(path: str) -> worker.Answer:
    """The same, in the worker."""
    with photo_bytes.opened(path) as file:
        return {"kind": sniff.kind(file, Path(path).suffix)}, {}


def examine(path: str) -> worker.Answer:
    """What `read` says, and whether only decoding can tell if the file is whole. In the worker; raises DecodeError."""
    with photo_bytes.opened(path) as file:
        found = sniff.kind(file, Path(path).suffix)
        if found == "other":
            return _answer(Probe(found))
        file.seek(0)
        data = file.read()
    if not data:
        raise DecodeError(f"{path}: is empty; copy it from the card again, or remove it")
    if found == "photo":
        return _photo(path, data)
    try:
        return _raw(path, data)
    except DecodeError:
        if found == "raw":
            raise
        return _answer(Probe("unknown"))


def _photo(path: str, data: bytes) -> worker.Answer:
    size = photo.size(path, data)
    stated = exif.sized(exif.tags(data), size["width"], size["height"])
    found = Probe("photo", photo_bytes.digest(data), stated, size["channels"], size["bits"])
    return _answer(found, sniff.structure(io.BytesIO(data)).truncated)


def _raw(path: str, data: bytes) -> worker.Answer:
    structure = sniff.structure(io.BytesIO(data))
    plausible.check_structure(path, structure, data)
    known = exif.tags(data)
    bare = known.exposure_time is None and not known.make  # CRW: the decoder knows more, but has to unpack
    silent = known.iso is None and not structure.dng  # old bodies tell it in makers' tags, or have but one
    size = raw.size(path, data, unpack=bare or silent)
    decoded = {name: value for name, value in size.get("exif", {}).items() if bare or not getattr(known, name)}
    stated = replace(exif.sized(known, size["width"], size["height"]), **decoded)
    lossy = plausible.is_lossy(structure)
    return _answer(Probe("raw", photo_bytes.digest(data), stated, lossy=lossy), structure.truncated or lossy)


def _answer(found: Probe, doubtful: bool = False) -> worker.Answer:
    answer: dict[str, Any] = {"probe": asdict(found), "doubtful": doubtful}
    return answer, {}
