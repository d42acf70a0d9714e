"""With every motor: the angle returned is the true one, or there is an error."""

from contextlib import closing
from pathlib import Path

import pytest
from msgspec import convert

from polcap.errors import HardwareError, SettingError
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_rotator, probe
from polcap.rig.rotator import PolarizerRotator, RotatorSettings
from polcap.rig.serial_port import Unplugged
from tests.rig.devices import Elliptec, Grbl, Line
from tests.rig.far_end import ALWAYS, SPOKEN, Device

pytestmark = [pytest.mark.timeout(120), pytest.mark.usefixtures("clock")]
KINDS: dict[str, type[Elliptec | Grbl | Line]] = {"elliptec": Elliptec, "grbl": Grbl, "line": Line}


def opened(kind: str, device: Device, settings: str = "", log: Log | None = None) -> PolarizerRotator:
    return open_rotator(f"{kind}:{device.port}?settle=0&timeout=4{settings}", log or Log(None))


def off(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def shoot_round(device: Device, rotator: PolarizerRotator, angles: tuple[float, ...] = (10.0, 45.0, 90.0)) -> None:
    """Every angle is reached, or an error is raised; the coarsest device steps 0.09°."""
    for angle in angles:
        read = rotator.move(angle)
        assert 0 <= read < 360 and off(read, angle) <= 0.06 and off(device.angle_deg, angle) <= 0.06


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("settings", "axis", "offset"), [("offset=12.5", 1, 12.5), ("offset=100&reverse=1", -1, 100)])
def test_angles_are_reached_with_offset_and_sense(kind: str, settings: str, axis: int, offset: float) -> None:
    with KINDS[kind]() as device, closing(opened(kind, device, f"&{settings}")) as rotator:
        for angle in (0.0, 45.0, 90.0, 30.0, 0.0, 300.0):
            assert off(rotator.move(angle), angle) <= 0.06
            assert off(device.angle_deg, offset + axis * angle) <= 0.06


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("at", [1, 2, 3, 5, 8, 12])
@pytest.mark.parametrize("fault", [*SPOKEN, "late"])
def test_a_lost_or_damaged_answer_is_asked_for_again(kind: str, at: int, fault: str) -> None:
    with KINDS[kind](fault=fault, at=at) as device, closing(opened(kind, device)) as rotator:
        shoot_round(device, rotator)


@pytest.mark.parametrize(
    ("kind", "fault"), [(kind, fault) for kind, device in KINDS.items() for fault in device.FAULTS]
)
@pytest.mark.parametrize("at", [1, 6])
def test_a_lasting_fault_is_one_error_and_no_wrong_angle(kind: str, fault: str, at: int) -> None:
    with KINDS[kind](fault=fault, at=at, times=ALWAYS) as device:
        error = pytest.raises(HardwareError, match=r"rotator|GRBL|ELL14")
        with error as raised, closing(opened(kind, device)) as rotator:
            shoot_round(device, rotator, (10.0, 45.0, 90.0, 0.0, 45.0, 90.0))
        assert "\n" not in str(raised.value)
        assert isinstance(raised.value, Unplugged) == (fault == "unplug")


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_position_is_approached_once_more(kind: str) -> None:
    with KINDS[kind](fault="wrong-position", at=4) as device, closing(opened(kind, device)) as rotator:
        shoot_round(device, rotator)
        assert device.moves >= 5


@pytest.mark.parametrize("kind", KINDS)
def test_a_ring_turned_by_hand_or_a_lost_zero_is_homed_again(kind: str, tmp_path: Path) -> None:
    with KINDS[kind]() as device, closing(opened(kind, device, log=Log(tmp_path / "rig.log"))) as rotator:
        rotator.move(45)
        if isinstance(device, Line):
            device.homed = False
        else:  # its counter starts again
            device._zero_deg = device.angle_deg
        shoot_round(device, rotator, (90.0,))
    assert "homed again" in (tmp_path / "rig.log").read_text()


class Recorder:
    """A motor that records its commands and stops `error_deg` away from the angle."""

    model, speed_deg_s, wraps = "recorder", 90.0, False

    def __init__(self, error_deg: float = 0.0) -> None:
        self.commands: list[object] = []
        self.error_deg = error_deg

    def home(self) -> None:
        self.commands.append("home")

    def go(self, angle_deg: float) -> None:
        self.commands.append(angle_deg)

    def position(self) -> float:
        return float(self.commands[-1]) + self.error_deg  # type: ignore[arg-type]

    def halt(self) -> None:
        self.commands.append("halt")
        raise Unplugged("pulled")


def driven(motor: Recorder, query: str) -> PolarizerRotator:
    settings = convert(dict(pair.split("=") for pair in query.split("&")), RotatorSettings, strict=False)
    return PolarizerRotator(motor, settings, Log(None))


@pytest.mark.parametrize(
    ("settings", "angles", "commands"),
    [
        ("backlash=2", (0, 45, 90, 30, 30), ["home", -2, 0, 45, 90, 28, 30, 30]),
        ("backlash=2&reverse=1", (0, 45), ["home", -2, 0, -47, -45]),
    ],
)
def test_every_angle_is_reached_upwards(settings: str, angles: tuple[float, ...], commands: list[object]) -> None:
    motor = Recorder()
    rotator = driven(motor, f"settle=0&{settings}")
    for angle in angles:
        rotator.move(angle)
    assert motor.commands == commands


@pytest.mark.parametrize(("error_deg", "reverse", "read"), [(0.2, 0, 45.2), (0.2, 1, 44.8), (-0.25, 0, 44.75)])
def test_the_angle_read_back_is_returned(error_deg: float, reverse: int, read: float) -> None:
    assert driven(Recorder(error_deg), f"settle=0&reverse={reverse}").move(45) == pytest.approx(read)
    assert driven(Recorder(-1e-14), "settle=0").move(0) == 0.0  # not 360


def test_beyond_the_tolerance_is_an_error_with_the_distance() -> None:
    with pytest.raises(HardwareError, match=r"\+0\.40° away from 45°, more than tolerance = 0\.3°"):
        driven(Recorder(0.4), "settle=0").move(45)
    assert driven(Recorder(0.4), "settle=0&tolerance=0.5").move(45) == pytest.approx(45.4)


def test_closing_never_raises_and_the_ring_is_homed_again() -> None:
    motor = Recorder()
    rotator = driven(motor, "settle=0")
    rotator.move(10)
    rotator.close()
    rotator.move(20)
    rotator.close()
    assert motor.commands == ["home", 10, "halt", "home", 20, "halt"]


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("piezo:/dev/x", "choose one of elliptec, grbl, line, simulated, manual"),
        ("elliptec", "names no port"),
        ("elliptec:/dev/x?adress=1", "unknown setting 'adress'; the settings are .*address"),
        ("elliptec:/dev/x?address=G", "regex"),
        ("elliptec:/dev/x?steps=4", "unknown setting 'steps'"),
        ("grbl:/dev/x?backlash=-1", "backlash"),
        ("grbl:/dev/x?offset=north", "offset"),
        ("line:/dev/x?offset", "write settings as"),
        ("manual:/dev/x", "no port"),
        ("manual?settle=1", "no settings"),
        ("simulated:/dev/x", "no port"),
    ],
)
def test_a_wrong_url_is_an_error_with_the_remedy(url: str, words: str) -> None:
    with pytest.raises(SettingError, match=words):
        open_rotator(url, Log(None))


def test_the_simulated_motor_needs_no_port() -> None:
    rotator = open_rotator("simulated?settle=0&speed=100000&offset=+3", Log(None))
    assert rotator.move(45) == pytest.approx(45, abs=0.3)
    rotator.close()


@pytest.mark.parametrize(
    ("device", "name"),
    [(Elliptec(), "Elliptec ELL14 at address 0"), (Grbl(), "GRBL"), (Line(), "polcap-rotator simulated")],
)
def test_probe_names_the_device_and_moves_nothing(device: Device, name: str) -> None:
    with device:
        assert probe(device.port) == name
        assert device.moves == 0


def test_probe_of_a_port_where_nothing_answers_is_none() -> None:
    with Elliptec(address="7") as device:
        assert probe(device.port) is None
    with pytest.raises(HardwareError):
        probe("/dev/no-such-port")
