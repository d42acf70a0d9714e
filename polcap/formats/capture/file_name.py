"""In: what a person or a folder calls a capture. Out: a name that every file system, and an OBJ's line, can bear."""

_FORBIDDEN = set('/\\:*?"<>|')  # the separators, and what Windows refuses
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(10))}  # Windows' own
_MOST_BYTES = 60  # Windows counts 260 characters of the whole path, in which the capture's folder stands too


def safe(text: str) -> str:
    """The name with every character replaced by _ that has a meaning of its own; never empty, hidden or a device."""
    name = "".join("_" if c in _FORBIDDEN or not c.isprintable() else c for c in text)
    name = name.encode("utf-8", "replace")[:_MOST_BYTES].decode("utf-8", "ignore")
    name = name.strip(". ") or "capture"
    return f"_{name}" if name.partition(".")[0].rstrip().upper() in _DEVICES else name
