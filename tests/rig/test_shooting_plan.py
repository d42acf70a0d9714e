"""The shooting plan: order of the frames, times, and orders that are refused."""

import itertools

import msgspec
import pytest

from polcap.errors import SettingError
from polcap.rig import dry_run, shooting_plan
from polcap.rig.exposure_bracket import parse_bracket
from polcap.rig.shooting_plan import CaptureOrder, Slot
from tests.rig.pool import BRACKET, ORDER


def test_the_order_of_the_angles_turns_the_motor_least() -> None:
    bracket = (BRACKET[0],)
    for start in (0.0, 50.0, 170.0):
        slots = [Slot("shot", angle, 0, exposure) for angle in (90.0, 30.0, 150.0, 60.0) for exposure in bracket]
        ordered = [slot.angle_deg or 0.0 for slot in shooting_plan.schedule(slots, start)]
        ways = itertools.permutations([30.0, 60.0, 90.0, 150.0])
        least = min(_way(start, way) for way in ways)
        assert _way(start, ordered) == pytest.approx(least), start


def _way(start: float, angles: object) -> float:
    return sum(abs(b - a) for a, b in itertools.pairwise([start, *angles]))  # type: ignore[misc]


def test_the_chart_is_first_and_frames_that_need_a_person_are_last() -> None:
    slots = shooting_plan.plan_slots(msgspec.structs.replace(ORDER, chart=True), switches_flash=False)
    names = [slot.name for slot in shooting_plan.schedule(slots)]
    assert names[0] == "chart/chart" and names[-1] == "ambient/ambient"
    assert names[4:10] == [f"{place}frame_{n}" for place in ("pol045/", "repeat/pol045_") for n in (1, 2, 3)]


def test_cross_polarized_frames_are_taken_last() -> None:
    slots = shooting_plan.plan_slots(msgspec.structs.replace(ORDER, cross=True), switches_flash=True)
    names = [slot.name for slot in shooting_plan.schedule(slots, 45.0)]
    assert names[-3:] == [f"cross/frame_{n}" for n in (1, 2, 3)]
    assert {slot.angle_deg for slot in slots if slot.role == "cross"} == {ORDER.angles_deg[0]}


def test_time_of_a_plan_is_the_sum_of_its_parts() -> None:
    """0.84 s home, two turns of 45° at 430°/s and three settlings of 0.2 s, nine frames of 2 s + 0.105 s a bracket."""
    order = CaptureOrder((0.0, 45.0, 90.0), BRACKET, rotator="elliptec:/dev/ttyUSB0?settle=0.2", camera="gphoto2")
    planned = dry_run.dry_run(order)
    assert planned["frames"] == 9
    assert planned["seconds"] == pytest.approx(360 / 430 + 90 / 430 + 2 * 0.2 + 9 * 2 + 3 * 0.105 + 1.0)
    assert "about a minute" in dry_run.table(planned)
    slots = shooting_plan.plan_slots(order, switches_flash=True)
    assert dry_run.Pace(9.0, 0.0, 9.9).left(slots, 0.0) == "1:40"  # 10 s of turning, 89.4 s of frames, 1 s at the end


@pytest.mark.parametrize(
    ("bracket", "more", "first", "words"),
    [
        ("", {}, "1/200s", "for a steady lamp; under a flash step power, aperture or ISO"),
        ("", {"ambient": True}, "iso100", ""),
        ("", {"cross": True}, "iso100", ""),
        ("1/200,1/50", {"ambient": True}, "1/200s", "does not change a flash exposure"),
        ("1/160 flash1/16, 1/40", {}, "1/160s flash1/16", "does not change a flash exposure"),
        ("flash1/64,flash1/16", {}, "flash1/64", ""),
        ("f/22,f/11", {"cross": True}, "f/22", ""),
    ],
)
def test_a_plan_brackets_by_the_shutter_only_under_a_steady_lamp(
    bracket: str, more: dict[str, bool], first: str, words: str
) -> None:
    order = CaptureOrder((0.0, 45.0, 90.0), parse_bracket(bracket) if bracket else (), rotator="manual")
    order = msgspec.structs.replace(order, camera="gphoto2", **more)
    planned = dry_run.dry_run(order)
    assert next(part for part in planned["parts"] if part["frames"])["exposures"][0] == first
    assert words in planned["note"] and bool(words) == bool(planned["note"])
    assert dry_run.dry_run(msgspec.structs.replace(order, camera="simulated"))["note"] == ""


@pytest.mark.parametrize(
    ("angles", "repeat", "words"),
    [
        ((0.0, 45.0), (), "fewer than 3"),
        ((0.0, 90.0, 180.0), (), "fewer than 3"),
        ((0.0, 45.0, 400.0), (), "not all in 0 to 360"),
        ((0.0, 45.0, 90.0, 45.0), (), "twice"),
        ((0.0, 45.0, 90.0), (30.0,), "--repeat 30"),
    ],
)
def test_options_that_make_no_capture_are_refused(
    angles: tuple[float, ...], repeat: tuple[float, ...], words: str
) -> None:
    with pytest.raises(SettingError, match=words):
        CaptureOrder(angles, BRACKET, repeat_deg=repeat)
