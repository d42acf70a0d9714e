"""Chooses the remedies that a user gets: at most two, the right one first."""

from collections.abc import Sequence

import msgspec

from polcap.quality.gate_values import Gate

_MOST = 2
_NOTABLE_DEG = 1.0  # error of the normals: warnings that cost less come last


def advise(judged: Sequence[Gate]) -> list[Gate]:
    """The judged gates, in the same order; only those of the chosen remedies keep their remedy."""
    chosen = advice(judged)
    return [gate if gate in chosen else msgspec.structs.replace(gate, remedy="") for gate in judged]


def advice(judged: Sequence[Gate]) -> list[Gate]:
    """The gates of the remedies to follow first, at most two.

    They are failed gates; if no failed gate has a remedy, they are warnings. `judged` has causes before consequences.
    """
    failed = [gate for gate in judged if gate.state == "fail" and gate.remedy]
    warned = sorted((gate for gate in judged if gate.state == "warn"), key=lambda gate: gate.cost_deg < _NOTABLE_DEG)
    first = {gate.remedy: gate for gate in reversed(failed or warned) if gate.remedy}  # of each remedy, the first gate
    return list(reversed(first.values()))[:_MOST]
