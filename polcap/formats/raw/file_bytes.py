"""The bytes of a photograph: read once, with their digest, and handed to libraries that open files by name.

All of it runs in the child process of `sandbox`.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from typing import BinaryIO

from polcap.errors import DecodeError
from polcap.formats import text_file


@contextmanager
def opened(path: str) -> Iterator[BinaryIO]:
    """A photograph's file, open for reading. Raises DecodeError if it cannot be read."""
    try:
        with text_file.opened(path) as file:
            yield file
    except OSError as error:
        raise DecodeError(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from None


def digest(data: bytes) -> str:
    """SHA-256 of a photograph's bytes; enters every cache key that depends on the photograph."""
    return sha256(data).hexdigest()


def load(path: str, expected: str | None = None) -> bytes:
    """All bytes of a file. Raises DecodeError: it cannot be read, or its digest is not the `expected` one."""
    with opened(path) as file:
        data = file.read()
    if expected is not None and digest(data) != expected:
        raise DecodeError(f"{path}: changed while polcap was using it; leave the file alone and run again")
    return data


@contextmanager
def named(data: bytes) -> Iterator[str]:
    """A file name under which a library can open these bytes: an in-memory file on Linux, else a temporary file."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("polcap")
        try:
            with os.fdopen(os.dup(handle), "wb") as file:
                file.write(data)
            yield f"/proc/self/fd/{handle}"
        finally:
            os.close(handle)
        return
    handle, name = tempfile.mkstemp(prefix="polcap-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        yield name
    finally:
        os.unlink(name)
