"""In: the path of a photograph. Out: its bytes, read once, and the digest they are known by. In the worker."""

from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from typing import BinaryIO

from polcap.errors import DecodeError
from polcap.formats import text_file


@contextmanager
def opened(path: str) -> Iterator[BinaryIO]:
    """The file, to be read; a `DecodeError` where it cannot be."""
    try:
        with text_file.opened(path) as file:
            yield file
    except OSError as error:
        raise DecodeError(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from None


def digest(data: bytes) -> str:
    """What the bytes of a photograph put into the key of all that is made from it."""
    return sha256(data).hexdigest()


def load(path: str, expected: str | None = None) -> bytes:
    """All bytes of a file, which must have the digest `expected`, so that key and pixels come from the same bytes.

    Raises
    ------
    DecodeError
        The file cannot be read, or has changed.
    """
    with opened(path) as file:
        data = file.read()
    if expected is not None and digest(data) != expected:
        raise DecodeError(f"{path}: has changed since polcap first looked at it; leave it alone and run again")
    return data
