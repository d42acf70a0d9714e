"""One thing that the doctor looked at."""

from typing import Literal

import msgspec

State = Literal["ok", "warning", "fault"]


class Finding(msgspec.Struct, frozen=True):
    """What was found, and the remedy where it is not ok."""

    name: str
    state: State
    says: str
    remedy: str = ""
