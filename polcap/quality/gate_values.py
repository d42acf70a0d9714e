"""Defines a quality gate, and the evidence (results and measurements) that gates judge."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Literal, TypeGuard, TypeVar

import msgspec
import numpy as np

from polcap.errors import InputError
from polcap.image_values import Bools, Floats, Quality
from polcap.optics import frames
from polcap.quality import rerendering
from polcap.results import FirstResults, ResultsUntilHdr, ResultsUntilInfer
from polcap.stage_values import AngleStack, StokesImage
from polcap.stages.align import AlignSettings

State = Literal["pass", "warn", "fail", "not measured", "not judged"]  # not judged: another gate is the cause
Unit = Literal["1", "px", "°", "×", "ΔE2000", ""]

MOST_DEG = 90.0  # of an error: normals face the camera
R = TypeVar("R", bound=FirstResults, covariant=True)
H = TypeVar("H", bound=ResultsUntilHdr)
_ALIGN = AlignSettings()
_LIT = 0.02  # of the object's median light
_ERROR_COST_DEG = 45.0  # of a stage that gives up: nothing is known of the normals
DEGREES_PER_GAIN = 600.0  # 1 % of a shot's light costs about 6° on average; `gain_cost` computes it for an object


class Gate(msgspec.Struct, frozen=True):
    """A quality gate: a measured value against its limit, with finding, cost and remedy."""

    name: str
    state: State
    value: float | str | None  # a share, not per cent
    limit: float | str | None
    message: str = msgspec.field(name="says")  # the finding, in one sentence; "says" in report.json
    remedy: str = ""  # advice to the user, unless it passed
    cost_deg: float = 0.0  # added to the expected error of the normals, squared
    shots: tuple[str, ...] = ()  # names of the shots to take again; empty: no single shot is the cause
    unit: Unit = "1"  # a share or a number, as in report.json's units

    def __post_init__(self) -> None:
        """Replace NumPy scalars by Python numbers, and a value that is not finite by None, for JSON."""
        for name in ("value", "limit", "cost_deg"):
            if isinstance(number := getattr(self, name), np.generic):
                msgspec.structs.force_setattr(self, name, number.item())
        if isinstance(self.value, float) and not np.isfinite(self.value):
            msgspec.structs.force_setattr(self, "value", None)


@dataclass(frozen=True)
class Evidence(Generic[R]):
    """Everything that the gates judge: the stages' results, and measurements made before `check` reduces the pictures.

    A gate states in its type which results it needs. It does not run if the path ended before these.
    """

    results: R
    names: list[str]  # (K,) of the shots
    focal_doubt: tuple[float, float]  # ln of the least and of the greatest possible focal length over the assumed one
    clipped: Floats | Bools  # (K, E, H, W) share of each pixel that is clipped
    blur_px: Floats  # (K, E) beyond the sharpest frame of the same exposure, 1σ [visible RAW px]
    align: AlignSettings = _ALIGN  # the gate of the alignment has the limits of the stage
    files: tuple[tuple[str, ...], ...] = ()  # (K, E) photographs, as the user finds them in the capture's folder
    grid_px: float = 1.0  # px of the picture that `process` works on per px of these
    chart_missing: str = ""  # the reason, where a chart was expected and none was found
    later_view: bool = False  # of a session whose first view shows the chart

    @cached_property
    def rerendered(self: "Evidence[ResultsUntilInfer]") -> rerendering.Rerendering:
        """The maps, rendered again on few pixels; several gates compare it with the photographs."""
        return rerendering.measure(self.results)

    @property
    def explained(self: "Evidence[ResultsUntilInfer]") -> float:
        """Part of the polarization that the maps explain by a shape that explains the shading too, at most 1.

        0 for the inversion: it makes a shape of any polarization.
        """
        return 0.0 if self.results.maps.estimator == "analytic" else self.rerendered.agreement


def reaches(found: Evidence[Any], results: type[R]) -> TypeGuard[Evidence[R]]:
    """Whether the path has reached these results."""
    return isinstance(found.results, results)


def full_size(
    results: H, focal_doubt: tuple[float, float], align: AlignSettings = _ALIGN, files: tuple[tuple[str, ...], ...] = ()
) -> Evidence[H]:
    """Evidence of a run of `process`; clipping is that of the merged picture of each shot, not of every exposure."""
    radiance = results.radiance
    return Evidence(
        results,
        names=shot_names(radiance),
        focal_doubt=focal_doubt,
        clipped=((radiance.quality & int(Quality.CLIPPED)) > 0)[:, None],
        blur_px=radiance.bracket.blur_px,
        align=align,
        files=files,
    )


def of_error(error: InputError) -> Gate:
    """Gate of an error that ended the path, named for the class of the error."""
    reason, _, remedy = str(error).partition("; ")
    name = type(error).__name__.removesuffix("Error").lower()
    return Gate(name, "fail", None, None, reason, remedy, _ERROR_COST_DEG)


def lit(image: StokesImage) -> Bools:
    """Pixels (H, W) of the object that are neither clipped nor so dark that the shots show only noise."""
    inside = image.mask & (image.quality & int(Quality.CLIPPED) == 0)
    s0, s1, s2 = frames.total(image.stokes)
    least = _LIT * float(np.median(s0[inside])) if inside.any() else 0.0
    return np.asarray(inside & (np.maximum(s0, np.hypot(s1, s2)) > least))  # S0 is small where shots contradict


def shot_names(radiance: AngleStack) -> list[str]:
    """Names of the shots by their angles, such as 45°."""
    return [f"{degrees:g}°" for degrees in np.round(np.degrees(radiance.angle), 6)]


def at_most(
    name: str,
    value: float | None,
    limit: float,
    message: str,
    remedy: str,
    shots: tuple[str, ...] = (),
    cost_deg: float = 0.0,
    unit: Unit = "1",
    beyond: State = "fail",
) -> Gate:
    """Make a gate on a value that must not exceed its limit; a value that is None or not finite is not measured.

    `beyond` is the gate's state if the value exceeds the limit. All other arguments are fields of `Gate`.
    """
    if value is None or not np.isfinite(value):
        return Gate(name, "not measured", None, limit, message, unit=unit)
    if value <= limit:
        return Gate(name, "pass", round(float(value), 5), limit, message, unit=unit)
    return Gate(
        name, beyond, round(float(value), 5), limit, message, remedy, round(min(cost_deg, MOST_DEG), 1), shots, unit
    )


def compared(change: float, other: str) -> str:
    """Relative change of light in words, such as 3.0 % brighter than the others."""
    text, relation = f"{100 * abs(change):.1f}", "darker" if change < 0 else "brighter"
    return f"as bright as {other}" if text == "0.0" else f"{text} % {relation} than {other}"


def worded(figure: float, text: str, zero: str) -> str:
    """`text` with the figure in its place {:.1f}, or `zero` where it rounds to zero."""
    if not np.isfinite(figure):
        return "There is too little to measure"
    return zero if text.format(figure) == text.format(0.0) else text.format(figure)


def sentence(text: str) -> str:
    """A text with a capital letter at the beginning."""
    return text[:1].upper() + text[1:]


def bad_shots(names: list[str], bad: Bools) -> tuple[str, ...]:
    """Names of the shots to take again, those where `bad` (K,) is true."""
    return tuple(name for name, one in zip(names, bad) if one)


def grade(cost_deg: float) -> State:
    """State of a gate beyond its limit: it fails if it costs more than 15° of the normals."""
    return "fail" if cost_deg > 15 else "warn"
