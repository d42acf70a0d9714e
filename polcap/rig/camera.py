"""What every camera of the rig does, and the exposures it is asked for."""

import re
from dataclasses import dataclass
from math import log2
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

from polcap.errors import SettingError
from polcap.images import Role

Positive = Annotated[float, Meta(gt=0)]
_WORD = re.compile(
    r"(?P<kind>f/|iso|flash)?(?P<over>\d+(?:\.\d+)?/)?(?P<value>\d+(?:\.\d+)?)s?", re.IGNORECASE
)  # f/11, iso100, flash1/16, 1/200, 0.5s
_BASE_ISO = 100.0  # below, many bodies reach an ISO by arithmetic alone, and clip earlier
_SNAP_STOPS = 0.5  # a camera's nearest setting may lie this far from the one asked for


class Exposure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one frame is taken with; None leaves the camera as it stands."""

    time_s: Positive | None = None
    f_number: Positive | None = None
    iso: Positive | None = None
    flash: Positive | None = None  # power, full = 1

    def __str__(self) -> str:
        """As `--bracket` takes it."""
        words = []
        if self.time_s:
            words.append(f"1/{1 / self.time_s:.4g}s" if self.time_s < 0.3 else f"{self.time_s:.3g}s")
        words += [f"f/{self.f_number:g}"] if self.f_number else []
        words += [f"iso{self.iso:g}"] if self.iso else []
        words += [f"flash1/{1 / self.flash:.4g}"] if self.flash else []
        return " ".join(words) or "as set on the camera"


@dataclass(frozen=True)
class Shot:
    """One photograph as the camera made it."""

    data: bytes
    name: str  # the camera's own
    exposure: Exposure  # what was really set


class Camera(Protocol):
    """What takes the photographs."""

    model: str
    frame_bytes: int  # about, for the disk
    switches_flash: bool  # can take a frame without flash by itself
    polarizes_flash: bool  # puts the flash's filter on by itself

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """The exposures of a bracket where the user gave none; under a flash the shutter changes none."""
        ...

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Told before every frame: the angle asked for, and which exposure of the bracket comes."""
        ...

    def shoot(self, exposure: Exposure, flash: bool) -> Shot:
        """Take one photograph, with the light or without it. HardwareError; never hangs past its timeout."""
        ...

    def close(self) -> None:
        """Give the camera back; never raises."""
        ...


def parse_bracket(text: str) -> tuple[Exposure, ...]:
    """`1/200,1/50,1/13`, or with all words `1/160 f/11 iso100 flash1/64, flash1/16, flash1/4`.

    A frame keeps what it does not state of the frame before. Raises SettingError.
    """
    found: list[Exposure] = []
    for part in text.split(","):
        stated: dict[str, float] = {} if not found else msgspec.structs.asdict(found[-1])
        for word in part.split() or [part]:
            match = _WORD.fullmatch(word)
            value = float(match["value"]) if match else 0.0
            if match is None or not value:
                raise SettingError(f"--bracket: {word!r} is no exposure; write 1/200, f/11, iso100 or flash1/16")
            if match["over"]:
                value = float(match["over"][:-1]) / value
            names = {"f/": "f_number", "iso": "iso", "flash": "flash"}
            stated[names.get((match["kind"] or "").lower(), "time_s")] = value
        found.append(Exposure(**stated))
    if len(set(found)) < len(found):
        raise SettingError(f"--bracket {text}: two frames are exposed alike; give each frame its own exposure")
    return tuple(found)


def light(exposure: Exposure) -> float:
    """Relative exposure: time × ISO × flash power / f-number²."""
    values = exposure.time_s or 1.0, exposure.iso or 100.0, exposure.flash or 1.0
    return values[0] * values[1] * values[2] / (exposure.f_number or 1.0) ** 2


def by_shutter(middle_s: float | None) -> tuple[Exposure, ...]:
    """Three frames two stops apart by time, around the camera's own setting."""
    if not middle_s:
        raise SettingError("the camera states no shutter speed; give the exposures with --bracket")
    return tuple(Exposure(time_s=middle_s * stops) for stops in (0.25, 1.0, 4.0))


def by_iso(offered: list[float]) -> tuple[Exposure, ...]:
    """Three frames two stops apart by ISO, from the least of 100 or more that the camera offers: for a flash."""
    least = min((iso for iso in offered if iso >= _BASE_ISO), default=None)
    if least is None:
        raise SettingError("the camera's ISO cannot be set; give the exposures with --bracket: flash power or aperture")
    return tuple(Exposure(iso=nearest("iso", least * stops, offered)) for stops in (1.0, 4.0, 16.0))


def nearest(what: str, asked: float, offered: list[float], power: float = 1.0) -> float:
    """The offered value nearest in stops; `power` is 2 for f-numbers. SettingError beyond half a stop."""
    best = min(offered, key=lambda value: abs(log2(value / asked)))
    if power * abs(log2(best / asked)) > _SNAP_STOPS:
        listed = ", ".join(f"{value:g}" for value in sorted(offered))
        raise SettingError(f"--bracket: {what} {asked:g} is not among the camera's ({listed}); give one of them")
    return best
