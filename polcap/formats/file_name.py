"""In: what a person or a folder calls a capture. Out: a name that every file system, and an OBJ's line, can bear."""

_FORBIDDEN = set('/\\:*?"<>|')  # the separators, and what Windows refuses
_MOST_BYTES = 100  # of 255; a temporary name adds to it, and Windows counts the whole path


def safe(text: str) -> str:
    """The name with every character replaced by _ that has a meaning of its own; never empty, never hidden."""
    name = "".join("_" if c in _FORBIDDEN or not c.isprintable() else c for c in text)
    name = name.encode("utf-8", "replace")[:_MOST_BYTES].decode("utf-8", "ignore")
    return name.strip(". ") or "capture"
