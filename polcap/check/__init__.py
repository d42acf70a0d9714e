"""In: a capture, seconds after its last frame. Out: keep or reshoot, and why.

The path's own stages judge, on pictures averaged down to at most 0.6 MP; what that would hide is taken from
the full pictures as they are read. Nothing is written.
"""

from time import perf_counter

import msgspec

from polcap.check import judge, reduced
from polcap.check.judge import UNITS, Line
from polcap.config import Config
from polcap.images import Capture, Network


class Verdict(msgspec.Struct, frozen=True):
    """What to do with the capture."""

    keep: bool
    shots: tuple[str, ...]  # to be taken again, as far as single ones are to blame
    lines: tuple[Line, ...]
    capture: str
    seconds: float


def inspect(capture: Capture, network: Network | None, config: Config, mask_network: Network | None = None) -> Verdict:
    """Judge a capture; network None expects the errors of the analytic estimator, mask_network None takes for the
    object what stands out from the backdrop.

    Raises
    ------
    InputError
        A frame cannot be decoded.
    """
    start = perf_counter()
    lines = tuple(judge.lines(reduced.take(capture, config.hdr.clip), network, mask_network, config))
    bad = [line for line in lines if line.state == "reshoot"]
    named = {name for line in bad for name in line.shots}
    shots = tuple(shot.name for shot in capture.shots if shot.name in named)
    return Verdict(not bad, shots, lines, capture.name, round(perf_counter() - start, 2))


def table(verdict: Verdict) -> str:
    """The verdict for a person, in one screen."""
    head = "keep" if verdict.keep else f"reshoot {', '.join(verdict.shots)}".rstrip()
    rows = [f"{head}   ({verdict.capture}, {verdict.seconds:.1f} s)"]
    for line in verdict.lines:
        limit = "" if line.limit is None else f" (limit {_with_unit(line)})"
        rows.append(f"{line.state:13}{line.name:12}{line.says}{limit}")
        if line.remedy:
            rows.append(f"{'':25}→ {line.remedy}")
    return "\n".join(rows)


def _with_unit(line: Line) -> str:
    limit = line.limit or 0.0
    return f"{limit:g}{UNITS[line.name]}" if line.name in UNITS else f"{100 * limit:g} %"


def shown(verdict: Verdict) -> dict[str, object]:
    """The verdict for a program."""
    return {"verdict": "keep" if verdict.keep else "reshoot", **msgspec.to_builtins(verdict)}
