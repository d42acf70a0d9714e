"""In: what OpenImageIO failed at. Out: why, as text, whatever bytes a damaged file put into its message."""

from typing import Any


def reason(source: Any) -> str:
    """Of the last failure of `source` (the module, an input or an output), in one line.

    A message may repeat bytes of the file; where these are no UTF-8 the binding raises instead of answering.
    """
    try:
        return " ".join(source.geterror().split()) or "no reason given"
    except UnicodeDecodeError:
        return "its text is none"
