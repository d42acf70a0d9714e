"""Finds the photograph that is missing in a bracket, or one too many, by the exposures; advises what to do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

EQUAL_STOPS = 0.15  # EXIF rounds exposure times to a sixth of a stop at most


@dataclass(frozen=True)
class ExposedFile:
    """A photograph's file, as a message names it, and its exposure."""

    name: str
    exposure: float | None  # relative
    text: str  # of the exposure, such as 1/50 s


_Bracket = Sequence[ExposedFile]


def same_exposure(value: float | None, reference: float | None) -> bool:
    """Whether two relative exposures (time, aperture and ISO) are the same within the rounding of cameras."""
    if not value or not reference:
        return value == reference
    return max(value / reference, reference / value) < 2**EQUAL_STOPS


def advise_sequence(files: _Bracket, angles_deg: Sequence[float]) -> str:
    """Advice for photographs in the order in which they were taken, which do not make a bracket for each angle.

    Empty where the exposures do not show the reason.
    """
    count, shots = len(files), len(angles_deg)
    if all(one.exposure and not same_exposure(one.exposure, two.exposure) for one, two in combinations(files, 2)):
        return (
            "all exposures differ: they are one bracket at one angle, or the camera changed the exposure with the "
            "angle; take the same exposures at every angle"
        )
    for size in range(2, count // 3 + 1):
        if count % size == 0 and count // size != shots and _repeats(files, size):
            return f"they are {count // size} brackets of {size}: state {count // size} angles with --angles"
    size = (count - 1) // shots  # without one photograph
    surplus = [at for at in range(count) if _repeats([*files[:at], *files[at + 1 :]], size)]
    if (count - 1) % shots == 0 and surplus:
        names = " or ".join(files[at].name for at in surplus)
        return f"{names} is one too many, by its exposure ({files[surplus[0]].text}): move it out of the folder"
    size = (count + 1) // shots  # with one more
    filled = {at: [*files[:at], None, *files[at:]] for at in range(count + 1)}
    gaps = [at for at, one in filled.items() if _repeats(one, size)]
    if (count + 1) % shots == 0 and gaps:
        at = max(gaps, key=lambda at: _rises(filled[at], size))  # most brackets begin with the darkest frame
        others = [one for one in filled[at][at % size :: size] if one is not None]
        return f"the frame of {others[0].text} at {angles_deg[at // size]:g}° is missing: {_take_or_leave_out(others)}"
    return ""


def advise_shots(shots: Mapping[str, _Bracket]) -> str:
    """Advice for the brackets of the shots, by their names, of which one has a photograph too many or too few.

    Empty where the exposures do not show the reason.
    """
    counts = [len(bracket) for bracket in shots.values()]
    usual = max(set(counts), key=counts.count)
    complete = next(bracket for bracket in shots.values() if len(bracket) == usual)
    if not _varied(complete):
        return ""
    for name, bracket in shots.items():
        missing, surplus = _without(complete, bracket), _without(bracket, complete)
        if len(bracket) == usual + 1 and len(surplus) == 1:
            return f"{surplus[0].name} is one too many, by its exposure ({surplus[0].text}): move it out of the folder"
        if len(bracket) == usual - 1 and len(missing) == 1:
            all_files = [one for other in shots.values() for one in other]
            others = [one for one in all_files if same_exposure(one.exposure, missing[0].exposure)]
            return f"the frame of {missing[0].text} at {name} is missing: {_take_or_leave_out(others)}"
    return ""


def _take_or_leave_out(others: _Bracket) -> str:
    """Advice for a missing photograph; `others` are the photographs of the same exposure in the other shots."""
    names = ", ".join(one.name for one in others)
    return f"take it again, or move {names}, the same exposure of every other shot, out of the folder"


def _repeats(files: Sequence[ExposedFile | None], size: int) -> bool:
    """Whether brackets of `size` photographs repeat the same exposures, which differ; None fits anywhere."""
    if size < 2:
        return False
    columns = [[one for one in files[at::size] if one is not None] for at in range(size)]
    equal = all(same_exposure(one.exposure, column[0].exposure) for column in columns for one in column)
    return equal and _varied([column[0] for column in columns if column])


def _rises(files: Sequence[ExposedFile | None], size: int) -> bool:
    """Whether each of the brackets goes from the darkest photograph to the brightest, or the other way."""
    steps = {
        (a.exposure or 0) < (b.exposure or 0)
        for k, (a, b) in enumerate(pairwise(files))
        if a is not None and b is not None and k % size < size - 1
    }
    return len(steps) == 1


def _varied(bracket: _Bracket) -> bool:
    """Whether all exposures are stated, and some of them differ."""
    return all(one.exposure for one in bracket) and any(
        not same_exposure(a.exposure, b.exposure) for a, b in pairwise(bracket)
    )


def _without(bracket: _Bracket, other: _Bracket) -> list[ExposedFile]:
    """Photographs of a bracket that have no partner of the same exposure in the other one."""
    unmatched, without_partner = list(other), []
    for file in bracket:
        partner = next((candidate for candidate in unmatched if same_exposure(file.exposure, candidate.exposure)), None)
        if partner is None:
            without_partner.append(file)
        else:
            unmatched.remove(partner)
    return without_partner
