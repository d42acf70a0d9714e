"""Estimates the time that a shooting plan takes, for `polcap capture --dry-run` and the remaining time."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from polcap.errors import SettingError
from polcap.rig.exposure_bracket import bracket_by_iso, bracket_by_shutter
from polcap.rig.shooting_plan import CaptureOrder, Slot, light_note, plan_slots, schedule, steps_shutter, uses_flash

PAPER_S = 60.0  # Deschaintre et al. 2021: a capture "takes about a minute"
FINISH_S = 1.0  # the last frame's check, and the preview
SPEED_DEG_S = {"elliptec": 430.0, "grbl": 60.0, "line": 60.0, "manual": 9.0, "simulated": 360.0}  # nominal
OVERHEAD_S = {"gphoto2": 2.0, "folder": 4.0, "simulated": 0.5}  # per frame: release, 24 MP over USB, a person
_SETTLE_S = 0.2  # of a motor
_DIAL = [100.0, 400.0, 1600.0]  # ISO values that every camera has
_USUAL_S = 0.02  # shutter time in the middle of a bracket


@dataclass(frozen=True)
class Pace:
    """Speed of the rotator [°/s], settling time and time per frame of the camera [s]."""

    speed_deg_s: float
    settle_s: float
    overhead_s: float  # per frame, without the exposure

    def steps(self, slots: Iterable[Slot], at_deg: float) -> list[tuple[Slot, float, float]]:
        """Frames in the order of taking, each with the time of the rotation before it and of the frame itself [s]."""
        steps = []
        for slot in schedule(slots, at_deg):
            turn_s = 0.0
            if slot.angle_deg is not None and slot.angle_deg != at_deg:
                turn_s = abs(slot.angle_deg - at_deg) / self.speed_deg_s + self.settle_s
                at_deg = slot.angle_deg
            steps.append((slot, turn_s, (slot.exposure.time_s or 0.0) + self.overhead_s))
        return steps

    def left(self, slots: Iterable[Slot], at_deg: float) -> str:
        """Remaining time of a capture from the current angle on, as text such as 1:40."""
        seconds = round(FINISH_S + sum(turn_s + frame_s for _, turn_s, frame_s in self.steps(slots, at_deg)))
        return f"{seconds // 60}:{seconds % 60:02}"


def overhead_s(camera: str) -> float:
    """Nominal time [s] per frame of a camera, without the exposure, by its name. Raises SettingError."""
    return _by_kind("--camera", camera, OVERHEAD_S)


def dry_run(order: CaptureOrder) -> dict[str, Any]:
    """The shooting plan with nominal times [s] as data for JSON; no device is opened.

    The default bracket is ISO 100 to 1600 under a flash, else three shutter times around 1/50 s.
    """
    speed = _by_kind("--rotator", order.rotator, SPEED_DEG_S)
    default_settle_s = 0.0 if order.rotator == "manual" else _SETTLE_S
    try:
        settle = float(dict(parse_qsl(order.rotator.partition("?")[2])).get("settle", default_settle_s))
    except ValueError:
        raise SettingError(f"--rotator {order.rotator}: settle is not a number of seconds") from None
    pace = Pace(speed, settle, overhead_s(order.camera))
    simulated = order.camera.startswith("simulated")
    default_bracket = bracket_by_iso(_DIAL) if uses_flash(order) and not simulated else bracket_by_shutter(_USUAL_S)
    order = msgspec.structs.replace(order, bracket=order.bracket or default_bracket)
    slots = plan_slots(order, simulated)
    homing_s = 0.0 if order.rotator == "manual" else 360.0 / speed
    parts = _parts(pace.steps(slots, 0.0), homing_s)
    return {
        "rotator": order.rotator,
        "camera": order.camera,
        **asdict(pace),
        "frames": len(slots),
        "parts": parts,
        "seconds": sum(part["seconds"] for part in parts),
        "paper_seconds": PAPER_S,
        "by_shutter": steps_shutter(order.bracket),
        "flash": uses_flash(order),
        "note": light_note(order),
    }


def _by_kind(option: str, url: str, values: dict[str, float]) -> float:
    """The value, by kind of device, for a device's URL such as grbl:PORT. Raises SettingError: an unknown kind."""
    kind = url.partition("?")[0].partition(":")[0]
    if kind not in values:
        raise SettingError(f"{option} {url}: no such {option[2:]}; choose one of {', '.join(values)}")
    return values[kind]


def _parts(steps: list[tuple[Slot, float, float]], home_s: float) -> list[dict[str, Any]]:
    """Parts of the plan with their times [s]: homing, rotations, groups of frames, end."""
    parts: list[dict[str, Any]] = [{"part": "home", "frames": 0, "seconds": home_s}]
    for slot, turn_s, frame_s in steps:
        angle = "" if slot.angle_deg is None else f" {slot.angle_deg:g}°"
        if turn_s:
            parts.append({"part": f"turn to{angle} and settle", "frames": 0, "seconds": turn_s})
        if parts[-1]["part"] != slot.role + angle:
            parts.append({"part": slot.role + angle, "frames": 0, "seconds": 0.0, "exposures": []})
        parts[-1]["frames"] += 1
        parts[-1]["seconds"] += frame_s
        parts[-1]["exposures"].append(str(slot.exposure))
    return [*parts, {"part": "last check and preview", "frames": 0, "seconds": FINISH_S}]


def table(plan: dict[str, Any]) -> str:
    """The shooting plan as text."""
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
        f"compare  the published method takes about a minute (Deschaintre et al. 2021); this takes {share:.2f} of it",
    ]
    return "\n".join(lines + ([f"light    {plan['note']}"] if plan["note"] else []))
