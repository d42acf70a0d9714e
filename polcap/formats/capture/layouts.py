"""Assigns each photograph of a capture folder to a polarizer angle, by one of four folder layouts.

Folders pol000, pol045, …; capture.toml; one flat folder; frames of a polarization sensor. No pixel is decoded;
`reader` checks the plan and builds the `Capture`.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Literal

from polcap.capture_values import AngleStatement, Exif, Role
from polcap.errors import CaptureError
from polcap.formats.capture import capture_toml, folder_names, photograph_files, unequal_brackets
from polcap.formats.capture.capture_toml import CaptureFile
from polcap.formats.capture.folder_names import NUMBER, children, few_names, natural
from polcap.formats.capture.unequal_brackets import ExposedFile, same_exposure
from polcap.formats.own_folders import OURS
from polcap.formats.raw import photo
from polcap.formats.raw.probe import Probe

DEFAULT_DEG = (0.0, 45.0, 90.0)
_COUNTER = 9999  # greatest file number of a camera
_BREAK_S = 600.0  # between two frames: the clock was set, or the photographer had a long break
_LOSSY_SUFFIXES = {".heic", ".heif", ".hif", ".avif", ".webp"}  # of phones and small cameras; not decoded


@dataclass(frozen=True)
class Source:
    """One photograph of a capture folder with its role, polarizer angle, exposure [s] and flash energy."""

    path: Path
    probe: Probe
    role: Role = "shot"
    angle_deg: float | None = None
    exposure: float | None = None  # stated
    flash_energy: float | None = None  # stated


Shots = tuple[tuple[float, tuple[Source, ...]], ...]  # degrees, bracket; in the order of the capture
_Order = Sequence[float] | None  # of the angles, degrees; None: as found


@dataclass(frozen=True)
class Plan:
    """Photographs of a capture folder by polarizer angle, its other photographs (chart…), and notes."""

    layout: Literal["folders", "toml", "flat", "sensor"]
    shots: Shots
    others: tuple[Source, ...] = ()  # ambient, chart, cross
    notes: tuple[str, ...] = ()
    angles: AngleStatement = AngleStatement()  # noqa: RUF009 — frozen


def plan(folder: Path, stated: CaptureFile, angles_deg: _Order) -> Plan:
    """Assign the photographs of a capture folder to polarizer angles, by its layout and its capture.toml.

    `angles_deg` is the order of a flat folder; where folders, names or capture.toml state the angles, it picks from
    them, the first being the reference.

    Raises CaptureError: the folder and its names do not form a capture.
    """
    if stated.frame:
        return _toml(folder, stated, angles_deg)
    sub_folders, crossed = folder_names.angle_folders(folder)
    if sub_folders:
        return _folders(folder, sub_folders, crossed, angles_deg)
    if found := folder_names.views(folder):
        raise CaptureError(
            f"{folder}: its sub-folders {few_names(found)} are views of one object: join them with `polcap fuse`, or "
            "`polcap material` if it is a flat sample; or give one of them"
        )
    if folder_names.is_in_result(folder):
        raise CaptureError(
            f"{folder}: it is a result of polcap or a part of one; give the folder of the photographs, and if they lie "
            "here, move them into one of their own"
        )
    pictures, notes = _list_photographs(folder)
    if not pictures:
        raise CaptureError(f"{folder}: holds no photograph that polcap reads; {_hint(folder)}")
    if stated.of_sensor or _is_sensor(pictures, angles_deg):
        return _sensor(pictures, stated, angles_deg, notes=notes)
    absolute = Path(os.path.abspath(folder))
    if folder_names.is_one_angle(absolute):
        raise CaptureError(f"{folder}: holds one angle of a capture; give the folder of all, {absolute.parent}")
    if groups := _by_name(pictures):
        notes.append("angles read from the file names")
        shots = _select(folder, groups, angles_deg)
        files = tuple(bracket[0].path.name for _, bracket in shots)  # of brackets, the first frames
        return Plan("flat", shots, notes=tuple(notes), angles=AngleStatement("file names", files))
    shots, note = _by_time(folder, pictures, angles_deg or DEFAULT_DEG)
    return Plan("flat", shots, notes=(*notes, note), angles=AngleStatement("order", _texts(shots)))


def _hint(folder: Path) -> str:
    """A sentence on the likely mistake of a user who named a folder without photographs."""
    inside = [path for path in children(folder) if path.is_dir() and not folder_names.is_result(path)]
    names = [path.name for path in inside]
    if remedy := _lossy_or_packed(folder):
        return remedy
    if captures := [path.name for path in inside if folder_names.angle_folder_names(path)]:
        return (
            f"its sub-folders {few_names(captures)} hold captures: give one of them, or run `polcap batch` on the "
            "folder; name views of one object view01, view02, … and run `polcap fuse` (a flat sample: "
            "`polcap material`)"
        )
    if inside:
        new = ", ".join(f"{old} to {name}" for old, name in folder_names.suggested_names(names))
        rename = f"if these are the angles, rename {new}" if new else "if each holds one angle, rename it to that angle"
        return f"its sub-folders are {few_names(names)}, but polcap looks for pol000, pol045, …: {rename}"
    return "give the folder that holds the photographs"


def _lossy_or_packed(folder: Path) -> str:
    """The remedy for a folder of HEIC pictures or of a ZIP archive; empty for any other folder."""
    files = [path for path in children(folder) if path.is_file()]
    lossy = [path.name for path in files if path.suffix.lower() in _LOSSY_SUFFIXES]
    packed = [path.name for path in files if path.suffix.lower() == ".zip"]
    if lossy:
        return f"{few_names(lossy)} are compressed with loss: set the camera or phone to RAW or DNG, and shoot again"
    return f"unpack {few_names(packed)} first" if packed else ""


def counted_clockwise(plan: Plan) -> Plan:
    """Negate all angles of a plan, because they were counted clockwise in the picture."""
    turned = tuple((-angle if angle else 0.0, bracket) for angle, bracket in plan.shots)  # 0, not −0
    others = tuple(replace(one, angle_deg=-one.angle_deg if one.angle_deg else one.angle_deg) for one in plan.others)
    return replace(plan, shots=turned, others=others, notes=(*plan.notes, "angles counted clockwise, as stated"))


def _toml(folder: Path, stated: CaptureFile, angles_deg: _Order) -> Plan:
    """Plan of the photographs that capture.toml lists. Raises CaptureError: one is missing, or is no photograph."""
    sources = []
    for entry in stated.frame:
        path = capture_toml.locate(folder, entry.file)
        if path.is_dir() or not os.path.lexists(path):
            raise CaptureError(f"{folder / capture_toml.NAME}: no file {entry.file}; correct or remove its entry")
        found = photograph_files.read(path)
        if found.kind == "other":
            raise CaptureError(f"{folder / capture_toml.NAME}: {entry.file} is not a photograph; remove its entry")
        sources.append(Source(path, found, entry.role, entry.angle, entry.exposure, entry.flash_energy))
    shots = [source for source in sources if source.role == "shot"]
    others = tuple(source for source in sources if source.role not in ("shot", "repeat"))
    if stated.of_sensor:
        return _sensor(shots, stated, angles_deg, others)
    brackets = _select(folder, _group(shots), angles_deg)
    repeats = _group(source for source in sources if source.role == "repeat")
    repeated = [
        (angle, tuple(bracket))
        for angle, bracket in repeats.items()  # a motor repeats an angle within its tolerance
        if any(abs((angle - known + 90) % 180 - 90) < folder_names.SEPARATION_DEG for known, _ in brackets)
    ]
    all_shots = (*brackets, *repeated)
    return Plan("toml", all_shots, others, angles=AngleStatement("capture.toml", _texts(all_shots)))


def _texts(shots: Shots) -> tuple[str, ...]:
    """Angles of shots as text, as `--angles` and capture.toml state them."""
    return tuple(f"{angle:g}" for angle, _ in shots)


def _group(sources: Iterable[Source]) -> dict[float, list[Source]]:
    """Photographs by their polarizer angle; those without an angle are left out."""
    groups: dict[float, list[Source]] = defaultdict(list)
    for source in sources:
        if source.angle_deg is not None:
            groups[source.angle_deg].append(source)
    return groups


def _folders(folder: Path, sub_folders: dict[float, Path], crossed: Path | None, angles_deg: _Order) -> Plan:
    """Plan of the folders pol000, pol045, …, with notes on files that are not used."""
    groups: dict[float, list[Source]] = {}
    notes = []
    remedy = "shoot this angle again" + (", or remove the folder" if len(sub_folders) > 3 else "")
    for angle, sub_folder in sub_folders.items():
        groups[angle], found = _list_photographs(sub_folder, remedy)
        notes += [f"{sub_folder.name}: {note}" for note in found]
    others: tuple[Source, ...] = ()
    if crossed is not None:
        pictures, _ = _list_photographs(crossed, "shoot it again, or remove the folder")
        crossed_deg = folder_names.degrees_of_cross(crossed)
        others = tuple(replace(source, role="cross", angle_deg=crossed_deg) for source in pictures)
    inside = children(folder)
    used = {*sub_folders.values(), crossed}
    unused = [path.name for path in inside if path.is_dir() and path not in used and path.name not in OURS]
    notes += [f"not used: the folders {', '.join(unused)}"] if unused else []
    loose = [path.name for path in inside if path.is_file() and path.name != capture_toml.NAME]
    notes += [f"not used: the files {few_names(loose)}"] if loose else []
    shots = _select(folder, groups, angles_deg)
    names = tuple(sub_folders[angle].name for angle, _ in shots)
    return Plan("folders", shots, others, tuple(notes), AngleStatement("folders", names))


def _is_sensor(pictures: list[Source], angles_deg: _Order) -> bool:
    """Whether the pictures come from a polarization sensor: one or two monochrome files for three angles or more."""
    grey = [source.probe.kind == "photo" and source.probe.channels == 1 for source in pictures]
    return len(grey) <= 2 and not angles_deg and all(grey)


def _sensor(
    sources: list[Source],
    stated: CaptureFile,
    angles_deg: _Order,
    others: tuple[Source, ...] = (),
    notes: Sequence[str] = (),
) -> Plan:
    """Plan of a polarization sensor's frames: each of them holds all angles."""
    cells = stated.cells or photo.SENSOR_CELLS
    place = {angle % 180: (y, x) for y, row in enumerate(cells) for x, angle in enumerate(row)}
    shots = _select(sources[0].path.parent, dict.fromkeys(sorted(place), sources), angles_deg) if sources else ()
    statement = AngleStatement("cells", _texts(shots), tuple(place[angle] for angle, _ in shots))
    listed = " / ".join(" ".join(f"{angle:g}" for angle in row) for row in cells)
    note = f"frames taken as a polarization sensor's, {listed}"
    return Plan("sensor", shots, others, (*notes, note), statement)


def _by_name(pictures: list[Source]) -> dict[float, list[Source]]:
    """Pictures grouped by the polarizer angle in their names: a number with °, deg or Grad.

    For pictures other than RAW, a plain number counts, if exactly one number differs and can be an angle.
    """
    marked = folder_names.degrees_with_unit([source.path.stem for source in pictures])
    if len(marked) == len(pictures):
        return dict(sorted(_group(replace(one, angle_deg=marked[one.path.stem]) for one in pictures).items()))
    stems = [source.path.stem for source in pictures]
    raw = any(source.probe.kind == "raw" for source in pictures)  # numbers of a camera's counter
    if raw or len({NUMBER.sub("#", stem) for stem in stems}) != 1:
        return {}
    columns = [column for column in zip(*(NUMBER.findall(stem) for stem in stems)) if len(set(column)) > 1]
    if len(columns) != 1 or any(len(text.partition(".")[0]) > 3 for text in columns[0]):
        return {}
    groups = {float(text): [source] for text, source in zip(columns[0], pictures)}
    if max(groups) >= 180 or folder_names.count_axes(groups) < max(3, len(pictures)):
        return {}
    return dict(sorted(groups.items()))


def _by_time(folder: Path, pictures: list[Source], angles_deg: Sequence[float]) -> tuple[Shots, str]:
    """Split the pictures of a flat folder by time into equal brackets, one per angle, with a note on the order."""
    count, shots = len(pictures), len(angles_deg)
    listed = ", ".join(f"{angle:g}" for angle in angles_deg)
    by_hand = "sort the frames into pol000, pol045, …, or list them in capture.toml"
    if not count % shots and count > shots and not all(source.probe.exif.taken for source in pictures):
        raise CaptureError(f"{folder}: {count} frames without EXIF times cannot be assigned to angles; {by_hand}")
    order, criterion = _in_order(pictures, max(count // shots, 1))
    size, first = count // shots, _first_unequal(order, max(count // shots, 1))
    if count % shots or first is not None:
        found = [exposed_file(one.path.name, one.probe.exif) for one in order]
        hint = unequal_brackets.advise_sequence(found, angles_deg) or f"give the order with --angles, or {by_hand}"
        if first is None or count % shots:
            raise CaptureError(f"{folder}: {count} frames do not make {shots} equal brackets (angles {listed}); {hint}")
        value, reference = (one.probe.exif.relative_exposure for one in (order[first], order[first % size]))
        times = f"{value / reference:.3g} times" if value and reference else "not stated like"
        raise CaptureError(
            f"{order[first].path}: its exposure is {times} that of the same frame of the first bracket; these {count} "
            f"frames {criterion} are not {shots} equal brackets ({angles_deg[first // size]:g}°); {hint}"
        )
    note = f"{count} frames {criterion} taken as {shots} brackets of {size}, in the order {listed}°"
    return tuple((angle, tuple(order[k * size : (k + 1) * size])) for k, angle in enumerate(angles_deg)), note


def exposed_file(name: str, exif: Exif, stated: float | None = None) -> ExposedFile:
    """A photograph for `unequal_brackets`; `stated` is its exposure by capture.toml."""
    return ExposedFile(name, stated or exif.relative_exposure, shutter(exif.exposure_time))


def shutter(time: float | None) -> str:
    """A shutter time [s] as text, such as 1/200 s."""
    if not time:
        return "?"
    return f"1/{1 / time:.0f} s" if time < 0.3 else f"{time:.3g} s"


def _in_order(pictures: list[Source], size: int) -> tuple[list[Source], str]:
    """Pictures in the order in which they were taken, by EXIF time or by number, and a phrase on the source.

    Times decide, unless they contradict the numbers: then the order that makes equal brackets of `size` frames decides;
    if both do, the times, unless there is a long break between two of them.
    """
    by_number, times = _by_number(pictures), {source.probe.exif.taken for source in pictures}
    if "" in times or len(times) == 1:
        return by_number, "by name"
    by_time = sorted(by_number, key=lambda one: one.probe.exif.taken)
    one_series = len({NUMBER.sub("#", source.path.stem) for source in pictures}) == 1  # names differ in numbers only
    starts = range(0, len(pictures), size)  # of the brackets, whose frames are compared as sets
    time_sets, number_sets = ([set(map(id, order[k : k + size])) for k in starts] for order in (by_time, by_number))
    if not one_series or time_sets == number_sets:
        return by_time, "by their EXIF times"
    equal_by_time, equal_by_number = (_first_unequal(order, size) is None for order in (by_time, by_number))
    if equal_by_number and (not equal_by_time or _has_break(by_time)):
        return by_number, "by the numbers in their names (their EXIF times contradict: was the clock set?)"
    return by_time, "by their EXIF times (the numbers in their names contradict: were they renamed?)"


def _by_number(pictures: list[Source]) -> list[Source]:
    """Pictures by the numbers in their names; a camera's counter of four digits may begin again in between."""
    order = sorted(pictures, key=lambda source: natural(source.path.name))
    numbers = [int((NUMBER.findall(source.path.stem) or ["0"])[-1].partition(".")[0]) for source in order]
    gaps = [after - before for before, after in pairwise(numbers)]
    start = gaps.index(max(gaps)) + 1 if max(gaps, default=0) > _COUNTER // 2 else 0
    return order[start:] + order[:start]


def _first_unequal(order: Sequence[Source], size: int) -> int | None:
    """Index of the first picture that is not exposed like the same one of the first bracket of `size` frames."""
    exposure = [source.probe.exif.relative_exposure for source in order]
    return next((k for k, value in enumerate(exposure) if not same_exposure(value, exposure[k % size])), None)


def _has_break(by_time: Sequence[Source]) -> bool:
    times = [datetime.fromisoformat(source.probe.exif.taken) for source in by_time]
    return any((after - before).total_seconds() > _BREAK_S for before, after in pairwise(times))


def _select(folder: Path, groups: dict[float, list[Source]], angles_deg: _Order) -> Shots:
    """The shots at the user's angles, in their order; all shots without these. Raises CaptureError: one is missing."""
    wanted = list(groups) if angles_deg is None else list(angles_deg)
    for angle in wanted:
        if angle not in groups:
            listed = ", ".join(f"{known:g}" for known in groups) or "none"
            raise CaptureError(f"{folder}: holds no shot at {angle:g}° (there are {listed}); correct --angles")
    return tuple((angle, tuple(groups[angle])) for angle in wanted)


def _list_photographs(folder: Path, remedy: str = "") -> tuple[list[Source], list[str]]:
    """List the photographs of one folder, with notes; JPEGs and the like are left out if there are RAW files.

    If `remedy` is not empty, a folder without photographs is a CaptureError with this remedy.
    """
    probes, unread = photograph_files.read_all(folder)
    found = [Source(path, one) for path, one in probes.items()]
    raws = [source for source in found if source.probe.kind == "raw"]
    converted = [dng for dng, _ in conversions(raws)]
    raws = [source for source in raws if source not in converted]
    extra = [source for source in found if source.probe.kind == "photo"]
    if remedy and not raws and not extra:
        raise CaptureError(f"{folder}: holds no photograph that polcap reads; {_lossy_or_packed(folder) or remedy}")
    notes = [f"not used: {few_names(unread)}, of other programs"] if unread else []
    if converted:
        notes.append(f"{len(converted)} DNGs are converted from a RAW in the folder: the RAW is used")
    if raws and extra:
        stems = {photograph_files.stem(source.path) for source in raws}
        paired = sum(photograph_files.stem(source.path) in stems for source in extra)
        if paired:
            notes.append(f"{paired} pictures have a RAW of the same name: the RAW is used")
        if paired < len(extra):
            notes.append(f"not used: {len(extra) - paired} finished pictures among RAW files")
    return sorted(raws or extra, key=lambda source: natural(source.path.name)), notes


def conversions(raws: Sequence[Source]) -> list[tuple[Source, Source]]:
    """DNGs that were converted from another RAW of the list, each with that RAW: the same shot, by name and time."""
    pairs = []
    for dng in (source for source in raws if source.path.suffix.lower() == ".dng"):
        original, stem, taken = dng.probe.original.lower(), photograph_files.stem(dng.path), dng.probe.exif.taken[:19]
        for raw in raws:
            is_original = raw.path.name.lower() == original
            is_original |= raw.path.suffix.lower() != ".dng" and photograph_files.stem(raw.path) == stem
            if is_original and raw is not dng and raw.probe.exif.taken[:19] == taken:
                pairs.append((dng, raw))
                break
    return pairs
