"""Times of a shooting plan: for `polcap capture --dry-run`, and for the time that is left."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from polcap.errors import SettingError
from polcap.rig.exposure_bracket import bracket_by_iso, bracket_by_shutter
from polcap.rig.shooting_plan import CaptureOrder, Slot, light_note, plan_slots, schedule, steps_shutter, uses_flash

PAPER_S = 60.0  # Deschaintre et al. 2021: a capture "takes about a minute"
FINISH_S = 1.0  # the last frame's check, and the preview
SPEED_DEG_S = {"elliptec": 430.0, "grbl": 60.0, "line": 60.0, "manual": 9.0, "simulated": 360.0}  # nominal
SETTLE_S = {"manual": 0.0}  # else 0.2
OVERHEAD_S = {"gphoto2": 2.0, "folder": 4.0, "simulated": 0.5}  # per frame: release, 24 MP over USB, a person
_DIAL = [100.0, 400.0, 1600.0]  # ISO values of any camera
_USUAL_S = 0.02  # shutter time in the middle of a bracket


@dataclass(frozen=True)
class Pace:
    """Speed of rotator and camera."""

    speed_deg_s: float
    settle_s: float
    overhead_s: float  # per frame, without the exposure

    def frame_s(self, slot: Slot) -> float:
        return (slot.exposure.time_s or 0.0) + self.overhead_s

    def turn_s(self, from_deg: float, to_deg: float | None) -> float:
        if to_deg is None or to_deg == from_deg:
            return 0.0
        return abs(to_deg - from_deg) / self.speed_deg_s + self.settle_s

    def total_s(self, slots: Iterable[Slot], at_deg: float) -> float:
        """Time for the rest of a capture, from the present angle on."""
        seconds = FINISH_S
        for slot in schedule(slots, at_deg):
            seconds += self.turn_s(at_deg, slot.angle_deg) + self.frame_s(slot)
            at_deg = at_deg if slot.angle_deg is None else slot.angle_deg
        return seconds


def overhead_s(camera: str) -> float:
    """Nominal time per frame of a camera, by its name. Raises SettingError."""
    kind = camera.partition(":")[0].partition("?")[0]
    if kind not in OVERHEAD_S:
        raise SettingError(f"--camera {camera}: no such camera; choose one of {', '.join(OVERHEAD_S)}")
    return OVERHEAD_S[kind]


def minutes(seconds: float) -> str:
    """Such as 1:40."""
    return f"{round(seconds) // 60}:{round(seconds) % 60:02}"


def dry_run(order: CaptureOrder) -> dict[str, Any]:
    """The plan with nominal times [s]; no device is opened.

    The default bracket is ISO 100 to 1600 under a flash, else three shutter times around 1/50 s.
    """
    head, _, query = order.rotator.partition("?")
    kind = head.partition(":")[0]
    if kind not in SPEED_DEG_S:
        raise SettingError(f"--rotator {order.rotator}: no such rotator; choose one of {', '.join(SPEED_DEG_S)}")
    try:
        settle = float(dict(parse_qsl(query)).get("settle", SETTLE_S.get(kind, 0.2)))
    except ValueError:
        raise SettingError(f"--rotator {order.rotator}: settle is not a number of seconds") from None
    pace = Pace(SPEED_DEG_S[kind], settle, overhead_s(order.camera))
    simulated = order.camera.startswith("simulated")
    usual = bracket_by_iso(_DIAL) if uses_flash(order) and not simulated else bracket_by_shutter(_USUAL_S)
    order = msgspec.structs.replace(order, bracket=order.bracket or usual)
    slots = plan_slots(order, simulated)
    parts = _parts(order, slots, pace)
    return {
        "rotator": order.rotator,
        "camera": order.camera,
        "speed_deg_s": pace.speed_deg_s,
        "settle_s": pace.settle_s,
        "overhead_s": pace.overhead_s,
        "frames": len(slots),
        "parts": parts,
        "seconds": sum(part["seconds"] for part in parts),
        "paper_seconds": PAPER_S,
        "by_shutter": steps_shutter(order.bracket),
        "flash": uses_flash(order),
        "note": light_note(order),
    }


def _parts(order: CaptureOrder, slots: Iterable[Slot], pace: Pace) -> list[dict[str, Any]]:
    """Homing, turns, groups of frames and the end, each with its time [s]."""
    at_deg = 0.0
    home_s = 0.0 if order.rotator == "manual" else 360.0 / pace.speed_deg_s
    parts: list[dict[str, Any]] = [{"part": "home", "frames": 0, "seconds": home_s}]
    for slot in schedule(slots):
        turn_s = pace.turn_s(at_deg, slot.angle_deg)
        at_deg = at_deg if slot.angle_deg is None else slot.angle_deg
        if turn_s:
            parts.append({"part": f"turn to {at_deg:g}° and settle", "frames": 0, "seconds": turn_s})
        label = slot.role if slot.angle_deg is None else f"{slot.role} {at_deg:g}°"
        if parts[-1]["part"] != label:
            parts.append({"part": label, "frames": 0, "seconds": 0.0, "exposures": []})
        parts[-1]["frames"] += 1
        parts[-1]["seconds"] += pace.frame_s(slot)
        parts[-1]["exposures"].append(str(slot.exposure))
    return [*parts, {"part": "last check and preview", "frames": 0, "seconds": FINISH_S}]


def table(plan: dict[str, Any]) -> str:
    """The plan as text."""
    lines = [f"{'part':28}{'frames':>7}{'seconds':>9}  exposures"]
    for part in plan["parts"]:
        exposures = ", ".join(part.get("exposures", ()))
        lines.append(f"{part['part']:28}{part['frames'] or '':>7}{part['seconds']:9.1f}  {exposures}".rstrip())
    share = plan["seconds"] / plan["paper_seconds"]
    lines += [
        f"{'total':28}{plan['frames']:>7}{plan['seconds']:9.1f}",
        "",
        f"rotator  {plan['rotator']}: {plan['speed_deg_s']:g} degrees/s, settles in {plan['settle_s']:g} s",
        f"camera   {plan['camera']}: {plan['overhead_s']:g} s per frame, without the exposure",
        f"paper    about a minute (Deschaintre et al. 2021); this takes {share:.2f} of it",
    ]
    lines += [f"light    {plan['note']}"] if plan["note"] else []
    return "\n".join(lines)
