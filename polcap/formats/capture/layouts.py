"""Finds which photograph of a folder was taken at which angle, by one of four layouts.

Folders pol000, pol045, …; capture.toml; one flat folder; frames of a polarization sensor. No pixel is decoded;
`reader` checks the plan and builds the `Capture`.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

from polcap import parallel
from polcap.errors import CaptureError
from polcap.formats.capture import capture_toml
from polcap.formats.capture.capture_toml import CaptureFile
from polcap.formats.own_folders import OURS
from polcap.formats.raw import photo, probe
from polcap.formats.raw.probe import Probe
from polcap.images import Role

DEFAULT_DEG = (0.0, 45.0, 90.0)
SEPARATION_DEG = 5.0  # closer angles count as one
EQUAL_STOPS = 0.15  # EXIF rounds exposure times to a sixth of a stop at most
_POL_FOLDER = re.compile(r"pol[ _-]?(\d+(?:\.\d+)?)", re.IGNORECASE)
_CROSS_FOLDER = re.compile(r"cross(?:[ _-]?(\d+(?:\.\d+)?))?", re.IGNORECASE)
_AT_ONCE = 2  # files read in parallel: as many child processes as decode them later
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Source:
    """One photograph and its role in the capture."""

    path: Path
    probe: Probe
    role: Role = "shot"
    angle_deg: float | None = None
    exposure: float | None = None  # stated
    flash_energy: float | None = None  # stated


@dataclass(frozen=True)
class Plan:
    """The shots of a capture, and its other photographs."""

    layout: Literal["folders", "toml", "flat", "sensor"]
    shots: tuple[tuple[float, tuple[Source, ...]], ...]  # degrees, bracket; in the order of the capture
    others: tuple[Source, ...] = ()  # ambient, chart, cross
    notes: tuple[str, ...] = ()


@dataclass
class _Listing:
    pictures: list[Source] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def plan(folder: Path, stated: CaptureFile, angles_deg: Sequence[float] | None) -> Plan:
    """Plan the shots of a folder with its capture.toml.

    `angles_deg` is the order of a flat folder; where folders, names or capture.toml state the angles, it picks from
    them, the first being the reference.

    Raises
    ------
    CaptureError
        The folder and its names do not form a capture.
    """
    if stated.frame:
        return _toml(folder, stated, angles_deg)
    sub_folders = _pol_folders(folder)
    if sub_folders:
        return _folders(folder, sub_folders, angles_deg)
    listing = _list(folder)
    if not listing.pictures:
        inside = [path for path in children(folder) if path.is_dir()]
        named = f"{', '.join(path.name for path in inside[:4])}{', …' if len(inside) > 4 else ''}"
        hint = "; give the folder that holds the photographs"
        if any(_pol_folders(path) for path in inside):
            hint = f"; its sub-folders {named} hold captures: give one of them, or run `polcap batch` on the folder"
        elif (folder / "report.json").is_file() and (folder / "maps").is_dir():
            hint = "; it is a result of polcap: give the folder of the photographs"
        elif inside:
            hint = f"; its sub-folders are {named}, but polcap looks for pol000, pol045, …"
        raise CaptureError(f"{folder}: holds no photograph that polcap reads{hint}")
    if stated.sensor or _is_sensor(listing.pictures, angles_deg):
        return _sensor(listing, angles_deg)
    whole = Path(os.path.abspath(folder))
    if is_angle_folder(whole.name) and len(_pol_folders(whole.parent)) > 1:
        raise CaptureError(f"{folder}: holds one angle of a capture; give the folder of all, {whole.parent}")
    return _named(folder, listing, angles_deg) or _by_time(folder, listing, angles_deg or DEFAULT_DEG)


def looks_like_a_capture(folder: Path, inside: Iterable[str], files: Iterable[str]) -> bool:
    """Whether a folder of these sub-folders and files is one capture, by names and the first bytes of files.

    Photographs in a folder that has sub-folders are taken for notes, unless there is a capture.toml.
    """
    if capture_toml.NAME in files or any(_POL_FOLDER.fullmatch(name) for name in inside):
        return True
    if any(name not in OURS and not name.startswith(".") for name in inside):
        return False
    return any(probe.kind(folder / name) in ("raw", "photo") for name in sorted(files) if not name.startswith("."))


def _toml(folder: Path, stated: CaptureFile, angles_deg: Sequence[float] | None) -> Plan:
    sources = []
    for entry in stated.frame:
        path = folder / entry.file
        if not path.exists():
            path = folder / entry.file.replace("\\", "/")  # as Windows writes it
        if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
            raise CaptureError(f"{folder / capture_toml.NAME}: {entry.file} lies outside the folder; move it inside")
        if not path.is_file():
            raise CaptureError(f"{folder / capture_toml.NAME}: no file {entry.file}; correct or remove its entry")
        found = _probe(path)
        if found.kind == "other":
            raise CaptureError(f"{folder / capture_toml.NAME}: {entry.file} is not a photograph; remove its entry")
        sources.append(Source(path, found, entry.role, entry.angle, entry.exposure, entry.flash_energy))
    shots = [source for source in sources if source.role == "shot"]
    others = tuple(source for source in sources if source.role not in ("shot", "repeat"))
    if stated.sensor:
        return Plan("sensor", _sensor_shots(shots, angles_deg), others)
    repeats = [source for source in sources if source.role == "repeat"]
    brackets = _select(folder, _group(shots), angles_deg)
    repeated = [(angle, tuple(bracket)) for angle, bracket in _group(repeats).items() if _near(angle, dict(brackets))]
    return Plan("toml", (*brackets, *repeated), others)


def _near(angle_deg: float, known_deg: Iterable[float]) -> bool:
    """Whether an angle equals a known one but for a motor's tolerance."""
    return any(abs((angle_deg - known + 90) % 180 - 90) < SEPARATION_DEG for known in known_deg)


def _group(sources: Iterable[Source]) -> dict[float, list[Source]]:
    groups: dict[float, list[Source]] = defaultdict(list)
    for source in sources:
        if source.angle_deg is not None:
            groups[source.angle_deg].append(source)
    return groups


def _folders(folder: Path, sub_folders: dict[float, Path], angles_deg: Sequence[float] | None) -> Plan:
    groups: dict[float, list[Source]] = {}
    notes = []
    for angle, sub_folder in sub_folders.items():
        listing = _list(sub_folder)
        if not listing.pictures:
            raise CaptureError(
                f"{sub_folder}: holds no photograph that polcap reads; shoot this angle again, or remove the folder"
            )
        groups[angle] = listing.pictures
        notes += [f"{sub_folder.name}: {note}" for note in listing.notes]
    crossed = _crossed(folder)
    unused = sorted(
        path.name
        for path in children(folder)
        if path.is_dir() and path not in sub_folders.values() and path.name not in OURS and not _is_crossed(path.name)
    )
    notes += [f"not used: the folders {', '.join(unused)}"] if unused else []
    loose = sorted(path.name for path in children(folder) if path.is_file() and path.name != capture_toml.NAME)
    notes += [f"not used: the files {', '.join(loose[:4])}{', …' if len(loose) > 4 else ''}"] if loose else []
    return Plan("folders", _select(folder, groups, angles_deg), crossed, tuple(notes))


def numbered(folder: Path) -> list[str]:
    """Sub-folders whose names hold a number but are not read as an angle: 045, angle45."""
    return [
        path.name
        for path in children(folder)
        if path.is_dir() and not is_angle_folder(path.name) and path.name not in OURS and _NUMBER.search(path.name)
    ]


def _crossed(folder: Path) -> tuple[Source, ...]:
    """The photographs of cross/ or cross045/, whose number is the angle of the filter before the lens."""
    places = [path for path in children(folder) if path.is_dir() and _is_crossed(path.name)]
    if len(places) > 1:
        raise CaptureError(f"{places[1]}: {places[0].name} holds a cross-polarized shot too; remove one of the two")
    if not places:
        return ()
    match = _CROSS_FOLDER.fullmatch(places[0].name)
    angle = float(match[1]) if match and match[1] else None
    if angle is not None and angle > 360:
        raise CaptureError(f"{places[0]}: {angle:g}° is not an angle of a polarizer; name it by 0 to 360 degrees")
    found = tuple(replace(source, role="cross", angle_deg=angle) for source in _list(places[0]).pictures)
    if not found:
        raise CaptureError(f"{places[0]}: holds no photograph that polcap reads; shoot it again, or remove the folder")
    return found


def _is_crossed(name: str) -> bool:
    return _CROSS_FOLDER.fullmatch(name) is not None


def degrees(angle_deg: float) -> str:
    """An angle 0…360 as in the names of shot folders: 045, 022.5; to a thousandth."""
    whole, _, rest = f"{angle_deg:.3f}".partition(".")
    return f"{int(whole):03d}" + (f".{rest.rstrip('0')}" if rest.strip("0") else "")


def is_angle_folder(name: str) -> bool:
    """Whether a folder of this name inside a capture holds the shots of one angle, or the crossed one."""
    return _POL_FOLDER.fullmatch(name) is not None or _is_crossed(name)


def _pol_folders(folder: Path) -> dict[float, Path]:
    found: dict[float, Path] = {}
    for path in children(folder):
        match = _POL_FOLDER.fullmatch(path.name) if path.is_dir() else None
        if match:
            angle = float(match[1])
            if angle > 360:
                raise CaptureError(f"{path}: {angle:g}° is not an angle of a polarizer; name it by 0 to 360 degrees")
            if angle in found:
                raise CaptureError(f"{path}: {angle:g}° is also in {found[angle].name}; remove one of the two folders")
            found[angle] = path
    return dict(sorted(found.items()))


def _is_sensor(pictures: list[Source], angles_deg: Sequence[float] | None) -> bool:
    """One or two grey pictures: three angles can only be a polarization sensor's."""
    return len(pictures) <= 2 and not angles_deg and all(_is_grey(source) for source in pictures)


def _is_grey(source: Source) -> bool:
    return source.probe.kind == "photo" and source.probe.channels == 1


def _sensor(listing: _Listing, angles_deg: Sequence[float] | None) -> Plan:
    shots = _sensor_shots(listing.pictures, angles_deg)
    return Plan("sensor", shots, notes=(*listing.notes, "frames taken as a polarization sensor's, 90 45 / 135 0"))


def _sensor_shots(
    sources: Sequence[Source], angles_deg: Sequence[float] | None
) -> tuple[tuple[float, tuple[Source, ...]], ...]:
    groups = {angle: list(sources) for angle, _ in photo.SENSOR_DEG}
    return _select(sources[0].path.parent, groups, angles_deg) if sources else ()


def _named(folder: Path, listing: _Listing, angles_deg: Sequence[float] | None) -> Plan | None:
    """Finished pictures whose names differ in one number that can only be an angle."""
    pictures = listing.pictures
    if any(source.probe.kind == "raw" for source in pictures):  # a camera's file numbers
        return None
    stems = [source.path.stem for source in pictures]
    if len({_NUMBER.sub("#", stem) for stem in stems}) != 1:
        return None
    columns = [column for column in zip(*(_NUMBER.findall(stem) for stem in stems)) if len(set(column)) > 1]
    if len(columns) != 1 or any(len(text.partition(".")[0]) > 3 for text in columns[0]):
        return None
    angles = [float(text) for text in columns[0]]
    if max(angles) >= 180 or len(set(angles)) < len(angles) or different(angles) < max(3, len(angles)):
        return None
    groups = {angle: [source] for angle, source in sorted(zip(angles, pictures), key=lambda pair: pair[0])}
    notes = (*listing.notes, "angles read from the file names")
    return Plan("flat", _select(folder, groups, angles_deg), notes=notes)


def _by_time(folder: Path, listing: _Listing, angles_deg: Sequence[float]) -> Plan:
    """K equal brackets one after the other."""
    facts = {source.path: source.probe.exif for source in listing.pictures}
    timed = all(fact.taken for fact in facts.values())
    order = sorted(
        listing.pictures,
        key=lambda source: (facts[source.path].taken if timed else "", natural(source.path.name)),
    )
    count, shots = len(order), len(angles_deg)
    by = "by their EXIF times" if timed else "by name"
    listed = ", ".join(f"{angle:g}" for angle in angles_deg)
    sort = "sort the frames into pol000, pol045, …, or list them in capture.toml"
    remedy = f"give the order with --angles, or {sort}"
    if count % shots:
        raise CaptureError(f"{folder}: {count} frames do not make {shots} equal brackets (angles {listed}); {remedy}")
    size = count // shots
    if not timed and size > 1:
        raise CaptureError(f"{folder}: {count} frames without EXIF times cannot be assigned to angles; {sort}")
    brackets = [order[at : at + size] for at in range(0, count, size)]
    first = [facts[source.path].relative_exposure for source in brackets[0]]
    for angle, bracket in zip(angles_deg, brackets):
        for source, reference in zip(bracket, first):
            value = facts[source.path].relative_exposure
            if not equal(value, reference):
                raise CaptureError(
                    f"{source.path}: its exposure is {_times(value, reference)} that of the same frame of the first "
                    f"bracket; these {count} frames {by} are not {shots} equal brackets ({angle:g}°); {remedy}"
                )
    note = f"{count} frames {by} taken as {shots} brackets of {size}, in the order {listed}°"
    shots_ = tuple((angle, tuple(bracket)) for angle, bracket in zip(angles_deg, brackets))
    return Plan("flat", shots_, notes=(*listing.notes, note))


def equal(value: float | None, reference: float | None) -> bool:
    """Whether two exposures are the same, as precisely as the camera states them."""
    if not value or not reference:
        return value == reference
    return max(value / reference, reference / value) < 2**EQUAL_STOPS


def _times(value: float | None, reference: float | None) -> str:
    return f"{value / reference:.3g} times" if value and reference else "not stated like"


def _select(
    folder: Path, groups: dict[float, list[Source]], angles_deg: Sequence[float] | None
) -> tuple[tuple[float, tuple[Source, ...]], ...]:
    wanted = list(groups) if angles_deg is None else list(angles_deg)
    for angle in wanted:
        if angle not in groups:
            listed = ", ".join(f"{known:g}" for known in groups) or "none"
            raise CaptureError(f"{folder}: holds no shot at {angle:g}° (there are {listed}); correct --angles")
    return tuple((angle, tuple(groups[angle])) for angle in wanted)


def different(angles_deg: Iterable[float]) -> int:
    """The number of different polarizer axes, modulo 180 degrees."""
    axes = sorted(angle % 180 for angle in angles_deg)
    gaps = [b - a for a, b in pairwise([*axes, axes[0] + 180])] if axes else []
    return max(sum(gap >= SEPARATION_DEG for gap in gaps), 1 if axes else 0)


def _list(folder: Path) -> _Listing:
    """The photographs of one folder; finished pictures are left out where there is a RAW."""
    listing = _Listing()
    files = [path for path in children(folder) if path.is_file()]
    probes = parallel.results([partial(_probe, path) for path in files], min(_AT_ONCE, parallel.threads()))
    found = list(map(Source, files, probes))
    pictures = [source for source in found if source.probe.kind in ("raw", "photo")]
    raws = [source for source in pictures if source.probe.kind == "raw"]
    if raws and len(raws) < len(pictures):
        stems = {source.path.stem.lower() for source in raws}
        extra = [source.path for source in pictures if source.probe.kind == "photo"]
        paired = sum(path.stem.lower() in stems for path in extra)
        if paired:
            listing.notes.append(f"{paired} pictures have a RAW of the same name: the RAW is used")
        if paired < len(extra):
            listing.notes.append(f"not used: {len(extra) - paired} finished pictures among RAW files")
    listing.pictures = sorted(raws or pictures, key=lambda source: natural(source.path.name))
    return listing


def _probe(path: Path) -> Probe:
    """The facts of a file; CaptureError where no decoder can read it."""
    found = probe.read(path)
    if found.kind == "unknown":
        raise CaptureError(f"{path}: not a picture, a RAW that LibRaw knows, or text; restore the file, or remove it")
    return found


def children(folder: Path) -> list[Path]:
    """The files and folders in a folder, by name, without hidden ones (.DS_Store, ._DSC0001.NEF); CaptureError."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise CaptureError(f"{folder}: cannot be listed ({error.strerror}); check the folder") from None


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """Sorting key that puts frame 9 before frame 10."""
    return tuple((int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name))
