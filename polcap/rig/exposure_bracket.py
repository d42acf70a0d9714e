"""Exposures of a bracket: as the photographer writes them, by default, and nearest to the camera's dials."""

import re
from math import log2
from typing import Annotated

import msgspec
from msgspec import Meta

from polcap.errors import SettingError

Positive = Annotated[float, Meta(gt=0)]
_WORD = re.compile(
    r"(?P<kind>f/|iso|flash)?(?P<over>\d+(?:\.\d+)?/)?(?P<value>\d+(?:\.\d+)?)s?", re.IGNORECASE
)  # f/11, iso100, flash1/16, 1/200, 0.5s
_BASE_ISO = 100.0  # below, many cameras only scale the counts, and clip earlier
_NEAREST_STOPS = 0.5  # greatest distance of the camera's nearest setting from the requested one


class Exposure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Camera settings of one frame; None leaves the camera's setting as it is."""

    time_s: Positive | None = None
    f_number: Positive | None = None
    iso: Positive | None = None
    flash: Positive | None = None  # power, full = 1

    def __str__(self) -> str:
        """As in `--bracket`."""
        words = []
        if self.time_s:
            words.append(f"1/{1 / self.time_s:.4g}s" if self.time_s < 0.3 else f"{self.time_s:.3g}s")
        words += [f"f/{self.f_number:g}"] if self.f_number else []
        words += [f"iso{self.iso:g}"] if self.iso else []
        words += [f"flash1/{1 / self.flash:.4g}"] if self.flash else []
        return " ".join(words) or "as set on the camera"


def parse_bracket(text: str) -> tuple[Exposure, ...]:
    """Exposures of `1/200,1/50,1/13`, or with all words `1/160 f/11 iso100 flash1/64, flash1/16, flash1/4`.

    Values that a frame does not name are those of the frame before. Raises SettingError.
    """
    exposures: list[Exposure] = []
    for part in text.split(","):
        values: dict[str, float] = msgspec.structs.asdict(exposures[-1]) if exposures else {}
        for word in part.split() or [part]:
            match = _WORD.fullmatch(word)
            value = float(match["value"]) if match else 0.0
            if match is None or not value:
                raise SettingError(f"--bracket: {word!r} is no exposure; write 1/200, f/11, iso100 or flash1/16")
            if match["over"]:
                value = float(match["over"][:-1]) / value
            names = {"f/": "f_number", "iso": "iso", "flash": "flash"}
            values[names.get((match["kind"] or "").lower(), "time_s")] = value
        exposures.append(Exposure(**values))
    if len(set(exposures)) < len(exposures):
        raise SettingError(f"--bracket {text}: two frames have the same exposure; change one of them")
    return tuple(exposures)


def relative_exposure(exposure: Exposure) -> float:
    """Time × ISO × flash power / f-number²."""
    values = exposure.time_s or 1.0, exposure.iso or 100.0, exposure.flash or 1.0
    return values[0] * values[1] * values[2] / (exposure.f_number or 1.0) ** 2


def bracket_by_shutter(middle_s: float | None) -> tuple[Exposure, ...]:
    """Three frames in steps of two stops of time, around the camera's own setting."""
    if not middle_s:
        raise SettingError("the camera states no shutter speed; give the exposures with --bracket")
    return tuple(Exposure(time_s=middle_s * factor) for factor in (0.25, 1.0, 4.0))


def bracket_by_iso(offered: list[float]) -> tuple[Exposure, ...]:
    """Three frames in steps of two stops of ISO, from the camera's lowest of at least 100: for a flash."""
    lowest = min((iso for iso in offered if iso >= _BASE_ISO), default=None)
    if lowest is None:
        raise SettingError("the camera's ISO cannot be set; give the exposures with --bracket: flash power or aperture")
    return tuple(Exposure(iso=nearest("iso", lowest * factor, offered)) for factor in (1.0, 4.0, 16.0))


def nearest(name: str, wanted: float, offered: list[float], power: float = 1.0) -> float:
    """The offered value nearest in stops; `power` is 2 for f-numbers. SettingError beyond half a stop."""
    best = min(offered, key=lambda value: abs(log2(value / wanted)))
    if power * abs(log2(best / wanted)) > _NEAREST_STOPS:
        listed = ", ".join(f"{value:g}" for value in sorted(offered))
        raise SettingError(f"--bracket: the camera has no {name} {wanted:g}; give one of {listed}")
    return best
