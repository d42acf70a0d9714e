"""Questions to the photographer at the terminal."""

import sys

from polcap.errors import HardwareError
from polcap.rig.device_log import Log

RING_TO_ZERO = "turn the polarizer's ring to 0°, then press Enter: "


def ask(question: str, log: Log) -> str:
    """Ask on stderr, read the answer from stdin. Raises HardwareError when the input has ended."""
    print(question, end="", file=sys.stderr, flush=True)
    log.write("person", ">", question.strip())
    answer = sys.stdin.readline() if sys.stdin else ""
    if not answer:
        raise HardwareError("nobody answers: the input has ended; run in a terminal")
    log.write("person", "<", answer.strip())
    return answer.strip()


def at_terminal() -> bool:
    """Whether polcap runs in a terminal, so that a person can answer."""
    return sys.stdin is not None and sys.stdin.isatty()
