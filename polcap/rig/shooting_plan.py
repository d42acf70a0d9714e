"""Shooting plan: every frame of a capture, in the order that turns the motor least."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec

from polcap.capture_values import Role
from polcap.errors import SettingError
from polcap.formats.capture import folder_names
from polcap.rig.exposure_bracket import Exposure


class CaptureOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The options of `polcap capture`; a resumed capture must have the same."""

    angles_deg: tuple[float, ...]
    bracket: tuple[Exposure, ...]
    repeat_deg: tuple[float, ...] = ()  # the bracket is taken twice at these angles
    ambient: bool = False  # a frame without flash per angle, or one in all if a person switches the flash
    chart: bool = False  # a frame of the chart alone
    cross: bool = False  # the bracket once more under a polarized flash, crossed to the first angle
    rotator: str = ""  # URL
    camera: str = ""

    def __post_init__(self) -> None:
        """Raises SettingError if the angles cannot form a capture."""
        listed = ",".join(f"{angle:g}" for angle in self.angles_deg)
        if not all(0 <= angle < 360 for angle in self.angles_deg):
            raise SettingError(f"--angles {listed}: not all in 0 to 360 degrees; give angles modulo 360")
        if len({folder_names.degrees(angle) for angle in self.angles_deg}) < len(self.angles_deg):
            raise SettingError(f"--angles {listed} names an angle twice; take a bracket again with --repeat")
        if folder_names.count_axes(self.angles_deg) < 3:
            raise SettingError(f"--angles {listed}: fewer than 3 different polarizer angles; give 3 or more")
        for angle in set(self.repeat_deg) - set(self.angles_deg):
            raise SettingError(f"--repeat {angle:g}: is not among --angles; give one of {listed}")


@dataclass(frozen=True)
class Slot:
    """One frame of a shooting plan: role, polarizer angle, place in the bracket, exposure, flash."""

    role: Role
    angle_deg: float | None  # None: at any angle
    step: int  # within the bracket
    exposure: Exposure
    flash: bool = True

    @property
    def name(self) -> str:
        """Path of the frame's file in the capture folder, without suffix."""
        angle = "" if self.angle_deg is None else f"pol{folder_names.degrees(self.angle_deg)}"
        frame = f"frame_{self.step + 1}"
        names = {"shot": f"{angle}/{frame}", "repeat": f"repeat/{angle}_{frame}", "cross": f"cross/{frame}"}
        return names.get(self.role, f"{self.role}/{angle or self.role}")


def plan_slots(order: CaptureOrder, switches_flash: bool) -> tuple[Slot, ...]:
    """Every frame of a capture, in the order of capture.toml: the angles, then repeats, ambient, chart, cross.

    If a person has to switch the flash, there is one ambient frame for all angles.
    """
    bracket, middle = list(enumerate(order.bracket)), len(order.bracket) // 2
    slots = [Slot("shot", angle, *frame) for angle in order.angles_deg for frame in bracket]
    slots += [Slot("repeat", angle, *frame) for angle in order.repeat_deg for frame in bracket]
    if order.ambient:
        angles: Iterable[float | None] = order.angles_deg if switches_flash else (None,)
        slots += [Slot("ambient", angle, *bracket[-1], flash=False) for angle in angles]
    if order.chart:
        slots.append(Slot("chart", None, *bracket[middle]))
    if order.cross:
        slots += [Slot("cross", order.angles_deg[0], *frame) for frame in bracket]
    return tuple(slots)


def next_slot(missing: Sequence[Slot], at_deg: float) -> Slot:
    """The frame of a shooting plan to take now.

    The order is: the chart; all frames at the present angle; the remaining angles in order, from the nearer end; frames
    for which a person switches the flash; frames with the filter on the flash.
    """
    angles = [slot.angle_deg for slot in missing if slot.angle_deg is not None and slot.role != "cross"]
    wanted_deg = at_deg
    if angles and at_deg not in angles:
        wanted_deg = min(min(angles), max(angles), key=lambda angle: abs(angle - at_deg))

    def priority(slot: Slot) -> tuple[bool, bool, bool]:
        return slot.role != "chart", slot.role == "cross", slot.angle_deg != wanted_deg

    return min(missing, key=priority)


def schedule(slots: Iterable[Slot], at_deg: float = 0.0) -> list[Slot]:
    """Sort frames into the order of taking, starting at the current angle."""
    remaining, ordered = list(slots), []
    while remaining:
        slot = next_slot(remaining, at_deg)
        at_deg = at_deg if slot.angle_deg is None else slot.angle_deg
        remaining.remove(slot)
        ordered.append(slot)
    return ordered


def uses_flash(order: CaptureOrder) -> bool:
    """Whether a capture is lit by a flash, by its options: flash power, ambient frames or a filter on the flash."""
    return order.ambient or order.cross or any(one.flash for one in order.bracket)


def steps_shutter(bracket: Sequence[Exposure]) -> bool:
    """Whether a bracket's frames differ in shutter time alone, which has no effect under a flash."""
    others = {(one.f_number, one.iso, one.flash) for one in bracket}
    return len(others) == 1 and len({one.time_s for one in bracket}) > 1


def light_note(order: CaptureOrder) -> str:
    """Warning that shutter times do not change a flash exposure; "" for other brackets and the simulated camera."""
    if not steps_shutter(order.bracket) or order.camera.startswith("simulated"):
        return ""
    remedy = "step power, aperture or ISO, as in --bracket iso100,iso400,iso1600"
    if uses_flash(order):
        effect = "does not change a flash exposure: all its frames would be equal"
        return f"the bracket changes only the shutter time, which {effect}; {remedy}"
    return f"the bracket changes the shutter time, which is right for a steady lamp; under a flash {remedy}"
