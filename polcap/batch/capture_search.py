"""Finds the captures below a folder: those that `polcap process` takes."""

from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from polcap.errors import CaptureError
from polcap.formats import own_folders
from polcap.formats.capture import capture_toml, folder_names, photograph_files

_LEAST = 3  # photographs of a capture


class Rank(IntEnum):
    """Content of a folder that may be a capture: a higher rank is the original of a lower one."""

    UNREADABLE = 0
    PICTURES = 1
    RAW = 2  # or the angles are stated


class Candidate(NamedTuple):
    """A folder that may be a capture, its number of photographs, and the reason why it is none."""

    folder: Path
    rank: Rank = Rank.RAW
    photographs: int = _LEAST
    reason: str = ""


def search(folder: Path, linked: bool = False) -> list[Candidate]:
    """Captures in and below a folder, and folders that cannot be listed.

    Results, fused objects and folders of other programs are left out. Below a folder that is a link, nothing is
    searched.
    """
    if folder_names.is_result(folder) or _is_fused(folder):
        return []  # maps are no photographs, and the views of a fused object are processed
    try:
        listed = folder_names.children(folder)
    except CaptureError as error:
        return [Candidate(folder, Rank.UNREADABLE, 0, str(error))]
    inside = [path for path in listed if path.is_dir() and path.name not in own_folders.OURS]
    stated = any(path.name == capture_toml.NAME for path in listed)
    if stated or folder_names.states_angles(path.name for path in inside):
        return [Candidate(folder)]
    below = [] if linked else [candidate for path in inside for candidate in search(path, path.is_symlink())]
    kinds = [photograph_files.kind(path) for path in listed if not path.is_dir()]
    here = Candidate(folder, Rank.RAW if "raw" in kinds else Rank.PICTURES, kinds.count("raw") or kinds.count("photo"))
    return _chosen(here, below, any(map(_is_fused, inside)))


def _chosen(here: Candidate, below: list[Candidate], fused: bool) -> list[Candidate]:
    """The candidates to keep of a folder and of those below it.

    Photographs above captures document a session. Pictures below a capture are developed from it, and a few
    photographs there are rejected ones.
    """
    if here.photographs >= _LEAST and all(found.rank <= here.rank for found in below):
        equals = [found for found in below if found.rank == here.rank and found.photographs >= _LEAST]
        return [here, *equals]
    alone = not fused and not any(found.photographs for found in below)
    return [here, *below] if here.photographs and alone else below


def _is_fused(folder: Path) -> bool:
    """Whether a folder holds the joined result of its views."""
    return any(folder_names.is_result(folder / name) for name in (own_folders.FUSED, own_folders.MATERIAL))
