"""One judgement, and what judgements look at."""

from collections.abc import Callable
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from polcap.images import (
    Alignment,
    AngleStack,
    ColorCalibration,
    Floats,
    Gains,
    Mesh,
    ObjectMask,
    StokesImage,
    SurfaceMaps,
)

State = Literal["pass", "warn", "fail", "not measured"]
Unit = Literal["%", "px", "°", "×", "ΔE2000", ""]

MOST_DEG = 90.0  # of an error: normals face the camera
DEGREES_PER_GAIN = 600.0  # 1 % of a shot's light tilts facing pixels by about 6° (error budget)


class Gate(msgspec.Struct, frozen=True):
    """One figure against its limit, and what it means."""

    name: str
    state: State
    value: float | str | None  # shares as such, not in percent
    limit: float | str | None
    says: str  # what was found
    remedy: str = ""  # what to do, where it did not pass
    cost_deg: float = 0.0  # what it adds to the expected error of the normals
    shots: tuple[str, ...] = ()  # to be taken again, where single ones are to blame
    unit: Unit = "%"

    def __post_init__(self) -> None:
        """Turn NumPy scalars, with which the gates compute, into Python numbers: JSON knows no others."""
        for name in ("value", "limit", "cost_deg"):
            if isinstance(number := getattr(self, name), np.generic):
                msgspec.structs.force_setattr(self, name, number.item())


class Found(Protocol):
    """What the stages made of a capture, at full size or reduced; each is computed when asked for.

    Pixels are looked at in a `figure` alone: where one is remembered, they are not even read.
    """

    def figure(self, name: str, measure: "Callable[[Found, Any], Any]", setting: Any = None) -> Any:
        """What `measure` gives of the pixels with a setting, or gave when it was made of the same; plain JSON data."""

    @property
    def names(self) -> list[str]: ...  # (K,) of the shots
    @property
    def focal_doubt(self) -> tuple[float, float]: ...  # ln of least and most that it may be, over it; 0, 0: known
    @property
    def grid_px(self) -> float: ...  # px of the picture that is processed per px of these
    @property
    def chart_missing(self) -> str: ...  # why no chart was found though one was looked for; "" else
    @property
    def clipped(self) -> Floats: ...  # (K,) share of the object that is clipped in every frame
    @property
    def radiance(self) -> AngleStack: ...
    @property
    def color(self) -> ColorCalibration: ...
    @property
    def alignment(self) -> Alignment: ...
    @property
    def object_(self) -> ObjectMask: ...
    @property
    def gains(self) -> Gains: ...
    @property
    def stokes(self) -> StokesImage: ...
    @property
    def maps(self) -> SurfaceMaps: ...
    @property
    def mesh(self) -> Mesh | None: ...  # None where none is made


def at_most(
    name: str,
    value: float | None,
    limit: float,
    says: str,
    remedy: str,
    shots: tuple[str, ...] = (),
    cost_deg: float = 0.0,
    unit: Unit = "%",
    beyond: State = "fail",
) -> Gate:
    """A figure that must not exceed its limit.

    Parameters
    ----------
    name
        Of the gate, as the report lists it.
    value
        In `unit`s, a share where that is %; None or not finite: it was not measured.
    limit
        The greatest that passes.
    says
        What was found, in one clause.
    remedy
        What to do where it is exceeded.
    shots
        Those to blame.
    cost_deg
        What an excess costs the normals, degrees.
    unit
        Of value and limit.
    beyond
        State of a value over the limit.
    """
    if value is None or not np.isfinite(value):
        return Gate(name, "not measured", None, limit, says, unit=unit)
    if value <= limit:
        return Gate(name, "pass", round(float(value), 5), limit, says, unit=unit)
    return Gate(
        name, beyond, round(float(value), 5), limit, says, remedy, round(min(cost_deg, MOST_DEG), 1), shots, unit
    )


def blamed(names: list[str], bad: NDArray[np.bool_]) -> tuple[str, ...]:
    """The names where `bad` (K,) is true."""
    return tuple(name for name, one in zip(names, bad) if one)
