"""In: bytes. Out: a name under which a library that opens files by name reads exactly these bytes. In the worker."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def named(data: bytes) -> Iterator[str]:
    """A file in memory under Linux, else a temporary one, which is removed."""
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
