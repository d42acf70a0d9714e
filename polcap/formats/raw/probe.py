"""Probes a photograph: kind, digest, EXIF and size, without decoding its pixels.

The child process reads the file once, so metadata and digest belong to the same bytes.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec

from polcap.capture_values import Exif
from polcap.errors import DecodeError
from polcap.formats import sandbox
from polcap.formats.raw import exif, file_bytes, file_checks, file_kind, libraw, photo, picture_count
from polcap.formats.raw.color_encoding import ColorEncoding

_LIMIT_S = 30.0  # a sound file takes milliseconds


@dataclass(frozen=True)
class Probe:
    """Facts of one photograph's file: kind, digest, EXIF, channels, bits, encoding, and how it was compressed."""

    kind: file_kind.Kind
    digest: str = ""  # of the bytes of a photograph
    exif: Exif = Exif()  # noqa: RUF009 — frozen
    channels: int = 0  # of a finished picture: 1 grey, 3 in color
    bits: int = 0  # of a finished picture, per channel
    lossy: bool = False  # a RAW of 8 bits under a tone curve
    encoding: ColorEncoding = ColorEncoding()  # noqa: RUF009 — frozen; as a finished picture states it
    top: float = 0.0  # greatest value of a picture in floating point
    gain_map: bool = False  # holds one that polcap does not apply
    original: str = ""  # name of the RAW from which a DNG was converted


def read(path: str | Path) -> Probe:
    """Kind, digest and metadata of a file, with its size in visible RAW pixels.

    A file of unknown content that LibRaw can open is a RAW too. Raises DecodeError: the file cannot be read, no decoder
    recognizes it, it is cut short or of a form that polcap refuses.
    """
    answer, _ = sandbox.call(examine, path, limit_s=_LIMIT_S)
    found = msgspec.convert(answer["probe"], Probe)
    if answer["doubtful"]:  # some cameras store odd offsets for previews: only decoding shows whether it is cut
        libraw.read(path) if found.kind == "raw" else photo.read(path)
    return found


def kind(path: str | Path) -> file_kind.Kind:
    """Kind of a file by its first bytes. Raises DecodeError if the file cannot be read."""
    found: file_kind.Kind = sandbox.call(examine_kind, path, limit_s=_LIMIT_S)[0]["kind"]
    return found


def examine_kind(path: str) -> sandbox.Answer:
    """In the child process: detect the kind of a file, as `kind` does."""
    with file_bytes.opened(path) as file:
        return {"kind": file_kind.kind(file, Path(path).suffix)}, {}


def examine(path: str) -> sandbox.Answer:
    """In the child process: probe a file as `read` does. Raises DecodeError.

    The answer is "doubtful" if only decoding can show whether the file is complete.
    """
    with file_bytes.opened(path) as file:
        found = file_kind.kind(file, Path(path).suffix)
        if found == "other":
            return {"probe": asdict(Probe(found)), "doubtful": False}, {}
        file.seek(0)
        data = file.read()
    if not data:
        raise DecodeError(f"{path}: is empty; copy it from the card again, or remove it")
    try:
        probe, doubtful = _photo(path, data) if found == "photo" else _raw(path, data)
    except DecodeError:
        if found != "unknown":
            raise
        probe, doubtful = Probe("unknown"), False
    return {"probe": asdict(probe), "doubtful": doubtful}, {}


def _photo(path: str, data: bytes) -> tuple[Probe, bool]:
    """Facts of a finished picture, and whether its structure is cut off."""
    facts, structure = photo.describe(path, data), file_kind.structure(data)
    stated = exif.sized(exif.tags(data), facts.pop("width"), facts.pop("height"))
    gain_map = picture_count.has_gain_map(data, structure)
    return Probe("photo", file_bytes.digest(data), stated, gain_map=gain_map, **facts), structure.truncated


def _raw(path: str, data: bytes) -> tuple[Probe, bool]:
    """Facts of a RAW file, and whether its structure is cut off. Raises DecodeError."""
    structure = file_kind.structure(data)
    file_checks.check_structure(path, structure, data)
    picture_count.check_single_raw(path, structure)
    tagged = exif.tags(data)
    no_settings = tagged.exposure_time is None and not tagged.make  # CRW: LibRaw knows them, but has to unpack
    no_iso = tagged.iso is None and not structure.dng  # old bodies state it in their maker's tags only
    size = libraw.size(path, data, unpack=no_settings or no_iso)
    # settings that only LibRaw knows; not its time, which may be that of writing
    decoded = {k: v for k, v in size.get("exif", {}).items() if no_settings or not (getattr(tagged, k) or k == "taken")}
    stated = replace(exif.sized(tagged, size["width"], size["height"]), **decoded)
    lossy = file_checks.is_lossy(structure)
    probe = Probe(
        kind="raw",
        digest=file_bytes.digest(data),
        exif=stated,
        lossy=lossy,
        gain_map=picture_count.has_gain_map(data, structure),
        original=file_kind.original_name(structure),
    )
    return probe, structure.truncated or lossy
