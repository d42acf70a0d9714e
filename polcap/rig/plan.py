"""In: what to shoot. Out: the frames one by one, the order that turns the motor least, and the time it will take."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from polcap.errors import SettingError
from polcap.formats.capture import layouts
from polcap.images import Role
from polcap.rig.camera import Exposure, by_iso, by_shutter

PAPER_S = 60.0  # Deschaintre et al. 2021: a capture "takes about a minute"
FINISH_S = 1.0  # the last frame's check, and the preview
SPEED_DEG_S = {"elliptec": 430.0, "grbl": 60.0, "line": 60.0, "manual": 9.0, "simulated": 360.0}  # nominal
_DIAL = [100.0, 400.0, 1600.0]  # ISOs that any camera has
SETTLE_S = {"manual": 0.0}  # else 0.2
OVERHEAD_S = {"gphoto2": 2.0, "folder": 4.0, "simulated": 0.5}  # per frame: release, 24 MP over USB, a person


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a capture consists of; a resumed one must have the same."""

    angles_deg: tuple[float, ...]
    bracket: tuple[Exposure, ...]
    repeat_deg: tuple[float, ...] = ()  # angles whose bracket is taken twice
    ambient: bool = False  # a frame without flash per angle, or one where a person switches it
    chart: bool = False  # a frame of the chart alone
    cross: bool = False  # the bracket once more under a polarized flash, crossed to the first angle
    rotator: str = ""  # URL
    camera: str = ""

    def __post_init__(self) -> None:
        """Raises SettingError where no capture can come of it."""
        for angle in self.angles_deg:
            if not 0 <= angle < 360:
                raise SettingError(f"--angles {angle:g}: not in 0 to 360 degrees; give the angle modulo 360")
        names = [layouts.degrees(angle) for angle in self.angles_deg]
        if len(set(names)) < len(names):
            raise SettingError("--angles names an angle twice; take a bracket again with --repeat")
        if layouts.different(self.angles_deg) < 3:
            listed = ", ".join(f"{angle:g}" for angle in self.angles_deg)
            raise SettingError(f"--angles {listed}: fewer than 3 different polarizer angles; give 3 or more")
        for angle in self.repeat_deg:
            if angle not in self.angles_deg:
                raise SettingError(f"--repeat {angle:g}: is not among --angles; give one of them")


@dataclass(frozen=True)
class Slot:
    """One frame to take."""

    role: Role
    angle_deg: float | None  # asked for; None: wherever the ring stands
    step: int  # within the bracket
    exposure: Exposure
    flash: bool = True

    @property
    def name(self) -> str:
        """Path in the capture, without suffix."""
        at = "" if self.angle_deg is None else f"pol{layouts.degrees(self.angle_deg)}"
        if self.role == "shot":
            return f"{at}/frame_{self.step + 1}"
        if self.role == "repeat":
            return f"repeat/{at}_frame_{self.step + 1}"
        if self.role == "cross":
            return f"cross/frame_{self.step + 1}"
        return f"{self.role}/{at or self.role}"


def slots(order: Order, switches_flash: bool) -> tuple[Slot, ...]:
    """Every frame, in the order of capture.toml: angles as asked, then repeats, ambient, chart, cross.

    Where a person has to switch the flash there is one ambient frame, for all angles.
    """
    found = [Slot("shot", angle, e, x) for angle in order.angles_deg for e, x in enumerate(order.bracket)]
    found += [Slot("repeat", angle, e, x) for angle in order.repeat_deg for e, x in enumerate(order.bracket)]
    last, middle = len(order.bracket) - 1, len(order.bracket) // 2
    if order.ambient:
        at: Iterable[float | None] = order.angles_deg if switches_flash else (None,)
        found += [Slot("ambient", angle, last, order.bracket[last], flash=False) for angle in at]
    if order.chart:
        found.append(Slot("chart", None, middle, order.bracket[middle]))
    if order.cross:
        found += [Slot("cross", order.angles_deg[0], e, x) for e, x in enumerate(order.bracket)]
    return tuple(found)


def next_slot(missing: Sequence[Slot], at_deg: float) -> Slot:
    """What to take now, so that the ring turns little.

    The chart first, all of the present angle, then on towards the nearer end of the angles left and through them
    (upwards if alike); then what a person must switch the flash for, and last what the flash's filter is put on for.
    """
    for slot in missing:
        if slot.role == "chart":
            return slot
    turning = [slot for slot in missing if slot.angle_deg is not None and slot.role != "cross"]
    if not turning:
        return next((slot for slot in missing if slot.role != "cross"), missing[0])
    angles = [slot.angle_deg for slot in turning if slot.angle_deg is not None]
    if at_deg in angles:
        goal = at_deg
    else:
        low, high = min(angles), max(angles)
        goal = low if abs(at_deg - low) <= abs(at_deg - high) else high
    return next(slot for slot in turning if slot.angle_deg == goal)


def schedule(all_slots: Sequence[Slot], at_deg: float = 0.0) -> list[Slot]:
    """All frames in the order of taking."""
    left, ordered = list(all_slots), []
    while left:
        slot = next_slot(left, at_deg)
        at_deg = at_deg if slot.angle_deg is None else slot.angle_deg
        left.remove(slot)
        ordered.append(slot)
    return ordered


@dataclass(frozen=True)
class Pace:
    """How fast the rig is."""

    speed_deg_s: float
    settle_s: float
    overhead_s: float  # per frame, beside the exposure

    def frame_s(self, slot: Slot) -> float:
        return (slot.exposure.time_s or 0.0) + self.overhead_s

    def turn_s(self, from_deg: float, to_deg: float | None) -> float:
        if to_deg is None or to_deg == from_deg:
            return 0.0
        return abs(to_deg - from_deg) / self.speed_deg_s + self.settle_s

    def total_s(self, ordered: Iterable[Slot], at_deg: float) -> float:
        seconds = FINISH_S
        for slot in ordered:
            seconds += self.turn_s(at_deg, slot.angle_deg) + self.frame_s(slot)
            at_deg = at_deg if slot.angle_deg is None else slot.angle_deg
        return seconds


def overhead_s(camera: str) -> float:
    """Nominal, by the camera's name. Raises SettingError."""
    kind = camera.partition(":")[0].partition("?")[0]
    if kind not in OVERHEAD_S:
        raise SettingError(f"--camera {camera}: no such camera; choose one of {', '.join(OVERHEAD_S)}")
    return OVERHEAD_S[kind]


def dry_run(order: Order) -> dict[str, Any]:
    """The plan for devices that are not asked: nominal pace.

    Where no exposures are given, three are taken that fit the light: ISO 100 to 1600 under a flash, else around 1/50 s.
    """
    head, _, query = order.rotator.partition("?")
    kind = head.partition(":")[0]
    if kind not in SPEED_DEG_S:
        raise SettingError(f"--rotator {order.rotator}: no such rotator; choose one of {', '.join(SPEED_DEG_S)}")
    try:
        settle = float(dict(parse_qsl(query)).get("settle", SETTLE_S.get(kind, 0.2)))
    except ValueError:
        raise SettingError(f"--rotator {order.rotator}: settle is no number of seconds") from None
    pace = Pace(SPEED_DEG_S[kind], settle, overhead_s(order.camera))
    simulated = order.camera.startswith("simulated")
    usual = by_iso(_DIAL) if names_flash(order) and not simulated else by_shutter(0.02)
    bracket = order.bracket or usual
    whole = msgspec.structs.replace(order, bracket=bracket)
    return document(whole, schedule(slots(whole, simulated)), pace)


def document(order: Order, ordered: Sequence[Slot], pace: Pace) -> dict[str, Any]:
    """The plan with the time of each part [s]."""
    at = 0.0
    home_s = 0.0 if order.rotator == "manual" else 360.0 / pace.speed_deg_s
    parts: list[dict[str, Any]] = [{"part": "home", "frames": 0, "seconds": home_s}]
    for slot in ordered:
        turn = pace.turn_s(at, slot.angle_deg)
        at = at if slot.angle_deg is None else slot.angle_deg
        if turn:
            parts.append({"part": f"turn to {at:g}° and settle", "frames": 0, "seconds": turn})
        label = slot.role if slot.angle_deg is None else f"{slot.role} {at:g}°"
        if parts[-1]["part"] != label:
            parts.append({"part": label, "frames": 0, "seconds": 0.0, "exposures": []})
        parts[-1]["frames"] += 1
        parts[-1]["seconds"] += pace.frame_s(slot)
        parts[-1]["exposures"].append(str(slot.exposure))
    parts.append({"part": "last check and preview", "frames": 0, "seconds": FINISH_S})
    return {
        "rotator": order.rotator,
        "camera": order.camera,
        "speed_deg_s": pace.speed_deg_s,
        "settle_s": pace.settle_s,
        "overhead_s": pace.overhead_s,
        "frames": len(ordered),
        "parts": parts,
        "seconds": sum(part["seconds"] for part in parts),
        "paper_seconds": PAPER_S,
        "by_shutter": _by_shutter(order.bracket),
        "flash": names_flash(order),
        "note": light_note(order),
    }


def names_flash(order: Order) -> bool:
    """Whether the light is a flash by what is ordered: its power, frames without it, or a filter before it."""
    return order.ambient or order.cross or any(one.flash for one in order.bracket)


def light_note(order: Order) -> str:
    """What a bracket by the shutter asks of the light; empty for another one, and for the simulated lamp."""
    if not _by_shutter(order.bracket) or order.camera.startswith("simulated"):
        return ""
    if names_flash(order):
        return (
            "the bracket steps the shutter alone, which does not change a flash exposure: all its frames would be "
            "alike; step power, aperture or ISO, as in --bracket iso100,iso400,iso1600"
        )
    return (
        "the bracket steps the shutter, which is for a steady lamp; under a flash step power, aperture or ISO, as in "
        "--bracket iso100,iso400,iso1600"
    )


def _by_shutter(bracket: Sequence[Exposure]) -> bool:
    """Whether the frames differ by their shutter times alone, which change nothing under a flash."""
    others = {(one.f_number, one.iso, one.flash) for one in bracket}
    return len(others) == 1 and len({one.time_s for one in bracket}) > 1


def table(plan: dict[str, Any]) -> str:
    """The same as text."""
    lines = [f"{'part':28}{'frames':>7}{'seconds':>9}  exposures"]
    for part in plan["parts"]:
        frames = part["frames"] or ""
        lines.append(
            f"{part['part']:28}{frames:>7}{part['seconds']:9.1f}  {', '.join(part.get('exposures', ()))}".rstrip()
        )
    share = plan["seconds"] / plan["paper_seconds"]
    return "\n".join(
        [
            *lines,
            f"{'whole':28}{plan['frames']:>7}{plan['seconds']:9.1f}",
            "",
            f"rotator  {plan['rotator']}: {plan['speed_deg_s']:g} degrees/s, settles in {plan['settle_s']:g} s",
            f"camera   {plan['camera']}: {plan['overhead_s']:g} s a frame beside the exposure",
            f"paper    about a minute (Deschaintre et al. 2021); this takes {share:.2f} of it",
            *([f"light    {plan['note']}"] if plan["note"] else []),
        ]
    )
