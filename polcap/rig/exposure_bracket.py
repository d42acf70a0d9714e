"""Exposures of a bracket: parses `--bracket`, makes default brackets, chooses the camera's nearest values."""

import re
from math import log2
from typing import Annotated

import msgspec
from msgspec import Meta

from polcap.errors import SettingError

Positive = Annotated[float, Meta(gt=0)]
_NUMBER = r"\d+(?:\.\d+)?"
_WORD = re.compile(rf"(f/|iso|flash)?(?:({_NUMBER})/)?({_NUMBER})s?")  # f/11, iso100, flash1/16, 1/200, 0.5s
_FIELDS = {None: "time_s", "f/": "f_number", "iso": "iso", "flash": "flash"}
_BASE_ISO = 100.0  # below, many cameras only scale the counts, and clip earlier
_NEAREST_STOPS = 0.5  # greatest distance of the camera's nearest setting from the requested one


class Exposure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Camera settings of one frame; None leaves the camera's setting as it is."""

    time_s: Positive | None = None
    f_number: Positive | None = None
    iso: Positive | None = None
    flash: Positive | None = None  # power, full = 1

    def __str__(self) -> str:
        """The exposure as text in the form of `--bracket`."""
        words = [f"1/{1 / self.time_s:.4g}s" if self.time_s < 0.3 else f"{self.time_s:.3g}s"] if self.time_s else []
        words += [f"f/{self.f_number:g}"] if self.f_number else []
        words += [f"iso{self.iso:g}"] if self.iso else []
        words += [f"flash1/{1 / self.flash:.4g}"] if self.flash else []
        return " ".join(words) or "as set on the camera"


def parse_bracket(text: str) -> tuple[Exposure, ...]:
    """Parse exposures `1/200,1/50,1/13`, or in full `1/160 f/11 iso100 flash1/64, flash1/16, flash1/4`.

    A value that a frame does not state is that of the previous frame. Raises SettingError.
    """
    exposures: list[Exposure] = []
    for part in text.split(","):
        values: dict[str, float] = msgspec.structs.asdict(exposures[-1]) if exposures else {}
        for word in part.split() or [part]:
            match = _WORD.fullmatch(word.lower())
            if match is None or not float(match[3]):
                raise SettingError(f"--bracket: {word!r} is no exposure; write 1/200, f/11, iso100 or flash1/16")
            values[_FIELDS[match[1]]] = float(match[2]) / float(match[3]) if match[2] else float(match[3])
        exposures.append(Exposure(**values))
    if len(set(exposures)) < len(exposures):
        raise SettingError(f"--bracket {text}: two frames have the same exposure; change one of them")
    return tuple(exposures)


def relative_exposure(exposure: Exposure) -> float:
    """Relative exposure: time × ISO × flash power / f-number²; None counts as ISO 100, otherwise as 1."""
    light = (exposure.time_s or 1.0) * (exposure.flash or 1.0) / (exposure.f_number or 1.0) ** 2
    return light * (exposure.iso or 100.0)


def bracket_by_shutter(middle_s: float | None) -> tuple[Exposure, ...]:
    """Default bracket without flash: three frames in steps of two stops of time around the camera's time `middle_s`.

    Raises SettingError if the camera states no time.
    """
    if not middle_s:
        raise SettingError("the camera states no shutter speed; give the exposures with --bracket")
    return tuple(Exposure(time_s=middle_s * factor) for factor in (0.25, 1.0, 4.0))


def bracket_by_iso(offered: list[float]) -> tuple[Exposure, ...]:
    """Default bracket under a flash: three frames in steps of two stops of ISO, from the lowest of at least 100."""
    lowest = min((iso for iso in offered if iso >= _BASE_ISO), default=None)
    if lowest is None:
        raise SettingError("the camera's ISO cannot be set; give the exposures with --bracket: flash power or aperture")
    return tuple(Exposure(iso=nearest("iso", lowest * factor, offered)) for factor in (1.0, 4.0, 16.0))


def nearest(name: str, wanted: float, offered: list[float], power: float = 1.0) -> float:
    """The value among those `offered` by the camera that is nearest to `wanted`, in stops.

    `power` is the power with which the value enters the exposure: 2 for f-numbers, else 1. Raises SettingError if the
    nearest value is more than half a stop away; `name` is for the message.
    """
    best = min(offered, key=lambda value: abs(log2(value / wanted)))
    if power * abs(log2(best / wanted)) > _NEAREST_STOPS:
        listed = ", ".join(f"{value:g}" for value in sorted(offered))
        raise SettingError(f"--bracket: the camera has no {name} {wanted:g}; give one of {listed}")
    return best
