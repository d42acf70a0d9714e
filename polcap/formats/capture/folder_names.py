"""Folders of photographs by their names: shots of one angle, views of an object, captures, results.

Nothing but names is read; `layouts` assigns the photographs themselves.
"""

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from polcap.errors import CaptureError
from polcap.formats.capture import foreign_files
from polcap.formats.own_folders import OURS, find_result

SEPARATION_DEG = 5.0  # closer angles count as one
NUMBER = re.compile(r"\d+(?:\.\d+)?")
_FOLDER_NUMBER = re.compile(r"\d+(?:[.,]\d+)?")
_FOLDER = re.compile(r"pol[ _-]?(?P<pol>\d+(?:\.\d+)?)|cross(?:[ _-]?(?P<cross>\d+(?:\.\d+)?))?", re.IGNORECASE)
_DEGREES = re.compile(r"(\d+(?:[.,]\d+)?)[ _-]*(?:[°º˚]|(?:deg|degrees?|grad)(?![^\W\d_]))", re.IGNORECASE)
_VIEW = re.compile(r"view[ _-]?\d+", re.IGNORECASE)


def children(folder: Path) -> list[Path]:
    """Files and folders in a folder by name, without those that `foreign_files` ignores. Raises CaptureError."""
    try:
        return sorted(path for path in folder.iterdir() if not _is_ignored(path))
    except OSError as error:
        raise CaptureError(f"{folder}: cannot be listed ({error.strerror}); check the folder") from None


def _is_ignored(path: Path) -> bool:
    if path.is_dir():
        return foreign_files.is_ignored_folder(path.name)
    return foreign_files.is_ignored_file(path.name)


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """Sorting key for file names with numbers: frame 9 before frame 10."""
    return tuple((int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name))


def few_names(names: Sequence[str]) -> str:
    """The first four names of a list for a message, with … for the others."""
    return f"{', '.join(names[:4])}{', …' if len(names) > 4 else ''}"


def is_result(folder: Path) -> bool:
    """Whether a folder is a result of polcap, or an archive of one."""
    return (folder / "report.json").is_file() and (folder / "maps").is_dir()


def is_in_result(folder: Path) -> bool:
    """Whether a folder is a result of polcap, its maps/ or asset/, or the folder of an export."""
    absolute = Path(os.path.abspath(folder))
    results = [absolute]
    results += [absolute.parent] if absolute.name in ("maps", "asset") else []
    results += [absolute.parents[1]] if absolute.parent.name == "asset" else []
    return any(map(is_result, results))


def without_result(folder: Path) -> str:
    """Message about a path that is named in place of a result and is none: what it is, and the remedy."""
    if not folder.exists():
        return f"{folder}: no such folder; give the result folder of `polcap process`"
    if not folder.is_dir():
        return f"{folder} is a file; give the result folder of `polcap process`"
    absolute = Path(os.path.abspath(folder))
    if wholes := [parent for parent in absolute.parents if is_result(parent)]:
        return f"{folder} is only a part of a result; give the whole, {wholes[0]}"
    if is_one_angle(absolute):
        return f"{folder} holds one angle of a capture; give the folder of all, {absolute.parent}"
    if angle_folder_names(folder) or (folder / "capture.toml").is_file():
        return f"{folder} is a capture without a result; run `polcap process` on it first"
    if found := views(folder):
        joined = "`polcap fuse`, or `polcap material` if it is a flat sample"
        return (
            f"{folder} holds the views {few_names(found)} of one object; join them with {joined}, or give one of them"
        )
    inside = [path for path in children(folder) if path.is_dir()]
    if results := [path.name for path in inside if is_result(path) or is_result(find_result(path))]:
        return f"{folder} holds no result itself; give that of a sub-folder: {few_names(results)}"
    if captures := [path.name for path in inside if angle_folder_names(path)]:
        remedy = "run `polcap process` on one of them, or `polcap batch` on the folder, first"
        return f"{folder} holds captures without results: {few_names(captures)}; {remedy}"
    return f"{folder} holds no result; give the result folder of `polcap process`, or run it first"


def views(folder: Path) -> list[str]:
    """Sub-folders view01, view02, … that hold captures: those that `polcap fuse` joins."""
    named = [path for path in children(folder) if path.is_dir() and _VIEW.fullmatch(path.name)]
    return [path.name for path in named if angle_folder_names(path)]


def view_name(k: int) -> str:
    """Name of the folder of an object's view k = 0, 1, …: view01, view02 and so on."""
    return f"view{k + 1:02d}"


def session_views(folder: Path) -> list[str]:
    """Names of a session's views in their order: view01, view02, or setA/view01, setB/view01, and so on."""
    found = [*folder.glob("view*/"), *folder.glob("set*/view*/")]
    return sorted((path.relative_to(folder).as_posix() for path in found), key=natural)


def set_of_view(name: str) -> str:
    """Name of the set of a view: setA for setA/view01, "" for view01."""
    return name.rpartition("/")[0]


def missing_views(names: Iterable[str]) -> list[str]:
    """Views that the numbers of a session's views skip: of view01, setA/view02, setA/view04 these are setA/view03.

    None where most numbers are missing, as in names by degrees (view000, view030).
    """
    numbers: dict[str, set[int]] = defaultdict(set)
    width: dict[str, int] = {}
    for name in names:
        prefix = name.rstrip("0123456789")
        if digits := name.removeprefix(prefix):
            numbers[prefix].add(int(digits))
            width[prefix] = len(digits)
    return [
        f"{prefix}{number:0{width[prefix]}d}"
        for prefix, used in numbers.items()
        if max(used) <= 2 * len(used)
        for number in range(1, max(used))
        if number not in used
    ]


def is_later_view(folder: Path) -> bool:
    """Whether a capture's folder is a view of a session, but not the first one, which shows the chart."""
    place = Path(os.path.abspath(folder))
    for session in (place.parent.parent, place.parent):
        names = session_views(session)
        if place.relative_to(session).as_posix() in names[1:]:
            return True
    return False


def states_angles(names: Iterable[str]) -> bool:
    """Whether the names of a folder's sub-folders state polarizer angles, so that it is a capture."""
    return bool(_degrees_by_name(names))


def is_one_angle(folder: Path) -> bool:
    """Whether a folder is one of the angle folders of a capture."""
    if not _FOLDER_NUMBER.search(folder.name) or not os.access(folder.parent, os.R_OK):
        return False
    siblings = angle_folders(folder.parent)[0].values()
    return folder in siblings and len(siblings) > 1


def angle_folder_names(folder: Path) -> set[str]:
    """Names of the sub-folders that hold the shots of one angle each: pol000, or 0, 45, 90."""
    return set(_degrees_by_name(path.name for path in children(folder) if path.is_dir())) if folder.is_dir() else set()


def is_angle_folder(name: str) -> bool:
    """Whether a folder of this name inside a capture holds the shots of one angle, or the crossed one."""
    return _FOLDER.fullmatch(name) is not None


def degrees(angle_deg: float) -> str:
    """Text of a polarizer angle 0…360° as used in names of shot folders: 045, 022.5; rounded to a thousandth."""
    whole, _, rest = f"{angle_deg:.3f}".partition(".")
    return f"{int(whole):03d}" + (f".{rest.rstrip('0')}" if rest.strip("0") else "")


def numbered(folder: Path) -> list[str]:
    """Sub-folders with a number in their names that is not read as a polarizer angle."""
    inside = [path.name for path in children(folder) if path.is_dir() and path.name not in OURS]
    angles = _degrees_by_name(inside)
    return [name for name in inside if name not in angles and not is_angle_folder(name) and NUMBER.search(name)]


def _degrees_by_name(names: Iterable[str]) -> dict[str, float]:
    """Angle [degrees] by folder name: of pol000, pol045, …, else of numbers with °, deg or Grad, else of plain numbers.

    Numbers with a unit may follow others: "01 Foto 0°", "02 Foto 45°". Plain numbers are the only difference of
    the names: 0, 45, 90; 角度0, 角度45, 角度90. There must be three different axes or more, below 180°, one of them 0°.
    """
    names = [name for name in names if name not in OURS and not foreign_files.is_ignored_folder(name)]
    found = {name: float(match["pol"]) for name in names if (match := _FOLDER.fullmatch(name)) and match["pol"]}
    if found:
        return found
    if marked := degrees_with_unit(names):
        return marked
    patterns: dict[str, dict[str, float]] = defaultdict(dict)
    for name in names:
        numbers = _FOLDER_NUMBER.findall(name)
        if len(numbers) == 1:
            patterns[unicodedata.normalize("NFC", _FOLDER_NUMBER.sub("#", name))][name] = float(
                numbers[0].replace(",", ".")
            )
    for group in patterns.values():
        angles = sorted(group.values())
        if angles[0] == 0 and angles[-1] < 180 and count_axes(angles) == len(angles) >= 3:
            return group
    return {}


def degrees_with_unit(names: Iterable[str]) -> dict[str, float]:
    """Angle [degrees] by name, of names with one number that °, deg or Grad follows; at least three different axes."""
    found = {name: _DEGREES.findall(unicodedata.normalize("NFC", name)) for name in names}
    angles = {name: float(texts[0].replace(",", ".")) for name, texts in found.items() if len(texts) == 1}
    return angles if count_axes(angles.values()) >= 3 and max(angles.values()) <= 180 else {}


def suggested_names(names: Sequence[str]) -> list[tuple[str, str]]:
    """New names such as pol045 for three or four numbered folders: by a number that can be an angle, else in order."""
    listed = sorted(names, key=natural)
    if not 3 <= len(listed) <= 4 or not all(map(_FOLDER_NUMBER.search, listed)):
        return []
    found = [[float(text.replace(",", ".")) for text in _FOLDER_NUMBER.findall(name)] for name in listed]
    columns = list(zip(*found)) if len({len(one) for one in found}) == 1 else []
    angles = next(
        (one for one in columns if min(one) == 0 and max(one) < 180 and count_axes(one) == len(listed)),
        tuple(45.0 * k for k in range(len(listed))),
    )
    return [(name, f"pol{degrees(angle)}") for name, angle in zip(listed, angles)]


def angle_folders(folder: Path) -> tuple[dict[float, Path], Path | None]:
    """Folders pol000, pol045, … by angle [degrees], and the folder of the cross-polarized shot, if any.

    Raises CaptureError: two folders have one angle, or an angle is beyond 360°.
    """
    inside = [path for path in children(folder) if path.is_dir()]
    crossed = [path for path in inside if (match := _FOLDER.fullmatch(path.name)) and not match["pol"]]
    if len(crossed) > 1:
        raise CaptureError(f"{crossed[1]}: {crossed[0].name} holds a cross-polarized shot too; remove one of the two")
    broken = [path for path in children(folder) if path.is_symlink() and not path.exists()]
    stated = _degrees_by_name(path.name for path in [*inside, *broken])
    for path in broken:
        if path.name in stated:
            raise CaptureError(f"{path}: is a link to a missing folder; restore the folder, or remove the link")
    found: dict[float, Path] = {}
    for path in inside:
        angle = stated.get(path.name, degrees_of_cross(path) if path in crossed else None)
        if angle is not None and angle > 360:
            raise CaptureError(
                f"{path}: {angle:g}° is not an angle of a polarizer; rename the folder to 0 to 360 degrees"
            )
        if angle is None or path in crossed:
            continue
        if angle in found:
            raise CaptureError(f"{path}: {angle:g}° is also in {found[angle].name}; remove one of the two folders")
        found[angle] = path
    return dict(sorted(found.items())), next(iter(crossed), None)


def degrees_of_cross(path: Path) -> float | None:
    """Angle [degrees] of the lens's polarizer in a folder name such as cross045; None for cross."""
    match = _FOLDER.fullmatch(path.name)
    return float(match["cross"]) if match and match["cross"] else None


def count_axes(angles_deg: Iterable[float]) -> int:
    """Number of different polarizer axes among the angles; angles that differ by 180° are the same axis."""
    axes = sorted(angle % 180 for angle in angles_deg)
    gaps = [b - a for a, b in pairwise([*axes, axes[0] + 180])] if axes else []
    return max(sum(gap >= SEPARATION_DEG for gap in gaps), 1 if axes else 0)
