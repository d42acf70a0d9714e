"""One finding of `polcap doctor`."""

from typing import Literal

import msgspec

State = Literal["ok", "warning", "fault"]


class Finding(msgspec.Struct, frozen=True):
    """One thing that was checked, and the remedy if it is not ok."""

    name: str
    state: State
    message: str = msgspec.field(name="says")  # the key in the JSON output
    remedy: str = ""
