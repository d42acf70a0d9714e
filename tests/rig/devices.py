"""Simulated rotators at the far end of a serial line; `far_end` has their faults and their clock.

GRBL counts steps and cannot feel the ring: its wrong-position is one it reports, as after a stray jog.
"""

import re
from typing import ClassVar

from tests.rig.far_end import SPOKEN, Device


class Elliptec(Device):
    """ELL14: 9600 8N1, `0in gs ho ma mr gp so go sv us st`, with or without CR LF behind a command."""

    FAULTS = (*SPOKEN, "busy", "mechanical-timeout", "wrong-position", "unplug")
    PULSES = 143360  # per revolution
    JITTER = 3  # pulses between the position asked for and the one reached
    LENGTH: ClassVar[dict[str, int]] = {"ho": 1, "ma": 8, "mr": 8, "so": 8, "sv": 2}  # digits of data

    def __init__(self, *, address: str = "0", kind: int = 14, travel: int = 360, **planted: object) -> None:
        super().__init__(**planted)  # type: ignore[arg-type]
        self.address = address
        self.identity = f"{kind:02X}1234567820241701{travel:04X}{self.PULSES:08X}"
        self.saved_offset = self.offset = 0  # pulses
        self._zero_deg = self.angle_deg  # until homed, it counts from where it woke
        self._fault = 0
        self._input = ""

    def receive(self, data: bytes) -> None:
        self._input += data.decode("latin-1").replace("\r", "").replace("\n", "")
        while len(self._input) >= (need := 3 + self.LENGTH.get(self._input[1:3], 0)):
            command, self._input = self._input[:need], self._input[need:]
            self.heard.append(command)
            if command[0] == self.address:
                self.obey(command[1:3], command[3:])

    def obey(self, letters: str, data: str) -> None:
        if letters == "st":
            self.freeze()
            self.status(0)
        elif letters == "gs":
            self.status(9 if self.moving else self._fault)
            self._fault = 0
        elif self.moving:
            self.status(9)
        elif letters == "in":
            self.reply("IN" + self.identity)
        elif letters == "gp":
            self.arrived()
        elif letters == "go":
            self.reply(f"HO{self.number(self.offset)}")
        elif letters in ("us", "so", "sv"):
            self.offset = self.signed(data) if letters == "so" else self.offset
            self.saved_offset = self.offset if letters == "us" else self.saved_offset
            self.status(0)
        elif letters == "ho":
            self.turn(self.offset / self.PULSES * 360, self.home)
        elif letters in ("ma", "mr"):
            pulses = self.signed(data) + self.JITTER + (self.pulses if letters == "mr" else 0)
            self.turn(self._zero_deg + pulses / self.PULSES * 360, self.arrived)
        else:
            self.status(3)

    def home(self) -> None:
        self._zero_deg = self.offset / self.PULSES * 360
        self.arrived()

    def arrived(self) -> None:
        self.reply(f"PO{self.number(self.pulses)}")

    def halfway(self) -> None:
        self._fault = 2
        self.status(2)

    @property
    def pulses(self) -> int:
        return round((self.angle_deg - self._zero_deg) / 360 * self.PULSES)

    def status(self, code: int) -> None:
        self.reply(f"GS{code:02X}")

    def reply(self, text: str) -> None:
        self.say(self.address + text)

    @staticmethod
    def number(pulses: int) -> str:
        return f"{pulses & 0xFFFFFFFF:08X}"

    @staticmethod
    def signed(data: str) -> int:
        value = int(data, 16)
        return value - (1 << 32) if value >> 31 else value


class Grbl(Device):
    """GRBL 1.1: one axis, X, in units of which `$100` states the steps; `homing` wires a switch.

    `$10` 0 reports work positions (G54 has an offset of 7 units), stating the offset in one of 30 reports; `$13` 1
    reports inches (gnea/grbl, grbl/report.c).
    """

    FAULTS = (*SPOKEN, "busy", "wrong-position", "unplug", "alarm", "restart")
    BANNER = "Grbl 1.1h ['$' for help]"
    HOMED_AT = -499.0  # units: travel 500 to the negative side, pull-off 1

    WORK_OFFSET = 7.0  # units

    def __init__(
        self, *, homing: bool = True, steps: float = 10.0, degrees: float = 1.0, mask: int = 1, inches: bool = False,
        **planted: object,
    ) -> None:  # fmt: skip
        """`degrees` per unit: where the unit is not a degree. `mask`: $10. `inches`: $13."""
        super().__init__(**planted)  # type: ignore[arg-type]
        self.settings = {
            10: float(mask), 13: float(inches), 22: float(homing), 100: steps, 110: self.speed_deg_s * 60 / degrees,
            130: 500.0,
        }  # fmt: skip
        self.degrees = degrees
        self.state = "Alarm" if homing else "Idle"
        self._critical = False  # a limit switch was hit: only reset helps
        self._zero_deg = self.angle_deg  # machine zero
        self._forget()

    def _forget(self) -> None:
        """Empty the buffers, as at a reset."""
        self._input = b""
        self._reports = 0
        self._lines: list[str] = []
        self._planned: list[float] = []  # ring degrees
        self._waiting = False  # for the ring to stop, before it answers ok

    def receive(self, data: bytes) -> None:
        for character in (bytes([byte]) for byte in data):
            if character in b"\x18?!":
                self.heard.append("reset" if character == b"\x18" else character.decode())
            if character == b"\x18":
                self.reset()
            elif character == b"?" and self.state != "Home":
                self.report()
            elif character == b"!":
                self.freeze()
                self._planned = []
                self.state = "Hold" if self.state in ("Run", "Idle") else self.state
            elif character in b"\r\n":
                line, self._input = self._input.decode("ascii", "replace"), b""
                self.heard.extend([line] if line else [])
                self._lines.append(line)
            elif character != b"?":
                self._input += character

    def tick(self) -> None:
        """Obey lines in order, while none waits for the ring."""
        while self._lines and not self._waiting and self.state != "Hold":
            self.obey(self._lines.pop(0))

    def obey(self, line: str) -> None:
        text = line.replace(" ", "").upper()
        if self._critical or self.state == "Sleep":
            return
        if text == "$H" and self.settings[22]:
            self.state, self._waiting = "Home", True
            self.turn(0.0, self.homed)
        elif text in ("$H", "$SLP", "$X", "$$", ""):
            self.state = {"$SLP": "Sleep", "$X": "Idle"}.get(text, self.state)
            stored = [f"${number}={value:.3f}" for number, value in self.settings.items()]
            answers = {"$H": ["error:5"], "$X": ["[MSG:Caution: Unlocked]", "ok"], "$$": [*stored, "ok"]}
            for answer in answers.get(text, ["ok"]):
                self.say(answer)
        elif text.startswith("$"):
            self.say("error:3")
        elif self.state == "Alarm":
            self.say("error:9")
        elif text.startswith("G4"):
            self._waiting = self.moving
            if not self.moving:
                self.say("ok")
        elif axis := re.fullmatch(r"G21G90G53G0X(-?\d+\.?\d*)", text):
            self.say("ok")
            self._planned.append(self._zero_deg + float(axis[1]) * self.degrees)
            if not self.moving:
                self.arrived()
        else:
            self.say("error:20")

    def homed(self) -> None:
        self._zero_deg = self.angle_deg - self.HOMED_AT * self.degrees
        self.arrived()

    def arrived(self) -> None:
        self.state = "Run" if self._planned else "Idle"
        if self._planned:
            self.turn(self._planned.pop(0), self.arrived)
        elif self._waiting:
            self._waiting = False
            self.say("ok")

    def halfway(self) -> None:
        self._forget()
        if self._struck == "alarm":
            self.state, self._critical = "Alarm", True
            self.say("ALARM:1")
            self.say("[MSG:Reset to continue]")
        else:  # restart
            self._zero_deg = self.angle_deg
            self.state = "Alarm" if self.settings[22] else "Idle"
            self.say(self.BANNER)

    def reset(self) -> None:
        lost = self.state in ("Run", "Home")
        self.freeze()
        self._forget()
        self._critical = False
        if lost:
            self.say("ALARM:3")
        self.state = "Alarm" if lost or self.state in ("Alarm", "Sleep") else "Idle"
        self.say(f"\r\n{self.BANNER}")
        if self.state == "Alarm":
            self.say("[MSG:'$H'|'$X' to unlock]")

    def report(self) -> None:
        position, offset = (self.angle_deg - self._zero_deg) / self.degrees, self.WORK_OFFSET
        in_work = not int(self.settings[10]) & 1
        scale, decimals = (1 / 25.4, 4) if self.settings[13] else (1.0, 3)
        values = f"{'W' if in_work else 'M'}Pos:{(position - offset * in_work) * scale:.{decimals}f},0.000,0.000"
        stated = f"|WCO:{offset * scale:.{decimals}f},0.000,0.000" if self._reports % 30 == 0 else ""
        self._reports += 1
        self.say(f"<{self.state.replace('Hold', 'Hold:0')}|{values}|FS:0,0{stated}>")


class Line(Device):
    """A board with the sketch of `examples/rotator_firmware`; steps of 0.09°."""

    FAULTS = (*SPOKEN, "busy", "mechanical-timeout", "wrong-position", "unplug", "restart")
    END = b"\n"
    STEP = 0.09  # degrees
    HELLO = "polcap-rotator 1 simulated 60"

    def __init__(self, *, switch: bool = True, **planted: object) -> None:
        super().__init__(**planted)  # type: ignore[arg-type]
        self.switch = switch
        self.homed = False
        self.released = True
        self._zero_deg = self.angle_deg
        self._input = ""
        self._beat = 0.0

    def receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data.decode("latin-1")).split("\n")
        for line in lines:
            self.heard.append(line.strip())
            self.obey(line.strip())

    def obey(self, line: str) -> None:
        word, _, number = line.partition(" ")
        if word == "?":
            self.say(self.HELLO)
        elif word == "stop":
            self.freeze()
            self.homed, self.released = False, True
            self.position()
        elif word == "home" and not self.switch:
            self.say("error there is no switch; use home=ask")
        elif word == "home":
            self.released = False
            self.turn(0.0, self.zero)
        elif word == "zero":
            self.zero()
        elif word in ("go", "where") and not self.homed:
            self.say("error home first")
        elif word == "where":
            self.position()
        elif word == "go" and re.fullmatch(r"-?\d+(\.\d+)?", number):
            self.released = False
            self.turn(self._zero_deg + round(float(number) / self.STEP) * self.STEP, self.position)
        else:
            self.say("error unknown command")

    def zero(self) -> None:
        self._zero_deg, self.homed = self.angle_deg, True
        self.position()

    def position(self) -> None:
        self.say(f"ok {self.angle_deg - self._zero_deg:.3f}")

    def halfway(self) -> None:
        self.homed, self.released = False, True
        stalled = self._struck == "mechanical-timeout"
        self.say("error the motor stalled; free the ring" if stalled else f"{self.HELLO} started")

    def tick(self) -> None:
        if self.moving and self._clock.monotonic() - self._beat > 0.2:
            self._beat = self._clock.monotonic()
            self.send(f"busy {self.angle_deg - self._zero_deg:.3f}\n".encode())
