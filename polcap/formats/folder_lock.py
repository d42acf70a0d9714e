"""Locks a folder against other processes by a locked file; the system unlocks it when the process ends."""

import errno
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from polcap.formats import system_errors


def acquire(lock: FileLock) -> AbstractContextManager[Any]:
    """Lock the file of a lock; returns a context manager that unlocks it.

    Raises filelock.Timeout: another process has it. StorageError: it cannot be written, or its drive has no locks.
    """
    try:
        return lock.acquire()
    except Timeout:  # an OSError too
        raise
    except OSError as error:
        raise system_errors.cannot_write(Path(lock.lock_file), error) from error
    except NotImplementedError as error:
        raise system_errors.cannot_write(Path(lock.lock_file), OSError(errno.ENOLCK, "no locks")) from error
