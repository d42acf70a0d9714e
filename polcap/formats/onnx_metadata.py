"""In: the bytes of an ONNX model. Out: its metadata, without a runtime.

Of the fields of a ModelProto only `metadata_props` (14) is read; what is longer, the graph, is stepped over.

References
----------
onnx.proto3, ModelProto and StringStringEntryProto; Protocol Buffers, Encoding.
"""

from collections.abc import Iterator

_PROPS, _KEY, _VALUE = 14, 1, 2
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # wire types


def read(data: bytes) -> dict[str, str]:
    """Key and value of every entry of a model (bytes).

    Raises
    ------
    ValueError
        These are no fields, not all of them, or their text is none.
    """
    if not data:
        raise ValueError("there is nothing in it")
    entries = [dict(_fields(entry)) for number, entry in _fields(data) if number == _PROPS]
    return {entry.get(_KEY, b"").decode(): entry.get(_VALUE, b"").decode() for entry in entries}


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and content of each field that holds bytes; the others are stepped over."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            _, at = _varint(data, at)
        elif kind == _BYTES:
            length, at = _varint(data, at)
            if at + length > len(data):
                raise ValueError("the fields end early")
            yield tag >> 3, data[at : at + length] if tag >> 3 in (_KEY, _VALUE, _PROPS) else b""
            at += length
        elif kind in (_EIGHT, _FOUR):
            at += 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"wire type {kind} at byte {at}")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, least first, and where it ends."""
    value = shift = 0
    while True:
        if at >= len(data):
            raise ValueError("the fields end early")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
